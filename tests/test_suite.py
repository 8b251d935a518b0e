"""The dm_control face: the same task as the batched one, and a good citizen of dm_control."""

import dm_env
import numpy as np
import pytest
import torch
from dm_control.rl import control
from tensordict import TensorDict
from torchrl.envs import DMControlWrapper

import tasks

all_tasks = pytest.mark.parametrize("name", tasks.ALL_TASKS)


def random_actions(env, steps, seed=0):
    spec = env.action_spec()
    return np.random.RandomState(seed).uniform(spec.minimum, spec.maximum, (steps, *spec.shape))


@all_tasks
@pytest.mark.parametrize("scale", [0.5, 1.0])
def test_two_faces_agree(name, scale):
    """Observation, reward, discount and time limit, from the same start state, over 200 steps.

    A robot on legs falls early by full random actions, which shows that both faces end there.
    """
    suite = tasks.load(name, random=1)
    batched = tasks.make_env(name, num_envs=1, num_threads=1, seed=2)
    step = suite.reset()
    out = batched.reset_to(suite.task.state)
    np.testing.assert_allclose(out["observation"][0], step.observation["observation"], atol=1e-6)
    count = 0
    for action in scale * random_actions(suite, 200):
        step, count = suite.step(action), count + 1
        td = TensorDict(action=torch.as_tensor(action)[None], batch_size=[1])
        out = batched.step(td)["next"]
        np.testing.assert_allclose(out["observation"][0], step.observation["observation"], atol=1e-6)
        assert float(out["reward"]) == pytest.approx(step.reward, abs=1e-6)
        for value in ("qpos", "qvel"):  # contact would make a difference of rounding grow
            assert torch.equal(getattr(batched.state, value), getattr(suite.task.state, value))
        assert bool(out["done"]) == step.last()
        if step.last():
            assert step.discount == (0.0 if bool(out["terminated"]) else 1.0)
            break
    assert count == 200 or (scale == 1.0 and bool(out["terminated"]))


@all_tasks
@pytest.mark.parametrize("seconds", [0.1, 0.3, 0.7, 1.14])
def test_time_limit_is_the_same_number_of_steps(name, seconds):
    env = tasks.load(name, random=0, episode_seconds=seconds)
    env.reset()
    steps = 0
    last = False
    while not last:
        step = env.step(np.zeros(env.action_spec().shape))
        steps, last = steps + 1, step.last()
    assert steps == env.task.description.max_steps == round(seconds / env.control_timestep())


@all_tasks
def test_is_a_dm_control_environment(name):
    env = tasks.load(name, random=0)
    assert isinstance(env, control.Environment)
    description = env.task.description
    spec = env.observation_spec()["observation"]
    assert spec.shape == (description.observation_size,)
    assert spec.dtype == np.float64
    action = env.action_spec()
    assert action.shape == (description.action_size,)
    np.testing.assert_array_equal(action.minimum, -np.ones(action.shape))
    np.testing.assert_array_equal(action.maximum, np.ones(action.shape))
    assert env.control_timestep() == pytest.approx(description.control_timestep)
    step = env.reset()
    assert step.step_type == dm_env.StepType.FIRST
    for value in random_actions(env, 20):
        step = env.step(value)
        spec.validate(step.observation["observation"])
        assert np.isfinite(step.reward)


@all_tasks
def test_random_decides_the_starts(name):
    def starts(random):
        env = tasks.load(name, random=random)
        return [env.reset().observation["observation"] for _ in range(4)]

    a, b, c = starts(0), starts(0), starts(1)
    np.testing.assert_array_equal(a, b)
    assert not np.allclose(a[0], a[1])
    assert not np.allclose(a, c)
    np.testing.assert_array_equal(a, starts(np.random.RandomState(0)))
    assert not np.allclose(starts(None), starts(None))


@all_tasks
def test_specs_before_the_first_reset_draw_nothing(name):
    asked, fresh = (tasks.load(name, random=0) for _ in range(2))
    asked.observation_spec()
    with pytest.raises(RuntimeError, match=r"call reset\(\) first"):
        _ = asked.task.state
    np.testing.assert_array_equal(
        asked.reset().observation["observation"], fresh.reset().observation["observation"]
    )


@all_tasks
def test_in_torchrl(name):
    env = DMControlWrapper(tasks.load(name, random=0))
    rollout = env.rollout(5)
    assert rollout["next", "observation"].shape[-1] == tasks.make_env(name).task.observation_size
    assert rollout["next", "observation"].isfinite().all()


@all_tasks
def test_physics_runs_on_a_copy_of_the_model(name):
    """A copy, since a randomised task writes into it."""
    env = tasks.load(name)
    one, other = env.physics.model.ptr, env.task.description.model
    assert one is not other
    for field in ("body_mass", "geom_friction", "jnt_axis", "actuator_gainprm", "qpos0"):
        np.testing.assert_array_equal(getattr(one, field), getattr(other, field))
    assert one.opt.timestep == other.opt.timestep


@pytest.mark.parametrize(
    ("name", "kwargs", "field"),
    [
        ("anymal_push", {"friction": (0.5, 2.0)}, "geom_friction"),
        ("anymal_climb", {"added_mass": (-2.0, 2.0)}, "body_mass"),
        ("trifinger_repose", {"cube_mass": (0.05, 0.1)}, "body_inertia"),
    ],
)
def test_randomises_every_episode(name, kwargs, field):
    env = tasks.load(name, random=0, **kwargs)
    model, nominal = env.physics.model.ptr, env.task.description.model
    drawn = []
    for _ in range(3):
        env.reset()
        drawn.append(getattr(model, field).copy())
    assert not np.array_equal(drawn[0], drawn[1]) and not np.array_equal(drawn[1], drawn[2])
    own = getattr(nominal, field)  # the description's, which nothing writes into
    assert not np.array_equal(drawn[0], own)
    ratio = drawn[2][own > 0] / own[own > 0]
    assert ratio.min() > 0.4 and ratio.max() < 2.1, "draws must not compound"
