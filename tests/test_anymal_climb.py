"""ANYmal-Climb: heights against MuJoCo's rays, standing on the edge, the reward, broken symmetries."""

import math
import sys

import mujoco
import numpy as np
import pytest
import torch
from tensordict import TensorDict

from tasks.anymal import rotation
from tasks.anymal_climb import (
    BIAS_WEIGHTS,
    COLUMNS,
    FALL_PENALTY,
    HEIGHT_SCALE,
    ROWS,
    SPEED,
    TASK_WEIGHTS,
    AnymalClimb,
)
from tasks.constants import Constant
from tasks.environment import BatchedEnv
from tests.task_helpers import make, reached, starting_at
from torchrl_sym.mujoco import verify

BOX = 1.0  # half its edge, m


def around_the_box(task, n, seed=0):
    """Robots with any heading whose map of heights sees an edge of the box."""
    generator = torch.Generator().manual_seed(seed)
    state = task.sample_goal_state(n, generator)
    u = torch.rand(n, 3, generator=generator, dtype=torch.float64) * 2 - 1
    state.qpos[:, 0:2] = state.mocap_pos[:, 0, :2] + 1.6 * u[:, :2]
    yaw = math.pi * u[:, 2]
    state.qpos[:, 3], state.qpos[:, 6] = (yaw / 2).cos(), (yaw / 2).sin()
    return state


def zeros(state):
    return torch.zeros(len(state), 12)


def test_the_canonical_goal_is_in_front_on_the_left_and_every_other_where_its_name_says():
    task = AnymalClimb()
    state = task.sample_goal_state(300, torch.Generator().manual_seed(0))
    box = state.mocap_pos[:, 0]
    assert box[:, 0].min() >= 1.7 and box[:, 0].max() <= 2.0
    assert box[:, 1].min() >= 0.0 and box[:, 1].max() <= 0.3
    torch.testing.assert_close(box[:, 2] + BOX, torch.full((300,), 0.3, dtype=torch.float64))
    for g, name in enumerate(task.goal_names):
        x, y = task.transform_state(state, g).mocap_pos[:, 0, :2].unbind(-1)
        assert ((x > 0) == name.startswith("front")).all()
        assert ((y > 0) == name.endswith("left")).all()


def test_heights_are_those_that_rays_from_above_hit():
    task = AnymalClimb(height=0.35)
    state = around_the_box(task, 24)
    heights = task.heights(state).double()
    assert heights.shape == (24, ROWS * COLUMNS)
    data, geom = mujoco.MjData(task.model), np.zeros(1, dtype=np.int32)
    turned, compared = rotation(state), 0
    for row in range(len(state)):
        data.mocap_pos[:], data.mocap_quat[:] = state.mocap_pos[row], state.mocap_quat[row]
        data.qpos[:] = state.qpos[row]
        data.qpos[2] = 50.0  # out of the way
        mujoco.mj_kinematics(task.model, data)
        box = state.mocap_pos[row, 0]
        for point, (x, y) in enumerate(task._grid.values.T):
            origin = state.qpos[row, 0:3] + turned[row] @ torch.stack([x, y, torch.zeros_like(x)])
            edge = float(((origin[:2] - box[:2]).abs().max() - BOX).abs())
            if edge < 1e-4:  # rounding decides
                continue
            start = np.array([origin[0], origin[1], 10.0])
            down, ground_only = np.array([0.0, 0.0, -1.0]), np.array([1, 0, 0, 0, 0, 0], dtype=np.uint8)
            fall = mujoco.mj_ray(task.model, data, start, down, ground_only, 1, -1, geom)
            assert heights[row, point].item() == pytest.approx(10.0 - fall, abs=1e-6)
            compared += 1
    assert compared > 24 * 200
    assert (heights == 0).any(dim=1).sum() > 12 and (heights > 0.3).any(dim=1).sum() > 12


def test_the_map_turns_with_the_heading_and_not_with_the_tilt():
    task = AnymalClimb()
    state = around_the_box(task, 16)
    level = task.heights(state)
    tilt = torch.tensor([math.cos(0.2), 0.0, math.sin(0.2), 0.0], dtype=torch.float64)  # about its own y
    w, z = state.qpos[:, 3], state.qpos[:, 6]
    a, y = tilt[0], tilt[2]
    state.qpos[:, 3:7] = torch.stack([w * a, -z * y, w * y, z * a], dim=-1)
    assert (rotation(state)[:, 2, 2] < 0.95).all()
    assert (task.heights(state) == level).double().mean() > 0.999


