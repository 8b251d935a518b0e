"""What users hand to an environment: taken exactly as it is, or refused with a remedy."""

import numpy as np
import pytest
import torch
from dm_control.rl.control import PhysicsError
from tensordict import TensorDict

import tasks
from tasks.environment import BatchedEnv
from tests.task_helpers import Falling, all_tasks, make

# --- numbers


@pytest.mark.parametrize(
    ("seed", "error"),
    [(True, TypeError), (1.5, ValueError), ("2", TypeError), (-1, ValueError), (2**70, ValueError)],
)
def test_seeds(seed, error):
    with pytest.raises(error, match=r"seed: expected a whole number from 0 .* got "):
        tasks.make_env("cartpole", num_envs=2, num_threads=1, seed=seed)
    with pytest.raises(error, match="seed: expected"):
        make("cartpole").set_seed(seed)


@pytest.mark.parametrize("seed", [np.int64(3), torch.tensor(3), 2**62])
def test_seeds_of_other_types_are_the_same_seeds(seed):
    first = make("cartpole", seed=seed).reset()["observation"]
    assert torch.equal(first, make("cartpole", seed=int(seed)).reset()["observation"])


def test_a_task_is_a_task():
    with pytest.raises(TypeError, match=r"expected a task, got str; tasks\.make_env takes a task's name"):
        BatchedEnv("cartpole", 2)


# --- actions


def started(name="anymal_push"):
    env = make(name, num_envs=3)
    return env, env.reset()


@pytest.mark.parametrize(
    "shape", [(3, 1), (3,), (12,), (1, 12), (3, 11), (3, 12, 1), (3, 1, 12), (4, 12)], ids=str
)
def test_actions_of_another_shape(shape):
    env, _ = started()
    before = env.simulation.save()["rows"]
    batch = TensorDict(batch_size=[3])
    batch._tensordict["action"] = torch.zeros(shape)  # whatever its batch size
    with pytest.raises(ValueError, match=r"action: expected shape \(3, 12\).*check the policy"):
        env.step(batch)
    assert torch.equal(env.simulation.save()["rows"], before)


@pytest.mark.parametrize("dtype", [torch.int64, torch.bool, torch.complex64])
def test_actions_that_are_not_real_numbers(dtype):
    env, start = started()
    with pytest.raises(TypeError, match=rf"action: expected a tensor of floating-point.* got {dtype}"):
        env.step(start.set("action", torch.zeros(3, 12, dtype=dtype)))
    with pytest.raises(TypeError, match="action: expected a tensor"):
        env.step(start.set("action", "left"))


@pytest.mark.parametrize("dtype", [torch.float64, torch.float16, torch.bfloat16])
def test_actions_of_other_precision_are_taken(dtype):
    action = torch.full((3, 12), 0.25)  # exact in all of them
    outcomes = []
    for kind in (torch.float32, dtype):
        env, start = started()
        outcomes.append(env.step(start.set("action", action.to(kind)))["next"])
    assert torch.equal(outcomes[0]["observation"], outcomes[1]["observation"])
    assert torch.equal(outcomes[0]["reward"], outcomes[1]["reward"])


def test_no_action_and_no_episode():
    env, start = started()
    with pytest.raises(KeyError, match=r"expected 'action' of shape \(3, 12\).*rand_action"):
        env.step(start)
    with pytest.raises(RuntimeError, match=r"expected a started episode, got none; call reset\(\)"):
        make("anymal_push", num_envs=3).step(start.set("action", torch.zeros(3, 12)))


def test_finite_actions_whose_sum_is_not_are_clipped():
    env = BatchedEnv(Falling(), 3, num_threads=1, seed=0)
    first = env.step(env.reset().set("action", torch.full((3, 1), 3e38)))["next"]
    assert env.num_diverged == 0
    env = BatchedEnv(Falling(), 3, num_threads=1, seed=0)
    second = env.step(env.reset().set("action", torch.ones(3, 1)))["next"]
    assert torch.equal(first["observation"], second["observation"])


