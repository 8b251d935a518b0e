"""Trifinger-Repose: exact symmetry, the model's numbers, starts without contact, reward, safety."""

import math

import mujoco
import numpy as np
import pytest
import torch

import tasks
from tasks.environment import BatchedEnv
from tasks.state import State
from tasks.trifinger_repose import (
    ARENA,
    HIGHEST,
    JOINTS,
    LIFT,
    WEIGHTS,
    TrifingerRepose,
)
from torchrl_sym import PointGroup
from torchrl_sym.mujoco import audit, verify
from torchrl_sym.representations import axial, polar, quaternion

CUBE = 0.0325  # half its edge, m
CUBE_DIAGONAL = math.sqrt(3) * CUBE

C3 = PointGroup.rotation(3)
difficulties = pytest.mark.parametrize("difficulty", [1, 2, 3, 4])


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def moving(task, n=16, steps=25, seed=0):
    """States in the middle of an episode of random actions."""
    env = BatchedEnv(task, n, num_threads=1, seed=seed)
    env.reset()
    env.rollout(steps, break_when_any_done=False)
    return env.state


def single(task, state, row=0):
    data = mujoco.MjData(task.model)
    data.qpos[:], data.qvel[:] = state.qpos[row], state.qvel[row]
    data.mocap_pos[:], data.mocap_quat[:] = state.mocap_pos[row], state.mocap_quat[row]
    mujoco.mj_forward(task.model, data)
    return data


def test_the_model_is_exactly_symmetric():
    task = TrifingerRepose()
    assert audit(task.model, C3, carried=task.carried).exact


def test_lengths_are_those_of_the_published_robot():
    task = TrifingerRepose()
    assert (task._side, task._axis, task._link, task._height) == (0.086, 0.0505, 0.16, 0.29)
    assert task.cube == CUBE and task._torque == 0.36


def test_a_weak_finger_is_not_symmetric():
    task = TrifingerRepose(weak_finger=1)
    assert not audit(task.model, C3, carried=task.carried).exact
    assert task.model.actuator_forcerange[3:6].tolist() == [[-0.18, 0.18]] * 3


def test_environment_commutes_with_the_turns():
    env = tasks.make_env("trifinger_repose", num_envs=16, num_threads=1, seed=0)
    report = verify(env, env.symmetry)
    assert report.passed, str(report)


def test_a_turn_takes_every_finger_to_the_next_one():
    task = TrifingerRepose()
    table = torch.eye(9, dtype=torch.float64)[[3, 4, 5, 6, 7, 8, 0, 1, 2]]
    assert [task.model.joint(i).name for i in range(9)] == list(JOINTS)
    for representation in (task.robot.joints(JOINTS), task.robot.actuators):
        assert torch.equal(representation.matrices[1].double(), table)


def test_reference_pose_is_symmetric_and_free_of_contact():
    task = TrifingerRepose()
    data = mujoco.MjData(task.model)
    mujoco.mj_forward(task.model, data)
    tips, turn = torch.from_numpy(data.site_xpos.copy()), C3.matrices[1]
    torch.testing.assert_close(tips @ turn.T, tips[[2, 0, 1]], rtol=0, atol=1e-12)
    assert data.ncon == 0
    assert data.qpos[9:11].tolist() == data.mocap_pos[0, :2].tolist() == [0.0, 0.0]


def test_fingertips_in_closed_form_are_those_of_the_model():
    task, random = TrifingerRepose(), np.random.default_rng(0)
    for _ in range(10):
        data = mujoco.MjData(task.model)
        data.qpos[:9] = random.uniform(*task.model.jnt_range[:9].T)
        data.qvel[:9] = random.normal(size=9)
        mujoco.mj_forward(task.model, data)
        state = State(torch.tensor(data.qpos)[None], torch.tensor(data.qvel)[None])
        tips, square = task.fingertips(state)
        np.testing.assert_allclose(tips[0], data.site_xpos, atol=1e-12)
        for finger in range(3):
            jacobian = np.zeros((3, task.model.nv))
            mujoco.mj_jacSite(task.model, data, jacobian, None, finger)
            assert float(square[0, finger]) == pytest.approx(((jacobian @ data.qvel) ** 2).sum())


