"""ANYmal in numbers: kinematics and contact against MuJoCo, gait terms by hand, edits of the model."""

import inspect
from typing import get_type_hints

import mujoco
import pytest
import torch
from tensordict import TensorDict
from typing_extensions import Unpack

import tasks
from tasks import base
from tasks.anymal import JOINTS, LEGS, Anymal, RobotArguments
from tasks.anymal_climb import AnymalClimb
from tasks.anymal_push import AnymalPush
from tasks.environment import BatchedEnv
from tests.task_helpers import actions, assert_same, make, play, reached, stagger
from tests.test_mujoco_derive import LEGS as IMAGES
from tests.test_mujoco_derive import hinges, published_anymal
from torchrl_sym import Symmetry
from torchrl_sym.mujoco import verify

robots = pytest.mark.parametrize("name", ["anymal_push", "anymal_climb"])


def tumbling(task, n=32, seed=0):
    """Robots anywhere, in any orientation and with any joint angles."""
    generator = torch.Generator().manual_seed(seed)
    state = task.sample_initial_state(n, generator)
    state.qpos[:, 0:3] += torch.rand(n, 3, generator=generator, dtype=torch.float64) * 2 - 1
    quaternion = torch.randn(n, 4, generator=generator, dtype=torch.float64)
    state.qpos[:, 3:7] = quaternion / quaternion.norm(dim=-1, keepdim=True)
    state.qpos[:, 7:19] += torch.rand(n, 12, generator=generator, dtype=torch.float64) * 2 - 1
    state.qvel = torch.randn(state.qvel.shape, generator=generator, dtype=torch.float64)
    state.variables["last_action"] = torch.rand(n, 12, generator=generator, dtype=torch.float64) * 2 - 1
    return state


def kinematics(task, state, row):
    data = mujoco.MjData(task.model)
    data.qpos[:], data.qvel[:] = state.qpos[row], state.qvel[row]
    data.mocap_pos[:], data.mocap_quat[:] = state.mocap_pos[row], state.mocap_quat[row]
    mujoco.mj_forward(task.model, data)
    return data


@robots
@pytest.mark.parametrize("element", IMAGES)
def test_joints_and_actuators_follow_the_published_tables(name, element):
    robot = base.create(name).robot
    for kind in ("joint", "actuator"):
        table = {a: b for a, b in hinges(robot.table(kind, element)).items() if a in JOINTS}
        assert table == published_anymal(element)


@robots
def test_feet_are_where_mujoco_puts_them(name):
    task = base.create(name)
    state = tumbling(task)
    feet = task.feet(state)
    for row in range(len(state)):
        data = kinematics(task, state, row)
        geoms = torch.stack([torch.from_numpy(data.geom(f"{leg}_foot").xpos) for leg in LEGS])
        torch.testing.assert_close(feet[row], geoms, rtol=0, atol=1e-12)


@robots
def test_the_robot_is_observed_as_mujoco_measures_it(name):
    task = base.create(name)
    state = tumbling(task)
    observation = task.observe(state).double()
    for row in range(len(state)):
        data = kinematics(task, state, row)
        turn = torch.from_numpy(data.body("base").xmat.reshape(3, 3).copy())
        velocity = torch.from_numpy(data.qvel[:6].copy())
        expected = torch.cat(
            [
                2 * turn.T @ velocity[:3],
                0.25 * velocity[3:],
                -turn.T[:, 2],
                state.qpos[row, 7:19] - task._pose.values,
            ]
        )
        torch.testing.assert_close(observation[row, :21], expected, rtol=1e-6, atol=1e-6)
    velocity, last = state.qvel[:, 6:18] * 0.05, state.variables["last_action"] * 4
    torch.testing.assert_close(observation[:, 21:45], torch.cat([velocity, last], dim=1), rtol=0, atol=1e-6)
    assert [task.model.joint(1 + j).name for j in range(12)] == list(JOINTS)
    assert [task.model.actuator(j).name for j in range(12)] == list(JOINTS)


@robots
def test_a_start_stands_with_its_lowest_foot_5_mm_above_the_ground(name):
    task = base.create(name)
    state = task.sample_initial_state(200, torch.Generator().manual_seed(0))
    lowest = task.feet(state)[..., 2].amin(dim=1) - task.foot_radius
    torch.testing.assert_close(lowest, torch.full_like(lowest, 0.005), rtol=0, atol=1e-12)
    assert ((state.qpos[:, 7:19] - task._pose.values).abs() <= 0.1).all()
    stood = reached(task, state.rows(slice(40)), steps=50)
    assert len(stood) == 40, "a robot that is left alone must not fall"
    assert task.touching(stood).all()