class Forgiving(Falling):
    """Hides from the physics that an action is not finite."""

    def control(self, action, state):
        return torch.nan_to_num(action).clamp(-1.0, 1.0)


@pytest.mark.parametrize("value", [torch.nan, torch.inf, -torch.inf])
def test_a_task_cannot_hide_an_action_that_is_not_finite(value):
    env = BatchedEnv(Forgiving(), 3, num_threads=1, seed=0)
    out = env.step(env.reset().set("action", torch.tensor([[0.0], [value], [0.0]])))["next"]
    assert out["terminated"].squeeze(-1).tolist() == [False, True, False]
    assert out["reward"].squeeze(-1).tolist() == [1.0, 0.0, 1.0]
    assert env.num_diverged == 1


@all_tasks
def test_actions_of_the_dm_control_face(name):
    env, untouched = (tasks.load(name, random=0) for _ in range(2))
    size = env.action_spec().shape[0]
    env.reset()
    untouched.reset()
    for value in (np.nan, np.inf, -np.inf):
        with pytest.raises(PhysicsError, match="action: expected finite numbers"):
            env.step(np.array([0.0] * (size - 1) + [value]))
    for action in (np.zeros(size + 1), np.zeros((1, size)), 0.0, "left", [True] * size, [1j] * size):
        with pytest.raises(ValueError, match=rf"action: expected {size} real numbers of shape \({size},\)"):
            env.step(action)
    a, b = (each.step([0.5] * size) for each in (env, untouched))
    assert a.reward == b.reward
    np.testing.assert_array_equal(a.observation["observation"], b.observation["observation"])


# --- masks of rows


@pytest.mark.parametrize(
    "mask", [torch.ones(3, 2, dtype=torch.bool), torch.ones(3, 1), torch.ones(3, 1).int()]
)
def test_masks_of_rows(mask):
    env, start = started("cartpole")
    with pytest.raises(ValueError, match=r"_reset: expected a bool mask of shape \(3, 1\)"):
        env._reset(TensorDict(_reset=mask, batch_size=[3]))
    with pytest.raises(ValueError, match=r"_step: expected a bool mask of shape \(3, 1\)"):
        env._step(start.set("action", torch.zeros(3, 1)).set("_step", mask))


# --- start states


def put(name, change):
    """A change of one attribute or variable of a state."""

    def apply(state):
        if name in ("qpos", "qvel", "time", "mocap_pos"):
            setattr(state, name, change(getattr(state, name)))
        else:
            state.variables[name] = change(state.variables.get(name))

    return apply


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (put("qpos", lambda x: x * torch.nan), "expected finite qpos"),
        (put("qpos", lambda x: x[:, :3]), r"qpos of shape \(3, 26\), got shape \(3, 3\)"),
        (put("qpos", lambda x: x.numpy()), "qpos: expected a tensor, got ndarray"),
        (put("qvel", lambda x: x + torch.inf), "expected finite qvel"),
        (put("mocap_pos", lambda x: x[:1]), r"mocap_pos of shape \(3, 1, 3\), got shape \(1, "),
        (put("time", lambda x: x * torch.nan), "expected finite time"),
        (put("time", lambda x: x[:, None]), r"time of shape \(3,\), got shape \(3, 1\)"),
        (put("time", lambda x: x - 5), "a time of at least 0 s since the episode began, got -5.0 s"),
        (put("level", lambda x: x * torch.nan), "finite tensor .* for the variable 'level'"),
        (put("level", lambda x: x[:1]), r"\(3, 1\) for the variable 'level', got \(1, 1\)"),
        (put("last_action", lambda x: x[:, :1]), r"\(3, 12\) for the variable 'last_action', got \(3, 1\)"),
        (put("last_action", lambda x: None), "for the variable 'last_action', got NoneType"),
        (put("nothing", lambda x: torch.zeros(3, 1)), r"the task's variables \[.*, got \[.*'nothing'"),
        (lambda state: state.variables.pop("level"), r"the task's variables \[.*'level'.*, got \["),
    ],
)  # fmt: skip
@pytest.mark.parametrize("begun", [True, False])
def test_start_states_that_are_not_the_tasks(begun, spoil, message):
    env = make("anymal_push", num_envs=3)
    if begun:
        env.reset()
    before = env.save_state()
    state = env.task.sample_goal_state(3, torch.Generator().manual_seed(0))
    spoil(state)
    with pytest.raises((TypeError, ValueError), match=message):
        env.reset_to(state)
    after = env.save_state()
    assert torch.equal(after["simulation"]["rows"], before["simulation"]["rows"])
    assert after["started"] == before["started"]


