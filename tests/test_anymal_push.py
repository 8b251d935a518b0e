"""ANYmal-Push: reward by hand, what must not pay, pushing contact, broken symmetries that are caught."""

import math
import sys

import mujoco
import pytest
import torch

from tasks.anymal import into_base, rotation
from tasks.anymal_push import (
    BASE_HEIGHT,
    FALL_PENALTY,
    GAIT_WEIGHTS,
    SPEED,
    STOP_DISTANCE,
    TASK_WEIGHTS,
    TOLERANCE,
    AnymalPush,
    dipole,
    facing,
)
from tasks.environment import BatchedEnv
from tasks.state import concatenate
from tests.task_helpers import reached, starting_at
from torchrl_sym.mujoco import verify

CUBE = 0.3  # half its edge, m


def standing(n=1, seed=0, task=None):
    """Starts with the joints in the standing pose exactly."""
    task = task or AnymalPush()
    return task, task.sample_goal_state(n, torch.Generator().manual_seed(seed))


def zeros(state):
    return torch.zeros(len(state), 12)


def test_the_canonical_goal_is_in_front_on_the_left_of_the_robot():
    task, state = standing(500)
    turn = rotation(state)
    cube = into_base(turn, state.qpos[:, 19:22] - state.qpos[:, 0:3])
    target = into_base(turn, state.mocap_pos[:, 0] - state.qpos[:, 0:3])
    assert (cube[:, :2] > 0).all() and (target[:, :2] > 0).all()
    cross = cube[:, 0] * target[:, 1] - cube[:, 1] * target[:, 0]
    torch.testing.assert_close(cross, torch.zeros_like(cross), rtol=0, atol=1e-12)
    distance = cube[:, :2].norm(dim=-1)
    assert distance.min() >= 1.0 and distance.max() <= 1.3
    reach = target[:, :2].norm(dim=-1) - distance
    assert reach.min() >= 0.3 and reach.min() < 0.32
    assert reach.max() <= 1.35 and reach.max() > 1.33
    yaw = 2 * torch.atan2(state.qpos[:, 6], state.qpos[:, 3])
    assert yaw.min() < -3.0 and yaw.max() > 3.0
    observation = task.observe(state).double()
    torch.testing.assert_close(observation[:, 45:48], 2 * cube, rtol=0, atol=1e-6)
    torch.testing.assert_close(observation[:, 48:51], 5 * (target - cube), rtol=0, atol=2e-6)


def test_every_goal_has_its_direction():
    task, state = standing(200)
    for g, (x, y) in enumerate([(1, 1), (-1, 1), (1, -1), (-1, -1)]):
        image = task.transform_state(state, g)
        cube = into_base(rotation(image), image.qpos[:, 19:22] - image.qpos[:, 0:3])
        assert (x * cube[:, 0] > 0).all() and (y * cube[:, 1] > 0).all()
        assert ("front" in task.goal_names[g]) == (x > 0)
        assert ("left" in task.goal_names[g]) == (y > 0)


def test_reward_by_hand():
    task, state = standing()
    state.mocap_pos[0, 0] = torch.tensor([2.0, 0.0, 0.25])
    state.qpos[0, 0:7] = torch.tensor([0.0, 0.0, BASE_HEIGHT, 1.0, 0.0, 0.0, 0.0])
    state.qpos[0, 19:21] = torch.tensor([1.5, 0.0])
    state.qvel[0, 0] = SPEED - 0.25
    state.variables["distance"][:] = 0.51
    terms = task.reward_terms(state, zeros(state))
    weight = {name: 0.02 * value for name, value in TASK_WEIGHTS.items()}
    miss = 0.25 / (TOLERANCE * SPEED)
    assert terms["velocity"].item() == pytest.approx(weight["velocity"] * math.exp(-(miss**2)))
    assert terms["progress"].item() == pytest.approx(weight["progress"] * 0.5)
    assert 0 < terms["tracking"].item() < weight["tracking"]
    for name in ("height", "vertical", "rolling", "tilt", "fall"):
        assert abs(terms[name].item()) < 1e-12, name
    state.qpos[0, 19] = 2.01 - STOP_DISTANCE  # pushed far enough: the robot is asked to stand
    state.qvel[0, 0] = 0.0
    assert task.reward_terms(state, zeros(state))["velocity"].item() == pytest.approx(weight["velocity"])
    state.qpos[0, 19:21] = state.mocap_pos[0, 0, :2]
    assert task.reward_terms(state, zeros(state))["tracking"].item() == pytest.approx(weight["tracking"])


def directions(angle):
    return torch.stack([angle.cos(), angle.sin()], dim=-1)