def test_feet_touch_the_ground_where_mujoco_finds_contact():
    task = AnymalPush()
    start = task.sample_goal_state(24, torch.Generator().manual_seed(0))
    state = reached(task, start, steps=25, scale=0.5)
    gap = task.feet(state)[..., 2] - task.foot_radius
    assert torch.equal(task.touching(state), gap < 0.01)
    agreed = 0
    for row in range(len(state)):
        data = kinematics(task, state, row)
        pairs = [{task.model.geom(int(g)).name for g in pair} for pair in data.contact.geom]
        for i, leg in enumerate(LEGS):
            if {f"{leg}_foot", "ground"} in pairs:
                assert task.touching(state)[row, i], f"{leg}_foot, row {row}"
                agreed += 1
    assert agreed > 10


def test_time_in_the_air_is_counted_per_foot_and_paid_once_on_landing():
    task = AnymalPush()
    state = task.sample_goal_state(6, torch.Generator().manual_seed(0))
    state.qpos[:, 7:19] = task._pose.values
    state.qpos[:, 2] = task.foot_radius - task.feet_in_base(state.qpos[:, 7:19])[..., 2].amin(dim=1)
    lifted = torch.tensor([0, 0, 0, 0, 1, 1], dtype=torch.bool)
    state.qpos[lifted, 8] += 0.8
    state.qpos[lifted, 9] -= 0.6
    air = torch.tensor([0.0, 0.05, 0.3, 2.0, 0.3, 2.0], dtype=torch.float64)
    state.variables["air_time"][:, 0] = air
    assert task.touching(state)[:, 0].tolist() == [True] * 4 + [False] * 2
    paid = task.first_touch(state)
    torch.testing.assert_close(paid, torch.tensor([0, 0, 0.2, 0.3, 0, 0], dtype=torch.float64))
    after = task.update(state, torch.zeros(6, 12))["air_time"]
    torch.testing.assert_close(after[:, 0], torch.tensor([0, 0, 0, 0, 0.32, 2.02], dtype=torch.float64))
    assert not after[:, 1:].any()
    state.variables["air_time"] = after
    assert not task.first_touch(state).any(), "a step is paid once"


@robots
def test_steps_never_cost_and_pay_at_most_30_ms_a_foot(name):
    task = base.create(name)
    generator = torch.Generator().manual_seed(0)
    state = task.sample_initial_state(500, generator)
    state.variables["air_time"] = torch.rand(500, 4, generator=generator, dtype=torch.float64) * 3
    paid = task.first_touch(state)
    assert (paid >= 0).all() and (paid <= 4 * 0.3 + 1e-12).all() and paid.max() > 1


def test_constants_are_those_of_the_published_robot():
    task = AnymalPush()
    assert (task.foot_radius, task.cube) == (0.03, 0.3)
    assert (task._stiffness, task._damping, task._torque) == (80.0, 2.0, 80.0)
    weak = AnymalPush(weak_leg="LF")  # the reward is that of the robot that designers have in mind
    assert weak._torque == 80.0
    left = [
        [0.2999, 0.104, 0.0],
        [0.0599, 0.08381, 0.0],
        [0.0, 0.1003, -0.285],
        [0.08795, 0.01305, -0.31547],
    ]
    assert task._legs.values[..., 0].tolist() == left


def test_effort_by_hand():
    task = AnymalPush()
    state = task.sample_goal_state(1, torch.Generator().manual_seed(0))
    state.qpos[:, 7:19] = task._pose.values
    state.qvel[:, 6] = 3.0
    state.variables["last_velocity"][:, 0] = 1.0
    action = torch.zeros(1, 12)
    action[0, 1], action[0, 2] = 0.25, 5.0  # the second is clipped to 1, its torque to 80 N m
    effort = task.effort(state, action)
    assert effort["torque"].item() == pytest.approx(6.0**2 + 40.0**2 + 80.0**2)
    assert effort["acceleration"].item() == pytest.approx((2.0 / 0.02) ** 2)
    assert effort["action_rate"].item() == pytest.approx(0.5**2 + 2.0**2)


def test_fallen_means_tilted_by_60_degrees_or_low():
    task = AnymalPush()
    state = task.sample_goal_state(5, torch.Generator().manual_seed(0))
    tilt = torch.tensor([0.0, 59.0, 61.0, 180.0, 0.0], dtype=torch.float64).deg2rad()
    state.qpos[:, 3:7] = 0
    state.qpos[:, 3], state.qpos[:, 4] = (tilt / 2).cos(), (tilt / 2).sin()
    state.qpos[4, 2] = 0.21
    assert task.fallen(state, 0.22).tolist() == [False, False, True, True, True]
    assert torch.equal(task.terminated(state), task.fallen(state, 0.22))