def test_the_ground_is_the_top_of_the_box_where_the_box_is():
    task = AnymalClimb(height=0.25)
    state = task.sample_goal_state(1, torch.Generator().manual_seed(0))
    box = state.mocap_pos[:, 0]
    offsets = torch.tensor([[0, 0], [0.99, 0.99], [1.01, 0], [0, -1.01], [-0.99, 0.5], [-1.7, 0]])
    points = torch.cat([box[:, :2] + offsets.double(), torch.ones(6, 1, dtype=torch.float64)], dim=1)
    expected = torch.tensor([[0.25, 0.25, 0, 0, 0.25, 0]], dtype=torch.float64)
    torch.testing.assert_close(task.ground(state, points[None]), expected)


def test_observed_heights_are_relative_to_a_standing_robot_and_limited():
    task = AnymalClimb(height=0.3)
    state = around_the_box(task, 8)
    state.qpos[:, 2] = torch.tensor([0.5, 0.5, 0.5, 0.5, 0.8, 0.8, 5.0, 5.0])
    seen = task.observe(state)[:, 51:].double()
    expected = (task.heights(state).double() - (state.qpos[:, 2:3] - 0.5)).clamp(-1, 1) * HEIGHT_SCALE
    torch.testing.assert_close(seen, expected, rtol=0, atol=1e-6)
    assert (seen[-1] == -HEIGHT_SCALE).all()


def test_time_left_runs_from_one_to_zero_and_ends_the_episode():
    task = AnymalClimb()
    state = task.sample_goal_state(3, torch.Generator().manual_seed(0))
    state.time[:] = torch.tensor([0.0, 3.0, 6.0])
    assert task.observe(state)[:, 50].tolist() == [1.0, 0.5, 0.0]
    assert task.terminated(state).tolist() == [False, False, True]


def on_the_edge(phase):
    """Robots that stand with some feet on the box and some on the ground, under any heading."""
    task = AnymalClimb(height=0.12, phase=phase, curriculum=False)
    start = task.sample_goal_state(48, torch.Generator().manual_seed(0))
    across = torch.linspace(-0.15, 0.15, 48, dtype=torch.float64)
    start.qpos[:, 0] = start.mocap_pos[:, 0, 0] - BOX + across
    start.qpos[:, 1] = start.mocap_pos[:, 0, 1] + 2 * across
    start.qpos[:, 2] += 0.12
    state = reached(task, start, steps=30)
    feet = task.feet(state)
    ground, touching = task.ground(state, feet), task.touching(state)
    both = ((ground > 0) & touching).any(dim=1) & ((ground == 0) & touching).any(dim=1)
    return task, state.rows(both)


@pytest.mark.parametrize("phase", ["A", "C"])
def test_verify_passes_while_the_robot_stands_on_the_edge_of_the_box(phase, monkeypatch):
    monkeypatch.setattr(sys.modules["torchrl_sym.mujoco.verify.verify"], "MAX_WARM_UP", 0)
    task, state = on_the_edge(phase)
    assert len(state) >= 16
    tilt = rotation(state)[:, 2, :2].norm(dim=-1)
    assert tilt.max() > 0.05
    env = starting_at(task, state)
    report = verify(env, env.symmetry, tolerance=1e-9)
    assert report.passed, str(report)
    assert report.contacts == report.states


def test_the_position_pays_only_in_the_last_two_seconds():
    task = AnymalClimb()
    state = task.sample_goal_state(4, torch.Generator().manual_seed(0))
    state.qpos[:, 0:3] = state.mocap_pos[:, 1]
    state.time[:] = torch.tensor([0.02, 4.0, 4.02, 6.0])
    terms = task.reward_terms(state, zeros(state))
    paid = 0.02 * TASK_WEIGHTS["position"] / 2.0
    expected = torch.tensor([0.0, 0.0, paid, paid], dtype=torch.float64)
    torch.testing.assert_close(terms["position"], expected)
    assert terms["heading"][3].item() == pytest.approx(0.02 * TASK_WEIGHTS["heading"] / 2.0)
    # A quarter of a metre away it pays 1 / (1 + 4 / 16), and facing backward nothing for the heading.
    state.qpos[:, 1] += 0.25
    state.qpos[:, 3:7] = torch.tensor([0.0, 0.0, 0.0, 1.0])
    terms = task.reward_terms(state, zeros(state))
    assert terms["position"][3].item() == pytest.approx(paid * 0.8)
    assert terms["heading"][3].item() == pytest.approx(0.0, abs=1e-9)


