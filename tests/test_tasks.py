"""The batched environment of every registered task: TorchRL's contract, divergence, names."""

import dataclasses
import functools
import pickle

import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import ParallelEnv, SerialEnv
from torchrl.envs.utils import check_env_specs

import tasks
from tasks import base
from tasks.cartpole import CartPole
from tasks.environment import BatchedEnv
from tasks.suite import SuiteTask
from tests.task_helpers import Falling, actions, all_tasks, assert_same, make, play, stagger


@all_tasks
def test_specs(name):
    env = make(name, num_envs=3)
    check_env_specs(env, break_when_any_done="both", seed=0)
    assert env.batch_size == (3,)
    assert env.observation_spec["observation"].shape == (3, env.task.observation_size)
    assert env.action_spec.shape == (3, env.task.action_size)
    assert env.reward_spec.shape == (3, 1)
    assert env.observation_spec["observation"].dtype == env.reward_spec.dtype == torch.float32
    env.symmetry.check_specs(env)
    assert len(env.task.goal_names) == env.symmetry.group.order


@all_tasks
def test_seed_decides_everything_and_threads_nothing(name):
    def trajectory(seed, num_threads=1):
        env = tasks.make_env(name, num_envs=5, num_threads=num_threads, seed=seed, episode_seconds=0.2)
        return play(env, env.reset(), actions(env, 25))

    first = trajectory(1)
    assert_same(first, trajectory(1))
    assert_same(first, trajectory(1, num_threads=2))
    assert_same(first, trajectory(1, num_threads=3))
    other = trajectory(2)
    assert not torch.equal(first["observation"], other["observation"])
    env = make(name, num_envs=5, seed=7, episode_seconds=0.2)
    env.set_seed(1)
    assert_same(first, play(env, env.reset(), actions(env, 25)))


@all_tasks
def test_starts_differ_between_rows_and_resets(name):
    env = make(name, num_envs=8)
    first, second = (env.reset()["observation"] for _ in range(2))
    assert len(first.unique(dim=0)) == 8
    assert not (first == second).all(dim=-1).any()


@all_tasks
def test_unseeded_environments_follow_torchs_global_seed(name):
    def start(seed):
        torch.manual_seed(seed)
        return make(name, seed=None).reset()["observation"]

    assert torch.equal(start(0), start(0))
    assert not torch.equal(start(0), start(1))


@all_tasks
def test_partial_reset_touches_only_its_rows(name):
    env = make(name)
    tensordict = env.rollout(3)[:, -1]["next"].exclude("reward")
    before = env.simulation.save()["rows"]
    mask = torch.tensor([False, True, False, True])
    tensordict["_reset"] = mask[:, None]
    after = env.reset(tensordict)["observation"]
    rows = env.simulation.save()["rows"]
    assert torch.equal(rows[~mask], before[~mask])
    assert (rows[mask] != before[mask]).any(dim=-1).all()
    assert torch.equal(after, env.task.observe(env.state).float())
    assert env.state.time[mask].tolist() == [0.0, 0.0]
    assert (env.state.time[~mask] > 0).all()


@all_tasks
def test_time_limit_truncates_with_the_true_last_observation(name):
    env = make(name, num_envs=3, episode_seconds=0.2)
    steps = env.task.max_steps
    batch = play(env, env.reset(), 0.1 * actions(env, steps + 2))["next"]
    truncated = batch["truncated"].squeeze(-1)
    assert truncated[steps - 1].all()
    assert truncated.sum() == 3
    assert torch.equal(batch["done"], batch["terminated"] | batch["truncated"])
    # Without resets the same physics goes through the same state instead of a new start.
    free = make(name, num_envs=3, episode_seconds=0.2)
    free.reset()
    for step, action in enumerate(0.1 * actions(env, steps)):
        expected = free.step(TensorDict(action=action, batch_size=[3]))["next", "observation"]
        assert torch.equal(batch["observation"][step], expected)
    new_start = play(env, env.reset(), 0.1 * actions(env, steps + 1))["observation"][steps]
    assert not torch.equal(new_start, expected)