def test_turning_is_the_yaw_travelled_and_the_same_for_mirror_images():
    task = AnymalPush()
    state = tumbling(task)
    turning = task.behaviour(state)["turning"]
    vertical = [
        torch.from_numpy(kinematics(task, state, row).body("base").xmat[6:].copy()) for row in range(32)
    ]
    spin = (torch.stack(vertical) * state.qvel[:, 3:6]).sum(-1)
    torch.testing.assert_close(turning, 0.02 * spin.abs())
    for g in range(4):
        image = task.behaviour(task.transform_state(state, g))["turning"]
        torch.testing.assert_close(image, turning)


def test_a_payload_is_fixed_on_the_base_and_touches_nothing():
    plain = AnymalPush().model
    loaded = AnymalPush(payload=3.0, payload_position=(0.1, -0.05, 0.2)).model
    assert loaded.body("payload").mass == pytest.approx(3.0)
    assert loaded.body("payload").pos.tolist() == [0.1, -0.05, 0.2]
    assert loaded.body_mass.sum() == pytest.approx(plain.body_mass.sum() + 3.0)
    payload = loaded.geom("payload")
    assert payload.contype == payload.conaffinity == 0


def test_a_weak_leg_has_half_the_force_and_the_others_all_of_it():
    weak = AnymalPush(weak_leg="RH").model
    for joint in JOINTS:
        limit = 40.0 if joint.startswith("RH") else 80.0
        assert weak.actuator(joint).forcerange.tolist() == [-limit, limit]
    assert AnymalPush(physics_timestep=0.01).substeps == 2


@pytest.mark.parametrize(
    "asymmetry",
    [
        {"payload": 2.0, "payload_position": (0.1, 0.0, 0.1)},
        {"weak_leg": "LF"},
    ],
    ids=str,
)
def test_verify_finds_an_asymmetric_robot_in_its_dynamics(asymmetry):
    env = make("anymal_push", num_envs=8, **asymmetry)
    report = verify(env, env.symmetry, tolerance=1e-9, states=8)
    assert report.worst.part == "dynamics" and report.worst.value > 1e-4, str(report)


def test_a_payload_above_the_centre_keeps_the_symmetry():
    env = make("anymal_push", num_envs=8, payload=5.0)
    report = verify(env, env.symmetry, tolerance=1e-9, states=8)
    assert report.passed, str(report)


def swapped(robot):
    """A representation that takes the left front leg for the right hind one."""
    order = {"LF": "RH", "RH": "LF"}
    return robot.joints([f"{order.get(j[:2], j[:2])}{j[2:]}" for j in JOINTS])


class WrongLegObserved(AnymalPush):
    def observe(self, state):
        """The numbers of the left front and left hind leg change places."""
        order = [*range(9), 15, 16, 17, 12, 13, 14, 9, 10, 11, *range(18, self.observation_size)]
        return super().observe(state)[:, order]


def test_swapped_legs_are_caught():
    env = BatchedEnv(WrongLegObserved(), 8, num_threads=1, seed=0)
    report = verify(env, env.symmetry, tolerance=1e-9, states=8)
    assert report.worst.part == "kinematics", str(report)


def test_swapped_legs_in_the_representation_are_caught():
    env = BatchedEnv(AnymalPush(), 8, num_threads=1, seed=0)
    parts = {"observation": env.symmetry["observation"], "action": swapped(env.task.robot)}
    report = verify(env, Symmetry(env.symmetry.group, parts), tolerance=1e-9, states=8)
    assert report.worst.part == "dynamics", str(report)


RANDOM = {"friction": (0.5, 1.2), "added_mass": (-2.0, 4.0)}


@robots
def test_physics_is_drawn_per_row_and_only_for_rows_that_start(name):
    env = make(name, num_envs=6, **RANDOM)
    nominal = env.task.model.body("base").mass.item()
    td = env.reset()
    friction = env.simulation.expand("geom_friction")
    mass = env.simulation.expand("body_mass")[:, env.task.model.body("base").id]
    before = friction.clone(), mass.clone()
    assert len(friction[:, 0, 0].unique()) == len(mass.unique()) == 6
    factor = friction[:, :, 0] / torch.from_numpy(env.task.model.geom_friction[:, 0])
    torch.testing.assert_close(factor, factor[:, :1].expand_as(factor))  # the same for all geoms of a row
    assert (factor >= 0.5).all() and (factor <= 1.2).all()
    assert (mass >= nominal - 2).all() and (mass <= nominal + 4).all()
    mask = torch.tensor([True, False, False, True, False, False])
    td["_reset"] = mask[:, None]
    env.reset(td)
    for values, old in zip((friction, mass), before, strict=True):
        changed = (values != old).reshape(6, -1).any(dim=1)
        assert torch.equal(changed, mask)