def test_the_robot_is_asked_round_the_cube_along_a_dipole_field():
    ahead = torch.tensor([[1.0, 0.0]]).double().expand(4, 2)
    toward = torch.tensor([[1.0, 0], [0, 1.0], [0, -1.0], [-1.0, 0]]).double()
    # Behind the cube: on. Beside it: back along the line of pushing. In front of it: away from the cube.
    expected = torch.tensor([[1.0, 0], [-1.0, 0], [-1.0, 0], [1.0, 0]]).double()
    torch.testing.assert_close(dipole(toward, ahead), expected)
    angle = torch.linspace(-3, 3, 50, dtype=torch.float64)
    field = dipole(directions(angle), directions(torch.zeros(50).double()))
    torch.testing.assert_close(field.norm(dim=-1), torch.ones(50).double())
    # Followed from anywhere but straight ahead of it, it leads to the cube from behind.
    place, there = -directions(angle[5:-5]), torch.zeros(40, dtype=torch.bool)
    for _ in range(500):
        toward = -place / place.norm(dim=-1, keepdim=True)
        there |= place.norm(dim=-1) < 0.1
        place = torch.where(there[:, None], place, place + 0.01 * dipole(toward, ahead[:1].expand(40, 2)))
    assert there.all()
    torch.testing.assert_close(
        -place / place.norm(dim=-1, keepdim=True), ahead[:1].expand(40, 2), rtol=0, atol=0.3
    )


def test_front_and_back_face_the_cube_alike_and_the_sides_do_not():
    turn = torch.eye(3).double().expand(5, 3, 3).clone()
    toward = directions(torch.tensor([0.0, math.pi, math.pi / 2, math.pi / 4, 1.0]).double())
    expected = torch.tensor([1.0, 1.0, 0.0, 0.5, math.cos(1.0) ** 2]).double()
    torch.testing.assert_close(facing(turn, toward), expected)
    pitched = turn @ torch.tensor([[0.8, 0, 0.6], [0, 1.0, 0], [-0.6, 0, 0.8]]).double()
    torch.testing.assert_close(facing(pitched, toward), expected)
    task, state = standing()
    weight = 0.02 * GAIT_WEIGHTS["facing"]
    assert 0 < float(task.reward_terms(state, zeros(state))["facing"]) < weight
    state.mocap_pos[:, 0, :2] = state.qpos[:, 19:21]  # nothing is left to push
    assert float(task.reward_terms(state, zeros(state))["facing"]) == pytest.approx(weight)


def test_progress_pays_for_the_distance_covered_and_takes_it_back():
    """Over any path of the cube the sum is the distance gained, so that rocking it earns nothing."""
    task, state = standing()
    target, total = state.mocap_pos[:, 0, :2], 0.0
    state.variables["distance"] = (target - state.qpos[:, 19:21]).norm(dim=-1, keepdim=True)
    ahead = (target - state.qpos[:, 19:21]) / state.variables["distance"]
    first = state.qpos[:, 19:21].clone()
    for step in range(101):
        state.qpos[:, 19:21] = first + 0.15 * math.sin(step * math.pi / 50) * ahead
        total += float(task.reward_terms(state, zeros(state))["progress"])
        state.variables |= task.update(state, zeros(state))
        if step == 25:
            assert total == pytest.approx(TASK_WEIGHTS["progress"] * 0.15)
    assert total == pytest.approx(0.0, abs=1e-9)


def test_a_kick_earns_less_than_a_push_over_the_same_distance():
    def earned(step):
        task, state = standing()
        gap = state.mocap_pos[:, 0, :2] - state.qpos[:, 19:21]
        state.variables["distance"] = gap.norm(dim=-1, keepdim=True)
        state.qpos[:, 19:21] += step * gap / gap.norm(dim=-1, keepdim=True)
        return float(task.reward_terms(state, zeros(state))["progress"])

    assert earned(0.02) < 4 * earned(0.005)
    assert earned(-0.02) == pytest.approx(-4 * earned(0.005))  # the way back costs in full


@pytest.mark.parametrize("distance", [0.2, 0.3, 0.6, 1.3])
def test_standing_still_short_of_the_target_pays_a_fifth_of_walking(distance):
    task, state = standing()
    ray = state.qpos[0, 19:21] / state.qpos[0, 19:21].norm()
    state.mocap_pos[0, 0, :2] = state.qpos[0, 19:21] + distance * ray
    still = float(task.reward_terms(state, zeros(state))["velocity"])
    assert still == pytest.approx(0.02 * TASK_WEIGHTS["velocity"] * math.exp(-(TOLERANCE**-2)))


def earned(*plans):
    """What moving and pushing pay in a second or more, for each plan of speeds towards the cube."""
    task, state = standing()
    state, total = state.rows(torch.zeros(len(plans), dtype=torch.int64)), torch.zeros(len(plans)).double()
    to_cube = state.qpos[:, 19:21] / state.qpos[:, 19:21].norm(dim=-1, keepdim=True)
    for speed in torch.tensor(plans, dtype=torch.float64).T:
        state.qvel[:, 0:2] = speed[:, None] * to_cube
        state.qpos[:, 0:2] += 0.02 * state.qvel[:, 0:2]
        terms = task.reward_terms(state, zeros(state))
        total += terms["velocity"] + terms["progress"]
        state.variables |= task.update(state, zeros(state))
    return total.tolist()