@all_tasks
def test_rows_that_end_at_different_times_are_reset_on_their_own(name):
    env = make(name, num_envs=6, episode_seconds=1.0)
    batch = play(env, stagger(env), 0.1 * actions(env, 60))
    ends = batch["next", "done"].squeeze(-1)
    assert (ends.sum(0) >= 1).all()
    assert ends.any(-1).sum() >= 5, "expected the rows to end in different steps"


@all_tasks
def test_outputs_do_not_alias_the_simulation(name):
    env = make(name)
    first = env.reset()
    step = env.step(first.clone().set("action", actions(env, 1)[0]))
    kept = [first.clone(), step.clone()]
    play(env, step["next"].select("observation", "done", "terminated"), actions(env, 5))
    env.reset()
    assert_same(first, kept[0])
    assert_same(step, kept[1])


@all_tasks
def test_rollout_until_all_are_done_freezes_finished_rows(name):
    env = make(name, num_envs=3, episode_seconds=0.5)
    rollout = env.rollout(
        100, tensordict=stagger(env), auto_reset=False, break_when_all_done=True,
        break_when_any_done=False,
    )  # fmt: skip
    assert rollout["next", "done"][:, -1].all()
    limit = env.task.episode_seconds
    assert (env.state.time <= limit + 1e-9).all(), "a finished row was stepped"


# Processes take long to start, and what differs between tasks is pickled for both wrappers.
@pytest.mark.parametrize(
    ("wrapper", "name"), [(SerialEnv, name) for name in tasks.ALL_TASKS] + [(ParallelEnv, "anymal_climb")]
)
def test_under_serial_and_parallel_env(wrapper, name):
    create = functools.partial(tasks.make_env, name, num_envs=3, num_threads=1, seed=0)
    pickle.loads(pickle.dumps(create))
    env = wrapper(2, create)
    try:
        env.set_seed(0)
        rollout = env.rollout(4)
        assert rollout.batch_size == (2, 3, 4)
        assert rollout["next", "observation"].isfinite().all()
    finally:
        env.close()


@all_tasks
def test_extreme_states_and_actions_stay_finite(name):
    env = make(name, num_envs=6)
    env.reset()
    state = env.state
    state.qvel[0] += 0.3 * env.task.max_velocity
    state.qvel[1] += 2.0 * env.task.max_velocity
    state.qvel[2] -= 1e7
    env.reset_to(state)
    for action in actions(env, 30, scale=100.0):
        out = env.step(TensorDict(action=action, batch_size=env.batch_size))["next"]
        for key in ("observation", "reward"):
            assert out[key].isfinite().all(), key
    assert env.num_diverged >= 2


@all_tasks
@pytest.mark.parametrize("scale", [0.0, 1.0], ids=["zero actions", "random actions"])
def test_a_second_without_divergence_or_warning(name, scale, capfd, tmp_path, monkeypatch):
    """Rows that MuJoCo warns about count as diverged."""
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings to a log file where it runs
    env = make(name, num_envs=8)
    batch = play(env, env.reset(), actions(env, round(1 / env.task.control_timestep), scale=scale))
    assert env.num_diverged == 0
    assert batch["next", "observation"].abs().max() < 20.0
    assert "WARNING" not in capfd.readouterr().err and not list(tmp_path.iterdir())


def nan_action(env, action):
    action[1] = torch.nan


def infinite_action(env, action):
    action[1, -1] = -torch.inf


def opposite_infinities(env, action):
    action[1, 0], action[1, -1] = torch.inf, -torch.inf  # their sum is not infinite


def huge_velocity(env, action):
    env.simulation.qvel[1, -1] = 1e7


def nan_position(env, action):
    env.simulation.qpos[1, -1] = torch.nan