@robots
def test_drawn_physics_is_felt_saved_and_restored_and_the_same_on_any_number_of_threads(name):
    def env(seed, **kwargs):
        return make(name, num_envs=4, seed=seed, episode_seconds=0.3, **kwargs)

    sequence = 0.3 * actions(env(0), 24)
    first = env(0, **RANDOM)
    whole = play(first, stagger(first), sequence)  # episodes that start later draw physics of their own
    plain = env(0)
    assert not torch.equal(play(plain, stagger(plain), sequence)["observation"], whole["observation"])
    threaded = tasks.make_env(name, num_envs=4, num_threads=3, seed=0, episode_seconds=0.3, **RANDOM)
    assert_same(play(threaded, stagger(threaded), sequence), whole)
    first = env(0, **RANDOM)
    play(first, stagger(first), sequence[:10])
    second = env(5, **RANDOM)
    play(second, second.reset(), sequence[:3])
    second.restore_state(first.save_state())
    assert_same(play(second, second.reset(), sequence[10:]), whole[10:])


def test_without_ranges_nothing_is_drawn():
    env = make("anymal_push", num_envs=2)
    env.reset()
    assert set(env.save_state()["simulation"]) == {"rows"}


@pytest.mark.parametrize(
    ("kwargs", "message"),
    [
        ({"weak_leg": "FL"}, r"expected one of \['LF', 'RF', 'LH', 'RH'\], got 'FL'"),
        ({"payload": -1.0}, r"payload: expected a finite number of at least 0, got -1.0"),
        ({"payload": float("nan")}, "payload: expected a finite number of at least 0, got nan"),
        ({"friction": (1.0, 0.5)}, r"friction: expected a rising range above 0, got \(1.0, 0.5\)"),
        ({"friction": (0.0, 0.5)}, r"friction: expected a rising range above 0, got \(0.0, 0.5\)"),
        ({"added_mass": (-40.0, -35.0)}, r"added_mass: expected a rising range above -26.373"),
        ({"added_mass": (2.0, -2.0)}, r"added_mass: expected a rising range.*got \(2.0, -2.0\)"),
        ({"physics_timestep": 0.015}, r"multiple of the model's timestep 0.015 s, got 0.02 s; change"),
        (
            {"physics_timestep": 0.0},
            "physics_timestep: expected .* of at least 1e-06, got 0.0",
        ),
        (
            {"physics_timestep": -0.01},
            "physics_timestep: expected .* of at least 1e-06, got -0.01",
        ),
        ({"episode_seconds": 0.01}, "at least one control step"),
        ({"episode_seconds": float("inf")}, "episode_seconds: expected a finite number, got inf"),
    ],
    ids=str,
)
@robots
def test_arguments_that_make_no_sense_are_refused(name, kwargs, message):
    with pytest.raises(ValueError, match=message):
        base.create(name, **kwargs)


@robots
@pytest.mark.parametrize("function", [tasks.make_env, tasks.load])
def test_unknown_arguments_list_inherited_ones_too(name, function):
    with pytest.raises(TypeError, match=r"'curriculum'.*'payload'.*'weak_leg'.*got 'gravity'"):
        function(name, gravity=3.0)


def test_signatures_of_the_robots_tasks_say_what_the_robot_takes():
    """Type checkers read the one, the interpreter the other."""
    robot = inspect.signature(Anymal.__init__, eval_str=True).parameters
    declared = get_type_hints(RobotArguments)
    assert declared == {name: p.annotation for name, p in robot.items() if name != "self"}
    for task in (AnymalPush, AnymalClimb):
        hints = get_type_hints(task.__init__, include_extras=True)
        assert hints["robot"] == Unpack[RobotArguments]


def test_targets_of_the_joints_are_clipped():
    env = make("anymal_push", num_envs=2)
    state = env.task.sample_goal_state(2, torch.Generator().manual_seed(0))
    env.reset_to(state)
    env.step(TensorDict(action=torch.full((2, 12), 9.0), batch_size=[2]))
    torch.testing.assert_close(env.simulation.ctrl, (env.task._pose.values + 2.0).expand(2, 12))
    assert (env.state.variables["last_action"] == 1).all()