def test_leaning_towards_the_cube_hardly_earns_more_than_standing():
    """A lean is 0.15 m at best; what pays is to keep walking."""
    still, leaning, walking = earned([0.0] * 50, [SPEED] * 12 + [0.0] * 38, [SPEED] * 50)
    assert still < leaning < 0.5 * walking
    still, leaning = earned([0.0] * 350, [SPEED] * 12 + [0.0] * 338)  # a whole episode
    assert leaning < 1.15 * still


def test_walking_away_earns_less_than_standing():
    away, still = earned([-SPEED] * 50, [0.0] * 50)
    assert away < 0.1 * still


def test_falling_costs_its_penalty_once():
    task, state = standing()
    assert task.reward_terms(state, zeros(state))["fall"].item() == 0
    state.qpos[:, 3:7] = torch.tensor([0.0, 1.0, 0.0, 0.0])
    assert task.reward_terms(state, zeros(state))["fall"].item() == -FALL_PENALTY
    assert task.terminated(state).all()


def pushing_states():
    """Robots that run into the cube from all sides, at moments when they are in contact with it."""
    task, start = standing(48)
    to_cube = start.qpos[:, 19:21] / start.qpos[:, 19:21].norm(dim=-1, keepdim=True)
    start.qpos[:, 19:21] = (
        torch.linspace(0.4 + CUBE, 0.6 + CUBE, 48, dtype=torch.float64)[:, None] * to_cube
    )
    start.qvel[:, 0:2] = 1.5 * to_cube
    data, cube, ground = (
        mujoco.MjData(task.model), task.model.geom("cube").id, task.model.geom("ground").id
    )  # fmt: skip
    states = []
    for steps in (2, 4, 6, 8, 10, 12):
        state, touched = reached(task, start, steps=steps), []
        for row in range(len(state)):
            data.qpos[:], data.qvel[:] = state.qpos[row], state.qvel[row]
            mujoco.mj_forward(task.model, data)
            touched.append(any(cube in pair and ground not in pair for pair in data.contact.geom))
        states.append(state.rows(torch.tensor(touched)))
    return task, concatenate(states)


def test_verify_passes_while_the_robot_pushes_the_cube(monkeypatch):
    monkeypatch.setattr(sys.modules["torchrl_sym.mujoco.verify.verify"], "MAX_WARM_UP", 0)
    task, state = pushing_states()
    assert len(state) >= 10
    assert (state.qvel[:, 19:21].norm(dim=-1) > 0.05).any(), "the cube moves"
    env = starting_at(task, state)
    report = verify(env, env.symmetry, tolerance=1e-9)
    assert report.passed, str(report)
    assert report.contacts == report.states


class ForwardReward(AnymalPush):
    """Pays for walking forward in the robot's own frame."""

    def reward(self, state, action):
        forward = into_base(rotation(state), state.qvel[:, 0:3])[:, 0]
        return super().reward(state, action) + 0.01 * forward


class LeftCubeReward(AnymalPush):
    """Pays only where the cube is on the robot's left."""

    def reward(self, state, action):
        cube = into_base(rotation(state), state.qpos[:, 19:22] - state.qpos[:, 0:3])
        return super().reward(state, action) * (cube[:, 1] > 0)


class OneGoal(AnymalPush):
    """Starts always with the cube in front on the left."""

    def sample_initial_state(self, n, generator):
        return self.sample_goal_state(n, generator)

    def restart(self, finished, generator):
        return self.sample_goal_state(len(finished), generator)


class LeftFootDown(AnymalPush):
    """Ends episodes by the left front foot alone."""

    def terminated(self, state):
        return super().terminated(state) | ~self.touching(state)[:, 0]


class FootInsteadOfCube(AnymalPush):
    """Observes the height of the left front foot where the x of the cube should be."""

    def observe(self, state):
        observation = super().observe(state)
        observation[:, 45] = self.feet(state)[:, 0, 2]
        return observation


@pytest.mark.parametrize(
    ("broken", "part"),
    [
        (ForwardReward, "reward"),
        (LeftCubeReward, "reward"),
        (OneGoal, "reset"),
        (LeftFootDown, "termination"),
        (FootInsteadOfCube, "kinematics"),
    ],
)
def test_verify_catches_what_breaks_the_symmetry_and_names_the_part(broken, part):
    env = BatchedEnv(broken(), 16, num_threads=1, seed=0)
    report = verify(env, env.symmetry, tolerance=1e-9)
    assert report.worst.part == part, str(report)
    if broken is ForwardReward:
        assert {row.element for row in report.of("reward") if not row.passed} == {"reflect-x", "rot-180"}