def test_phase_a_pays_for_walking_towards_the_target_whichever_side_it_is_on():
    task = AnymalClimb(phase="A")
    state = task.sample_goal_state(4, torch.Generator().manual_seed(0))
    state = task.transform_state(state, torch.arange(4))
    ahead = state.mocap_pos[:, 1, :2] / state.mocap_pos[:, 1, :2].norm(dim=-1, keepdim=True)

    def paid(speed):
        state.qvel[:, 0:2] = speed * ahead
        return task.reward_terms(state, zeros(state))["velocity"]

    full = torch.full((4,), 0.02 * BIAS_WEIGHTS["velocity"], dtype=torch.float64)
    torch.testing.assert_close(paid(SPEED), full)
    assert (paid(0.0) < 0.2 * full).all()
    assert (paid(-SPEED) < 0.01 * full).all()


def test_falling_costs_its_penalty():
    task = AnymalClimb()
    state = task.sample_goal_state(1, torch.Generator().manual_seed(0))
    assert task.reward_terms(state, zeros(state))["fall"].item() == 0
    state.qpos[:, 3:7] = torch.tensor([0.0, 1.0, 0.0, 0.0])
    assert task.reward_terms(state, zeros(state))["fall"].item() == -FALL_PENALTY


def test_low_means_low_above_the_ground_below_the_robot():
    task = AnymalClimb(height=0.2)
    state = task.sample_goal_state(2, torch.Generator().manual_seed(0))
    state.qpos[:, 2] = 0.35
    state.qpos[0, 0:2] = state.mocap_pos[0, 0, :2]
    assert task.terminated(state).tolist() == [True, False]


class ForwardBias(AnymalClimb):
    """Rewards walking forward instead of walking towards the target."""

    def reward(self, state, action):
        terms = self.reward_terms(state, action)
        forward = (state.qvel[:, 0:2] * self._ahead(state)).sum(dim=-1)
        terms["velocity"] = 0.02 * BIAS_WEIGHTS["velocity"] * (-(forward - SPEED).square() / 0.25).exp()
        return torch.stack(tuple(terms.values())).sum(dim=0)


class ShiftedMap(AnymalClimb):
    """Sees farther ahead than behind, as a camera at the front would."""

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self._grid = Constant(self._grid.values + torch.tensor([[0.1], [0.0]]))


class BoxAhead(AnymalClimb):
    """Starts always with the box ahead, on either side."""

    def mapped_at_random(self, state, generator):
        element = 2 * torch.randint(2, (len(state),), generator=generator)
        return self.transform_state(state, element)


class AbsoluteHeading(AnymalClimb):
    """Observes how far it is turned, but not to which side."""

    def observe(self, state):
        observation = super().observe(state)
        observation[:, 49] = observation[:, 49].abs()
        return observation


@pytest.mark.parametrize(
    ("broken", "part", "elements"),
    [
        (ForwardBias, "reward", {"reflect-x", "rot-180"}),
        (ShiftedMap, "kinematics", {"reflect-x", "rot-180"}),
        (BoxAhead, "reset", {"reflect-x", "rot-180"}),
        (AbsoluteHeading, "kinematics", {"reflect-x", "reflect-y"}),
    ],
)
def test_verify_catches_what_breaks_the_symmetry_and_names_the_part(broken, part, elements):
    task = broken()
    env = BatchedEnv(task, 16, num_threads=1, seed=0)
    report = verify(env, env.symmetry, tolerance=1e-9)
    assert report.worst.part == part, str(report)
    assert {row.element for row in report.of(part) if not row.passed} == elements, str(report)


@pytest.mark.parametrize("kwargs", [{"phase": "D"}, {"phase": ""}, {"height": 0.04}], ids=str)
def test_phases_and_heights_that_do_not_exist_are_refused(kwargs):
    with pytest.raises(
        ValueError, match=r"phase: expected one of|height: expected a finite number of at least 0\.05"
    ):
        AnymalClimb(**kwargs)


def test_the_box_is_where_the_state_says_also_in_contact():
    """The top of the box carries a robot that is put on it."""
    env = make("anymal_climb", num_envs=4, height=0.3, curriculum=False)
    task = env.task
    start = task.sample_goal_state(4, torch.Generator().manual_seed(0))
    start.qpos[:, 0:2] = start.mocap_pos[:, 0, :2]
    start.qpos[:, 2] += 0.3
    env.reset_to(start)
    for _ in range(50):
        out = env.step(TensorDict(action=torch.zeros(4, 12), batch_size=[4]))["next"]
    assert not out["done"].any()
    assert task.success(env.state).all() and task.touching(env.state).all()
    feet = task.feet(env.state)[..., 2]
    torch.testing.assert_close(feet, torch.full_like(feet, 0.33), rtol=0, atol=0.005)
