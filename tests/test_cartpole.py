"""CartPole in numbers: sizes, physics, observation and reward by hand, starts."""

import mujoco
import pytest
import torch
from tensordict import TensorDict

from tasks.cartpole import CartPole
from tasks.state import State
from tests.task_helpers import make
from torchrl_sym.mujoco import verify


def cartpole_state(angle, velocity=(0.0, 0.0)):
    angle = torch.as_tensor(angle, dtype=torch.float64).reshape(-1)
    qpos = torch.stack([torch.zeros_like(angle), angle], dim=-1)
    return State(qpos, torch.tensor([velocity], dtype=torch.float64).expand(len(angle), 2))


def test_cartpole_has_the_papers_sizes_and_the_chosen_physics():
    task = CartPole()
    assert (task.observation_size, task.action_size) == (3, 1)
    assert task.symmetry.group.names == ("identity", "reflect-x")
    assert (task.substeps, task.max_steps) == (1, 200)
    option = task.model.opt
    assert option.timestep == 0.02
    assert option.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    assert option.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    assert option.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT
    assert task.model.body("cart").mass == 1.0
    assert task.model.body("pole").mass == pytest.approx(0.1)
    assert not task.model.jnt_limited.any()


def test_cartpole_observation_and_reward_by_hand():
    task = CartPole()
    state = cartpole_state([0.5, -3.0], velocity=(1.5, -4.0))
    expected = torch.tensor([[0.5, 0.5 / torch.pi, -0.4], [0.5, -3.0 / torch.pi, -0.4]])
    torch.testing.assert_close(task.observe(state).float(), expected)
    reward = task.reward(state, torch.zeros(2, 1))
    torch.testing.assert_close(reward.float(), torch.tensor([-0.01, -0.06]))


def test_cartpole_angle_is_wrapped_by_an_odd_function():
    task = CartPole()
    angle = torch.cat([torch.linspace(-40, 40, 4001), torch.arange(-9, 10) * torch.pi]).double()
    observed, mirrored = (task.observe(cartpole_state(s * angle))[:, 1] for s in (1, -1))
    assert torch.equal(observed, -mirrored)
    assert observed.abs().max() <= 1
    turns = (angle / torch.pi - observed) / 2
    torch.testing.assert_close(turns, turns.round(), rtol=0, atol=1e-7)
    assert task.observe(cartpole_state(3.5))[0, 1].item() == pytest.approx(3.5 / torch.pi - 2)


def test_cartpole_starts_flat_on_either_side_with_equal_chance():
    task = CartPole()
    n = 20_000
    start = task.sample_initial_state(n, torch.Generator().manual_seed(0))
    right = start.qpos[:, 1] > 0
    assert right.double().mean() == pytest.approx(0.5, abs=0.02)
    noise = torch.stack([start.qpos[:, 1].abs() - torch.pi / 2, *start.qvel.unbind(-1)])
    assert noise.abs().max() <= 0.1
    torch.testing.assert_close(noise.std(dim=1), torch.full((3,), 0.1 / 3**0.5).double(), rtol=0.02, atol=0)
    assert start.qpos[:, 0].abs().max() == 0
    canonical = task.sample_goal_state(100, None)
    assert (canonical.qpos[:, 1] > 1).all(), "the canonical goal is called right"


def test_cartpole_follows_the_clipped_desired_velocity():
    env = make("cartpole", num_envs=3)
    env.reset()
    for _ in range(25):
        out = env.step(TensorDict(action=torch.tensor([[0.5], [1.0], [7.0]]), batch_size=[3]))
    velocity = out["next", "observation"][:, 0] * 3
    assert velocity[0] == pytest.approx(1.5, abs=0.1)
    assert velocity[1] == pytest.approx(3.0, abs=0.1)
    state = env.task.control(torch.tensor([[7.0], [-9.0], [torch.nan]]), env.state)
    assert state[:2].squeeze(-1).tolist() == [3.0, -3.0]
    assert state[2].isnan()


ASYMMETRIES = [{"motor_bias": 0.3}, {"rail_tilt": 3.0}, {"wind": 5.0}]


def rollout(actions, start, **arguments):
    """Observations after constant commands, from one start."""
    env = make("cartpole", num_envs=len(start.qpos), **arguments)
    env.reset_to(start)
    for action in actions:
        out = env.step(
            TensorDict(action=torch.full((len(start.qpos), 1), action), batch_size=env.batch_size)
        )
    return out["next", "observation"]


@pytest.mark.parametrize("asymmetry", ASYMMETRIES, ids=str)
def test_verify_finds_an_asymmetry_in_the_dynamics(asymmetry):
    env = make("cartpole", num_envs=8, **asymmetry)
    report = verify(env, env.symmetry, tolerance=1e-9, states=8)
    assert report.worst.part == "dynamics" and report.worst.value > 1e-3, str(report)


@pytest.mark.parametrize("asymmetry", ASYMMETRIES, ids=str)
def test_the_opposite_asymmetry_is_the_mirror_image(asymmetry):
    start = CartPole().sample_goal_state(4, torch.Generator().manual_seed(0))
    opposite = {name: -value for name, value in asymmetry.items()}
    here = rollout([0.5, -0.2, 0.1], start, **asymmetry)
    there = rollout([-0.5, 0.2, -0.1], CartPole().transform_state(start, "reflect-x"), **opposite)
    torch.testing.assert_close(here, -there, rtol=0, atol=1e-6)
    assert (here - rollout([0.5, -0.2, 0.1], start)).abs().max() > 1e-3


def test_asymmetries_are_those_that_they_are_called():
    upright = cartpole_state([0.0])
    assert CartPole(motor_bias=0.25).control(torch.tensor([[5.0]]), upright).item() == 3.25
    tilted = CartPole(rail_tilt=30.0).model.opt.gravity
    assert tilted.tolist() == pytest.approx([9.81 / 2, 0.0, -9.81 * 3**0.5 / 2])
    assert rollout([0.0], upright, rail_tilt=3.0)[0, 1] > 0, "the pole falls towards the lower end"
    assert rollout([0.0], upright, wind=5.0)[0, 1] > 0, "the pole falls with the wind"
    assert CartPole().model.opt.density == 0.0, "no drag where no wind is asked for"