@difficulties
def test_starts_touch_nothing(difficulty):
    task = TrifingerRepose(difficulty=difficulty, curriculum=False)
    state = task.sample_initial_state(100, generator())
    assert (state.qpos[:, 11] == CUBE + 0.001).all(), "exactly touching, rounding decides what touches"
    for row in range(100):
        assert single(task, state, row).ncon == 0


def test_no_part_of_a_finger_starts_inside_another_or_the_cube():
    """Also of those parts that do not collide in the simulation."""
    task = TrifingerRepose()
    model, state = task.model, task.sample_initial_state(10, generator())
    parts = [
        [i for i in range(model.ngeom) if model.geom(i).bodyid[0] in range(1 + 3 * k, 4 + 3 * k)]
        for k in range(3)
    ]
    cube = model.geom("cube").id
    pairs = [(a, b) for k in range(3) for a in parts[k] for b in [*parts[(k + 1) % 3], cube]]
    for row in range(10):
        data = single(task, state, row)
        assert min(mujoco.mj_geomDistance(model, data, a, b, 0.1, None) for a, b in pairs) > 0.001


@difficulties
def test_where_cube_and_goal_start(difficulty):
    task = TrifingerRepose(difficulty=difficulty, curriculum=False)
    state = task.sample_initial_state(4000, generator())
    cube, goal = state.qpos[:, 9:12], state.mocap_pos[:, 0]
    low, high = {1: (CUBE, CUBE), 2: (LIFT, LIFT), 3: (CUBE, HIGHEST), 4: (CUBE_DIAGONAL, HIGHEST)}[
        difficulty
    ]
    assert low - 1e-12 <= float(goal[:, 2].min()) and float(goal[:, 2].max()) <= high + 1e-12
    for position in (cube, goal):
        radius = position[:, :2].norm(dim=-1)
        if difficulty == 2 and position is goal:
            assert float(radius.max()) < 1e-12
        else:  # uniform: half of the area within 0.707 of the radius
            assert float(radius.max()) <= ARENA
            assert float((radius < 0.7071 * ARENA).double().mean()) == pytest.approx(0.5, abs=0.03)
            assert float(position[:, :2].mean(dim=0).norm()) < 0.005
    for sign in (state.qpos[:, 12] > 0, state.qpos[:, 15] > 0, state.mocap_quat[:, 0, 0] > 0):
        assert float(sign.double().mean()) == pytest.approx(0.5, abs=0.03), "both signs, with equal chance"


@difficulties
def test_observation_is_laid_out_as_declared(difficulty):
    task = TrifingerRepose(difficulty=difficulty)
    state = moving(task)
    parts = dict(
        zip(
            [entry.name for entry in task.layout()],
            task.observe(state)
            .double()
            .split([entry.representation.dim for entry in task.layout()], dim=1),
            strict=True,
        )
    )
    goal = state.mocap_quat[:, 0] * (difficulty == 4)  # zeros are invariant, no constant orientation is
    expected = {
        "joint positions from the starting pose": state.qpos[:, :9] - torch.tensor([0.0, 0.9, -2.0] * 3),
        "joint velocities": 0.1 * state.qvel[:, :9],
        "cube position": 10 * state.qpos[:, 9:12],
        "cube orientation": state.qpos[:, 12:16],
        "goal position": 10 * state.mocap_pos[:, 0],
        "goal orientation, zeros if it has none": goal,
        "last action": state.variables["last_action"],
    }
    assert list(parts) == list(expected)
    for name, value in expected.items():
        torch.testing.assert_close(parts[name], value, rtol=0, atol=1e-6, msg=name)


@difficulties
def test_every_term_of_the_reward_is_invariant(difficulty):
    task = TrifingerRepose(difficulty=difficulty)
    state = moving(task)
    action = torch.rand(16, 9, generator=generator()) * 2 - 1
    terms = task.reward_terms(state, action)
    assert set(terms) == set(WEIGHTS) and set(task.task_terms) <= set(terms)
    for g in range(3):
        image = task.transform_state(state, g)
        for name, value in task.reward_terms(image, task.symmetry["action"](action, g)).items():
            torch.testing.assert_close(value, terms[name], rtol=0, atol=1e-7, msg=name)
        torch.testing.assert_close(task.orientation_error(image), task.orientation_error(state))