def test_start_states_of_other_types_and_tasks():
    env = make("anymal_push", num_envs=3)
    for other in (torch.zeros(3, 26), env.reset(), None):
        with pytest.raises(TypeError, match=r"expected a tasks\.state\.State, got "):
            env.reset_to(other)
    with pytest.raises(ValueError, match=r"the task's variables .*'distance'.*, got \['air_time', 'last"):
        env.reset_to(make("anymal_climb").task.sample_goal_state(3, None))


def test_start_states_of_single_precision_are_taken():
    env = make("anymal_push", num_envs=3)
    state = env.task.sample_goal_state(3, torch.Generator().manual_seed(0))
    state.variables = {name: x.float() for name, x in state.variables.items()}
    assert env.reset_to(state)["observation"].isfinite().all()
    assert env.state.variables["level"].dtype == torch.float64


# --- saved states


class SameSizes(Falling):
    name = "same_sizes"


def test_the_state_of_another_task_is_refused_by_name():
    saved = BatchedEnv(SameSizes(), 3, num_threads=1).save_state()
    with pytest.raises(ValueError, match="saved task_name 'cartpole', got 'same_sizes'"):
        make("cartpole", num_envs=3).restore_state(saved)


PARTS = ("simulation", "variables", "over", "started", "generator", "num_diverged", "task")


def entry(name, value):
    return lambda saved: saved.update({name: value})


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        *(
            (lambda saved, name=name: saved.pop(name), rf"expected saved with .*'{name}'.*, got \[")
            for name in ("task_name", *PARTS)
        ),
        *(
            (entry(name, None), rf"expected saved {name} to be a \w+, got NoneType")
            for name in PARTS
        ),
        (entry("over", torch.zeros(4, dtype=torch.bool)), r"saved over of shape \(3,\)"),
        (entry("over", torch.zeros(3)), "torch.bool, got .*torch.float32"),
        (entry("num_diverged", 1.5), "expected saved num_diverged to be a int, got float"),
        (entry("generator", torch.zeros(5056, dtype=torch.uint8)), "expected the saved generator and"),
        (entry("task", {"phase": "A"}), "what task 'anymal_push' saves.*KeyError.*'averages'"),
        (lambda saved: saved["variables"].pop("level"), r"expected saved variables with .*'level'"),
        (lambda saved: saved["variables"].update(x=torch.zeros(3)), r"saved variables with .*, got .*'x'"),
        (lambda saved: saved["variables"]["level"].fill_(torch.nan), "finite saved variables level"),
        (lambda saved: saved["simulation"]["rows"].fill_(torch.inf), "finite saved simulation rows"),
    ],
)  # fmt: skip
def test_damaged_states_are_not_restored(spoil, message):
    env = make("anymal_push", num_envs=3)
    env.rollout(2)
    saved = env.save_state()
    spoil(saved)
    rows = env.simulation.save()["rows"]
    with pytest.raises(ValueError, match=message):
        env.restore_state(saved)
    assert torch.equal(env.simulation.save()["rows"], rows)


def test_what_is_no_saved_state():
    for saved in (None, {}, 3, "state.pt"):
        with pytest.raises(ValueError, match=r"expected saved (to be a dict|with)"):
            make("cartpole").restore_state(saved)