@all_tasks
@pytest.mark.parametrize(
    "poison", [nan_action, infinite_action, opposite_infinities, huge_velocity, nan_position]
)
def test_divergence_ends_one_episode_and_nothing_else(name, poison, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings to a log file where it runs
    env, healthy = make(name, num_envs=3), make(name, num_envs=3)
    sequence = 0.1 * actions(env, 5)
    poisoned = sequence.clone()
    start, expected = env.reset(), healthy.reset()
    poison(env, poisoned[0])
    out, after = env.step_and_maybe_reset(start.set("action", poisoned[0]))
    reference, expected = healthy.step_and_maybe_reset(expected.set("action", sequence[0]))
    assert env.num_diverged == 1
    assert out["next", "terminated"].squeeze(-1).tolist() == [False, True, False]
    assert out["next", "reward"][1] == 0
    assert after["observation"].isfinite().all()
    assert all(x.isfinite().all() for x in env.state.variables.values())
    for key in ("observation", "reward"):
        assert out["next", key].isfinite().all()
    others = torch.tensor([0, 2])
    assert_same(out[others], reference[others])
    batch, reference = play(env, after, sequence[1:]), play(healthy, expected, sequence[1:])
    assert batch["next", "observation"].isfinite().all()
    assert_same(batch[:, others], reference[:, others])
    assert env.num_diverged == 1


def test_a_diverged_row_earns_nothing():
    env = BatchedEnv(Falling(), 3, num_threads=1, seed=0)
    td = env.reset().set("action", torch.tensor([[0.0], [torch.nan], [0.0]]))
    assert env.step(td)["next", "reward"].squeeze(-1).tolist() == [1.0, 0.0, 1.0]


def test_termination_is_not_truncation():
    env = BatchedEnv(Falling(), 4, num_threads=1, seed=0)
    batch = play(env, env.reset(), torch.zeros(60, 4, 1))["next"]
    ended = batch["reward"] == 7
    assert ended.any()
    assert torch.equal(batch["terminated"], ended)
    assert torch.equal(batch["done"], ended)
    assert not batch["truncated"].any()


def test_public_names():
    assert tasks.__all__ == ["ALL_TASKS", "load", "make_env"]
    assert "cartpole" in tasks.ALL_TASKS
    assert base.registered() == tasks.ALL_TASKS
    assert callable(tasks.load)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        tasks.nothing  # noqa: B018


@pytest.mark.parametrize("function", [tasks.make_env, tasks.load])
def test_unknown_names_list_the_known_ones(function):
    with pytest.raises(KeyError, match=r"\['anymal_climb'.*'cartpol'.*did you mean 'cartpole'"):
        function("cartpol")
    with pytest.raises(TypeError, match=r"'motor_bias', 'rail_tilt', 'wind'\], got 'gravity'"):
        function("cartpole", gravity=3.0)
    with pytest.raises(ValueError, match="at least one control step"):
        function("cartpole", episode_seconds=0.001)


def test_a_name_is_registered_once():
    with pytest.raises(ValueError, match="'cartpole', which CartPole has"):
        base.register(CartPole)


def test_a_task_that_contradicts_itself_is_refused():
    class ThreeGoals(CartPole):
        goal_names = ("a", "b", "c")

    class FourNumbers(CartPole):
        def observe(self, state):
            return super().observe(state)[:, [0, 1, 2, 2]]

    class TwoAngles(CartPole):
        def layout(self):
            velocity, angle, rate = super().layout()
            return velocity, dataclasses.replace(angle, value=lambda state: state.qpos), rate

    class OddTimestep(CartPole):
        control_timestep = 0.03

    with pytest.raises(ValueError, match=r"one goal name per group element.*\['a', 'b', 'c'\]"):
        BatchedEnv(ThreeGoals(), 2)
    for face in (lambda task: BatchedEnv(task, 2), SuiteTask):
        with pytest.raises(ValueError, match=r"observation: expected 3 numbers a row.*got shape \(1, 4"):
            face(FourNumbers())
        with pytest.raises(ValueError, match=r"'pole angle from upright' of shape \(1, 1\).*\(1, 2"):
            face(TwoAngles())
    with pytest.raises(ValueError, match=r"multiple of the model's timestep 0.02 s, got 0.03"):
        OddTimestep()


def test_missing_asset_lists_the_files():
    with pytest.raises(FileNotFoundError, match=r"'nothing.xml'.*cartpole.xml"):
        base.load_model("nothing.xml")