def test_reward_is_largest_at_the_goal():
    task = TrifingerRepose(difficulty=4)
    state = task.sample_initial_state(1, generator())
    state.qpos[:, 9:12], state.qpos[:, 12:16] = state.mocap_pos[:, 0], -state.mocap_quat[:, 0]
    terms = task.reward_terms(state, torch.zeros(1, 9))
    assert float(terms["keypoints"]) == pytest.approx(WEIGHTS["keypoints"] / 4)
    assert bool(task.success(state)) and float(task.orientation_error(state)) == pytest.approx(0, abs=1e-6)
    turned = torch.tensor([[np.cos(0.25), np.sin(0.25), 0.0, 0.0]])  # by 0.5 rad, at the same place
    state.qpos[:, 12:16], state.mocap_quat[:, 0] = turned, torch.tensor([1.0, 0, 0, 0])
    assert float(task.orientation_error(state)) == pytest.approx(0.5)
    assert not bool(task.success(state))
    assert float(task.reward_terms(state, torch.zeros(1, 9))["keypoints"]) < WEIGHTS["keypoints"] / 4


def test_torque_is_damped_and_clipped_before_and_after():
    model, random = TrifingerRepose().model, np.random.default_rng(0)
    damping = np.array([0.08, 0.08, 0.04] * 3)
    for _ in range(5):
        data = mujoco.MjData(model)
        data.ctrl[:], data.qvel[:9] = random.normal(size=9), 3 * random.normal(size=9)
        mujoco.mj_forward(model, data)
        torque = np.clip(np.clip(data.ctrl, -0.36, 0.36) - damping * data.qvel[:9], -0.36, 0.36)
        np.testing.assert_allclose(data.qfrc_actuator[:9], torque, atol=1e-12)


@pytest.mark.parametrize("timestep", [0.005, 0.01])
def test_random_torques_cause_no_warning_and_the_wall_holds_the_cube(timestep):
    env = tasks.make_env("trifinger_repose", num_envs=16, num_threads=1, seed=0, physics_timestep=timestep)
    env.rollout(100, break_when_any_done=False)
    assert env.num_diverged == 0
    state = env.state
    state.qvel[:, 9:11] = torch.randn(16, 2, generator=generator()) * 0.7
    env.reset_to(state)
    env.rollout(50, break_when_any_done=False)
    assert not env.task.terminated(env.state).any()
    lost = env.state
    lost.qpos[:, 9] = 0.31
    assert env.task.terminated(lost).all()


def test_a_cube_that_is_not_carried_along_breaks_the_symmetry():
    """Negative control: conjugation (X to R X R^T) is a symmetry of a cube for quarter turns only."""
    task = TrifingerRepose()
    n, g = 16, 1
    state = task.sample_initial_state(n, generator())
    spin = torch.randn(n, 4, generator=generator(), dtype=torch.float64)
    state.qpos[:, 11], state.qpos[:, 12:16] = 0.06, spin / spin.norm(dim=-1, keepdim=True)

    def conjugated(state):
        image = task.transform_state(state, g)
        image.qpos[:, 12:16] = quaternion(C3, "conjugate")(state.qpos[:, 12:16], g)
        image.qvel[:, 12:15] = axial(C3)(state.qvel[:, 12:15], g)
        return image

    def landing(state):
        env = BatchedEnv(task, n, num_threads=1, seed=0)
        env.reset_to(state)
        for _ in range(10):
            env.simulation.step(torch.zeros(n, 9), task.substeps)
        return env.state

    after = landing(state)
    carried = task.transform_state(after, g)
    assert float((landing(task.transform_state(state, g)).qpos - carried.qpos).abs().max()) < 1e-9
    conjugate = landing(conjugated(state)).qpos[:, 9:12] - polar(C3)(after.qpos[:, 9:12], g)
    assert float(conjugate.abs().max()) > 1e-2 * CUBE
    assert float((landing(conjugated(state)).qvel - conjugated(after).qvel).abs().max()) > 1e-2


def test_randomised_mass_and_friction_stay_in_range():
    env = tasks.make_env(
        "trifinger_repose", num_envs=8, num_threads=1, seed=0, cube_mass=(0.06, 0.1), friction=(0.5, 1.5)
    )
    env.reset()
    cube = env.task.model.body("cube").id
    mass, inertia = (
        env.simulation.expand("body_mass")[:, cube],
        env.simulation.expand("body_inertia")[:, cube],
    )
    assert float(mass.min()) >= 0.06 and float(mass.max()) <= 0.1 and len(mass.unique()) == 8
    torch.testing.assert_close(inertia, (mass * (2 * CUBE) ** 2 / 6)[:, None].expand(8, 3))
    table = env.simulation.expand("geom_friction")[:, env.task.model.geom("table").id, 0]
    assert (
        float(table.min()) >= 0.5 * 0.55 and float(table.max()) <= 1.5 * 0.55 and len(table.unique()) == 8
    )


