"""Which engine steps an environment, and an environment whose physics is mujoco_warp's, run on the CPU."""

import importlib.util
import pickle
import sys

import pytest
import torch
from tensordict import TensorDict

import tasks
from tasks.base import create
from tasks.engines import make_engine
from tasks.evaluation import evaluate
from tasks.simulation import Simulation
from tests.task_helpers import actions, assert_same, make, play
from tests.test_host_waits import NoWaits
from torchrl_sym import Representation


@pytest.mark.parametrize("missing", ["mujoco_warp", "warp"])
def test_the_physics_on_a_gpu_names_its_extra(missing, monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco_warp", sys)  # as if it were there
    monkeypatch.setattr(sys, "__version__", "3.17.0", raising=False)
    monkeypatch.setitem(sys.modules, missing, None)
    with pytest.raises(ImportError, match=rf"needs {missing}, .*torchrl_sym\[gpu\].*engine='mujoco'"):
        tasks.make_env("cartpole", num_envs=4096, device="cuda")


def test_mujoco_is_the_engine_of_the_cpu():
    for engine in (None, "mujoco"):
        env = tasks.make_env("cartpole", num_envs=2, num_threads=1, engine=engine)
        assert isinstance(env.simulation, Simulation)
    assert isinstance(make_engine(create("cartpole"), 2, device="cuda", engine="mujoco"), Simulation)
    with pytest.raises(ValueError, match=r"engine: expected one of \['mujoco', 'warp'\], got 'mjx'"):
        tasks.make_env("cartpole", num_envs=2, engine="mjx")


def warp(seed=0, num_envs=4, **kwargs):
    for module in ("mujoco_warp", "tasks.warp_simulation"):
        if importlib.util.find_spec(module) is None:
            pytest.skip(f"needs {module}: pip install 'torchrl_sym[gpu]'")
    return make("cartpole", num_envs=num_envs, seed=seed, engine="warp", episode_seconds=0.2, **kwargs)


def test_both_engines_agree_on_a_cartpole():
    env, reference = warp(), make("cartpole", episode_seconds=0.2)
    start = reference.task.sample_initial_state(4, torch.Generator().manual_seed(0))
    a, b = env.reset_to(start), reference.reset_to(start)
    assert env.state.qpos.dtype == torch.float32 and env.device == a["observation"].device
    for action in actions(env, 9):
        a, b = (e.step(td.set("action", action))["next"] for e, td in ((env, a), (reference, b)))
        torch.testing.assert_close(a["observation"], b["observation"], rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(a["reward"], b["reward"], rtol=1e-4, atol=1e-6)


def test_rows_end_and_start_by_masks():
    env = warp()
    start = env.task.sample_initial_state(4, torch.Generator().manual_seed(0))
    start.time[:] = torch.tensor([0.0, 0.06, 0.12, 0.18])
    out = play(env, env.reset_to(start), actions(env, 12))
    first = out["next", "truncated"].squeeze(-1).long().argmax(dim=0)
    assert first.tolist() == [9, 6, 3, 0]
    begun = out["observation"][first + 1, torch.arange(4), 1].abs()
    assert ((begun - 0.5).abs() < 0.04).all(), "the pole lies flat again"
    poisoned = TensorDict(action=torch.tensor([[0.0], [torch.nan], [0.0], [0.0]]), batch_size=[4])
    out = env.step(poisoned)["next"]
    assert out["terminated"].squeeze(-1).tolist() == [False, True, False, False]
    assert out["reward"][1] == 0 and out["observation"].isfinite().all() and env.metrics()["diverged"] == 1


@pytest.mark.parametrize("how", ["saved", "pickled"])
def test_a_run_goes_on_exactly(how):
    first = warp()
    sequence = actions(first, 36)
    whole = play(first, first.reset(), sequence)
    env = warp()
    play(env, env.reset(), sequence[:17])
    if how == "saved":
        saved, env = env.save_state(), warp(seed=9)
        env.restore_state(saved)
    else:
        env = pickle.loads(pickle.dumps(env))
        env._restored = True  # its next reset goes on
    assert_same(play(env, env.reset(), sequence[17:]), whole[17:])


def test_a_step_with_its_reset_asks_nothing(monkeypatch):
    env = warp()
    td = env.reset()
    action = actions(env, 1)[0]
    # Indices of elements are looked at where that costs nothing, on the CPU.
    monkeypatch.setattr(Representation, "_check_elements", lambda *_: None)
    with NoWaits():
        for _ in range(12):
            _, td = env.step_and_maybe_reset(td.set("action", action))


def test_evaluation_runs_on_the_engine_of_the_environment():
    env = warp(num_envs=1)
    still = lambda td: td.set("action", torch.zeros(*td.batch_size, 1))  # noqa: E731
    result, reference = (
        evaluate(e, still, episodes=3) for e in (env, make("cartpole", episode_seconds=0.2))
    )
    torch.testing.assert_close(result.returns, reference.returns, rtol=1e-4, atol=1e-5)
    assert result.variation < 1e-5
