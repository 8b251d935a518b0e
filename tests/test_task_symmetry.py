"""Every registered task commutes with its group, and a broken symmetry is caught."""

import pytest
import torch

import tasks
from tasks import base
from tasks.cartpole import CartPole
from tasks.state import State
from tests.task_helpers import all_tasks, equivariance_error
from torchrl_sym import Symmetry
from torchrl_sym.representations import invariant

# The largest error of a mirrored step against the step of the mirror. Exactly zero where the group
# only flips signs; contacts and rotations round.
TOLERANCE = {"cartpole": 0.0}

all_elements = pytest.mark.parametrize(
    ("name", "g"),
    [(name, g) for name in tasks.ALL_TASKS for g in range(base.create(name).symmetry.group.order)],
)


@all_elements
def test_step_observation_and_reward_commute_with_the_group(name, g):
    task = base.create(name)
    assert equivariance_error(task, task.symmetry, g) <= TOLERANCE[name]


@all_tasks
def test_the_group_acts_on_states(name):
    task = base.create(name)
    group = task.symmetry.group
    state = task.sample_initial_state(8, torch.Generator().manual_seed(0))
    for g in range(group.order):
        for h in range(group.order):
            product = task.transform_state(task.transform_state(state, h), g)
            direct = task.transform_state(state, int(group.table[g, h]))
            torch.testing.assert_close(product.qpos, direct.qpos, rtol=0, atol=1e-12)
            torch.testing.assert_close(product.qvel, direct.qvel, rtol=0, atol=1e-12)
        by_name = task.transform_state(state, group.names[g])
        by_row = task.transform_state(state, torch.full((8,), g))
        for image in (by_name, by_row):
            assert torch.equal(image.qpos, task.transform_state(state, g).qpos)
    assert torch.equal(task.transform_state(state, 0).qpos, state.qpos)


@all_tasks
def test_sampling_leaves_the_states_it_is_given_alone(name):
    task = base.create(name)
    state = task.sample_initial_state(4, torch.Generator().manual_seed(0))
    kept = state.clone()
    for g in range(task.symmetry.group.order):
        task.transform_state(state, g).qpos[:] = 9.0
    task.observe(state)
    task.reward(state, torch.zeros(4, task.action_size))
    assert torch.equal(state.qpos, kept.qpos) and torch.equal(state.qvel, kept.qvel)


class WrongVelocity(CartPole):
    """Mirrors the positions but forgets the velocities."""

    def transform_state(self, state, g):
        image = super().transform_state(state, g)
        return State(image.qpos, state.qvel.clone(), time=image.time)


class HalfOpenAngle(CartPole):
    """Rewards only a pole on the right: breaks the symmetry of the reward."""

    def reward(self, state, action):
        return super().reward(state, action) * (state.qpos[:, 1] > 0)


class OneSidedCart(CartPole):
    """A cart that is faster to the right: breaks the symmetry of the dynamics."""

    def control(self, action, state):
        control = super().control(action, state)
        return torch.where(control > 0, 1.001 * control, control)


@pytest.mark.parametrize("broken", [WrongVelocity, HalfOpenAngle, OneSidedCart])
def test_a_broken_symmetry_is_caught(broken):
    task = broken()
    assert equivariance_error(task, task.symmetry, "reflect-x") > 1e-4


@pytest.mark.parametrize("key", ["observation", "action"])
def test_a_wrong_representation_is_caught(key):
    task = CartPole()
    group = task.symmetry.group
    right = {k: task.symmetry[k] for k in ("observation", "action")}
    wrong = Symmetry(group, right | {key: invariant(group, right[key].dim)})
    assert equivariance_error(task, wrong, "reflect-x") > 1e-2
