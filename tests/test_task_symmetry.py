"""Every registered task commutes with its group, and a broken symmetry is caught."""

import mujoco
import pytest
import torch

import tasks
from tasks import base
from tasks.cartpole import CartPole
from tasks.state import State
from tests.task_helpers import SETTINGS, all_settings, all_tasks, equivariance_error, make, reached
from torchrl_sym import Symmetry
from torchrl_sym.mujoco import audit, verify
from torchrl_sym.mujoco.verify import PARTS
from torchrl_sym.representations import invariant

# The largest error of a mirrored run against the run of the mirror. Exactly zero where the group only
# flips signs; contacts amplify rounding; a turn by 120 degrees rounds observations to single precision.
TOLERANCE = {"cartpole": 0.0, "anymal_push": 1e-9, "anymal_climb": 1e-9, "trifinger_repose": 1e-6}

all_elements = pytest.mark.parametrize(
    ("name", "g"),
    [(name, g) for name in tasks.ALL_TASKS for g in range(base.create(name).symmetry.group.order)],
)


@all_elements
def test_step_observation_and_reward_commute_with_the_group(name, g):
    task = base.create(name)
    steps = 100 if name == "cartpole" else 20
    assert equivariance_error(task, task.symmetry, g, steps) <= TOLERANCE[name]


@all_elements
def test_behaviour_is_the_same_for_mirror_images(name, g):
    task = base.create(name)
    state = reached(task, task.sample_initial_state(8, torch.Generator().manual_seed(0)), steps=10)
    images = task.behaviour(task.transform_state(state, g))
    for figure, value in task.behaviour(state).items():
        torch.testing.assert_close(images[figure], value, msg=figure)


@all_settings
def test_verify_finds_every_part_symmetric_in_contact(name, kwargs):
    env = make(name, num_envs=16, **kwargs)
    report = verify(env, env.symmetry, tolerance=1e-9)
    assert report.passed, str(report)
    assert {row.part for row in report.rows} == set(PARTS)
    assert {row.element for row in report.of("contact")} == set(env.symmetry.group.names)
    assert all(row.limit <= 1e-9 for part in ("dynamics", "contact") for row in report.of(part))
    in_contact = 0 if name == "cartpole" else report.states / 2  # the cartpole touches nothing
    assert report.contacts >= in_contact


@all_settings
def test_the_model_is_exactly_symmetric(name, kwargs):
    task = base.create(name, **kwargs)
    report = audit(task.model, task.symmetry.group, carried=task.carried)
    assert report.exact and not report.unchecked and not report.warnings, str(report)


@all_settings
def test_no_start_penetrates_anything(name, kwargs):
    """Of all goals, levels and starts after an episode; 2000 of each task or more."""
    task, n = base.create(name, **kwargs), 2000 // (3 * len(SETTINGS[name])) + 1
    generator = torch.Generator().manual_seed(0)
    goal = task.sample_goal_state(n, generator)
    element = torch.arange(n) % task.symmetry.group.order
    finished = task.sample_initial_state(n, generator)
    finished.time[:] = task.episode_seconds
    if "level" in finished.variables:
        finished.variables["level"][:, 0] = torch.arange(n) % 9
    states = [
        task.transform_state(goal, element),
        task.sample_initial_state(n, generator),
        task.restart(finished, generator),
    ]
    data = mujoco.MjData(task.model)
    for state in states:
        for row in range(n):
            data.qpos[:], data.qvel[:] = state.qpos[row], state.qvel[row]
            if state.mocap_pos is not None:
                data.mocap_pos[:], data.mocap_quat[:] = state.mocap_pos[row], state.mocap_quat[row]
            mujoco.mj_forward(task.model, data)
            assert (data.contact.dist >= 0).all(), f"row {row}: {data.contact.geom[data.contact.dist < 0]}"


@all_tasks
def test_the_layout_describes_every_number_observed(name):
    task = base.create(name)
    matrices, start = task.symmetry["observation"].matrices, 0
    for entry in task.layout():
        block = slice(start, start + entry.representation.dim)
        assert torch.equal(matrices[:, block, block], entry.representation.matrices), entry.name
        assert entry.unit and entry.frame and entry.kind and entry.scale > 0 < entry.divisor
        start = block.stop
    assert start == task.observation_size == matrices.shape[-1]
    blocks = [entry.representation.matrices.abs() for entry in task.layout()]
    assert matrices.abs().sum() == pytest.approx(float(sum(block.sum() for block in blocks)))


@all_tasks
def test_every_term_of_the_reward_is_invariant_and_their_sum_is_the_reward(name):
    task = base.create(name)
    start = task.sample_initial_state(64, torch.Generator().manual_seed(0))
    state = reached(task, start, steps=12, scale=1.0)
    action = 2 * torch.rand(len(state), task.action_size, generator=torch.Generator().manual_seed(1)) - 1
    action = action.double()
    terms = task.reward_terms(state, action)
    torch.testing.assert_close(sum(terms.values()), task.reward(state, action), rtol=0, atol=1e-12)
    for g in range(1, task.symmetry.group.order):
        image, mirrored = task.transform_state(state, g), task.symmetry["action"](action, g)
        for key, value in task.reward_terms(image, mirrored).items():
            # Heights of the ground are in single precision.
            torch.testing.assert_close(value, terms[key], rtol=0, atol=1e-6, msg=f"{key}, element {g}")
        if (success := task.success(state)) is not None:
            assert torch.equal(task.success(image), success)


def assert_close(a, b):
    """Equal states to rounding: quaternions with their sign, mocap bodies and variables too."""
    parts = {"qpos": (a.qpos, b.qpos), "qvel": (a.qvel, b.qvel), "time": (a.time, b.time)}
    if a.mocap_pos is not None:
        parts |= {"mocap_pos": (a.mocap_pos, b.mocap_pos), "mocap_quat": (a.mocap_quat, b.mocap_quat)}
    parts |= {name: (a.variables[name], b.variables[name]) for name in a.variables}
    for name, (x, y) in parts.items():
        torch.testing.assert_close(x, y, rtol=0, atol=1e-12, msg=name)


@all_tasks
def test_the_group_acts_on_states(name):
    task = base.create(name)
    group = task.symmetry.group
    state = task.sample_initial_state(8, torch.Generator().manual_seed(0))
    for g in range(group.order):
        for h in range(group.order):
            product = task.transform_state(task.transform_state(state, h), g)
            direct = task.transform_state(state, int(group.table[g, h]))
            assert_close(product, direct)
        by_name = task.transform_state(state, group.names[g])
        by_row = task.transform_state(state, torch.full((8,), g))
        for image in (by_name, by_row):
            assert_close(image, task.transform_state(state, g))
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