def test_metrics_tell_how_whole_episodes_ended():
    env = tasks.make_env("trifinger_repose", num_envs=4, num_threads=1, seed=0, episode_seconds=0.1)
    assert np.isnan(env.task.metrics()["success"])
    env.rollout(6, break_when_any_done=False)
    state = env.state
    env.task.restart(state, generator())
    env.rollout(5, break_when_any_done=False)
    env.task.restart(env.state, generator())
    saved = env.task.state_dict()
    other = TrifingerRepose()
    other.load_state_dict(saved)
    assert other.metrics() == env.task.metrics() and set(saved) == {"success", "error", "level"}
    assert 0 <= saved["success"] <= 1 and 0 < saved["error"] < 2 * ARENA


def test_success_moves_starts_outwards_and_failure_inwards():
    task = TrifingerRepose()
    state = task.sample_initial_state(300, generator())
    assert float(state.qpos[:, 9:11].norm(dim=-1).max()) < 0.4 * ARENA
    state.variables["level"][:] = 3.0
    state.time[:] = 5.0
    state.qpos[:100, 9:12] = state.mocap_pos[:100, 0]
    state.qpos[100:, 9:12] = state.mocap_pos[100:, 0] + torch.tensor([0.05, 0.0, 0.0])
    state.qpos[200:, 10] += 0.05
    after = task.restart(state, generator()).variables["level"][:, 0]
    assert after.tolist() == [4.0] * 100 + [3.0] * 100 + [2.0] * 100
    state.time[:] = 2.0  # interrupted episodes say nothing
    assert (task.restart(state, generator()).variables["level"] == 3.0).all()


def turned_about_the_vertical(quaternion, angle):
    w, x, y, z = quaternion.unbind(-1)
    cos, sin = math.cos(angle / 2), math.sin(angle / 2)
    return torch.stack([cos * w - sin * z, cos * x - sin * y, cos * y + sin * x, cos * z + sin * w], dim=-1)


def test_a_goal_on_the_table_can_have_a_heading():
    task = TrifingerRepose(yaw=1.0)
    state = task.sample_goal_state(2000, generator())
    error = task.orientation_error(state)
    assert 0.95 < float(error.max()) <= 1.0 and float(error.min()) < 0.05
    assert float(task.orientation_error(task.sample_initial_state(500, generator())).max()) <= 1 / 8
    torch.testing.assert_close(state.mocap_quat[:, 0, 1:3], torch.zeros(2000, 2).double())
    assert (task.observe(state)[:, 28:32] == state.mocap_quat[:, 0].float()).all()
    for quaternion_ in (state.qpos[:, 12:16], state.mocap_quat[:, 0]):  # both signs, equally often
        assert float((quaternion_[:, 0] > 0).double().mean()) == pytest.approx(0.5, abs=0.05)
    assert float((state.qpos[:, 12:16] * state.mocap_quat[:, 0]).sum(-1).min()) > 0, "signs agree"
    state.qpos[:, 9:12] = state.mocap_pos[:, 0]
    assert (task.success(state) == (error < 0.4)).all()
    state.mocap_quat[:] = state.qpos[:, None, 12:16]
    state.mocap_quat[1000:, 0] = turned_about_the_vertical(state.qpos[1000:, 12:16], 1.2)
    state.variables["level"][:], state.time[:] = 3.0, 5.0
    after = task.restart(state, generator()).variables["level"][:, 0]
    assert after.tolist() == [4.0] * 1000 + [2.0] * 1000
    assert set(task.metrics()) == {"success", "error", "level", "angle"}


@pytest.mark.parametrize(
    "wrong",
    [
        {"difficulty": 5},
        {"difficulty": 4, "yaw": 1.0},
        {"yaw": 4.0},
        {"radius": 0.2},
        {"weak_finger": 3},
        {"friction": (0.0, 1.0)},
    ],
)
def test_wrong_arguments_are_named(wrong):
    with pytest.raises(ValueError, match=list(wrong)[-1]):
        TrifingerRepose(**wrong)
