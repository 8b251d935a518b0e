"""What the tasks of the quadruped ANYmal share: its observation, control, gait and regularisation.

The robot is observed in its own base frame, so that only the part of a symmetry that relabels its body is
seen by the policy. Quantities of the base come from the floating joint, feet from closed-form kinematics;
nothing is read from derived fields of the simulator, which lag by one physics step.

No term of a reward tells a direction from its mirror image, or one leg from another: all are norms, or even
functions of the state.
"""

from __future__ import annotations

import mujoco
import numpy as np
import torch
from torch import Tensor
from typing_extensions import TypedDict  # unpacked in signatures since Python 3.11

from tasks.base import Edit, Task, check_timestep
from tasks.constants import Constant
from tasks.draws import Range, check_range, draws, put, uniform
from tasks.observation import Entry
from tasks.rotations import matrix_of
from tasks.state import State
from torchrl_sym import PointGroup, Representation, checks
from torchrl_sym.representations import axial, invariant, polar

LEGS = ("LF", "RF", "LH", "RH")
JOINTS = tuple(f"{leg}_{joint}" for leg in LEGS for joint in ("HAA", "HFE", "KFE"))
# Standing pose, rad (legged_gym), and what an action of 1 adds to it. The reach is wide because a position
# servo exerts force only by a target beyond the leg's present position.
DEFAULT_POSE = (0.0, 0.4, -0.8, 0.0, 0.4, -0.8, 0.0, -0.4, 0.8, 0.0, -0.4, 0.8)
ACTION_RANGE = 2.0
# What observations are multiplied by (legged_gym); the last action is seen in steps of 0.5 rad.
LINEAR_SCALE, ANGULAR_SCALE, JOINT_VELOCITY_SCALE, ACTION_SCALE = 2.0, 0.25, 0.05, 4.0
# A foot this close to the ground counts as standing on it, m.
TOUCH_DISTANCE = 0.01


class RobotArguments(TypedDict, total=False):
    """Keyword arguments of :class:`Anymal`, for the signatures of tasks that hand them on."""

    episode_seconds: float | None
    physics_timestep: float
    friction: Range | None
    added_mass: Range | None
    payload: float
    payload_position: tuple[float, float, float]
    weak_leg: str | None


class Anymal(Task):
    """Base of the tasks with ANYmal: 12 joint targets in, 45 proprioceptive numbers out.

    Action: joint position targets relative to the standing pose, over 2 rad, clipped to [-1, 1].

    Args:
        episode_seconds: length of an episode, s; None for the task's own.
        physics_timestep: 0.005 s; 0.01 s simulates 1.6 times as fast, good enough for most of a training,
            but its contacts are softer: finish in 0.005 s, or with little noise, and check there.
        friction: range of a factor on all sliding friction, drawn per episode; None keeps the model's.
        added_mass: range of the mass added to the base, kg, drawn per episode; None adds none.
        payload: mass in kg fixed on top of the base at ``payload_position``, for studies of asymmetry.
        payload_position: where, in the base frame, m. Off the centre, the robot is no longer symmetric.
        weak_leg: name of a leg (``"LF"``, ...) whose drives have half their strength, for such studies.

    Raises:
        ValueError: no such leg, or a range that is not positive.
    """

    control_timestep = 0.02
    observation_limit = 20.0  # a robot that tumbles must not blow up the networks
    max_velocity = 100.0

    def __init__(
        self,
        *,
        episode_seconds: float | None = None,
        physics_timestep: float = 0.005,
        friction: Range | None = None,
        added_mass: Range | None = None,
        payload: float = 0.0,
        payload_position: tuple[float, float, float] = (0.0, 0.0, 0.1),
        weak_leg: str | None = None,
    ) -> None:
        if weak_leg is not None:
            checks.one_of("weak_leg", weak_leg, LEGS)
        payload = checks.real("payload", payload, 0.0)
        place = checks.array("payload_position", payload_position)
        if place.shape != (3,):
            raise ValueError(f"payload_position: expected (x, y, z) in m, got {payload_position}")
        self.friction = check_range("friction", friction, above=0.0)
        edit = _edit(check_timestep(physics_timestep), payload, place.tolist(), weak_leg)
        super().__init__(PointGroup.klein_four(), episode_seconds=episode_seconds, edit=edit)
        self._mass = float(self.model.body("base").mass[0])
        self.added_mass = check_range("added_mass", added_mass, above=-self._mass)
        self._pose = Constant(DEFAULT_POSE)
        self._read_legs()
        self._read_drives()

    def _read_legs(self) -> None:
        """Where hip, thigh, knee and foot of every leg are in the part above them, m."""
        model = self.model
        parts = [[model.body(f"{leg}_{part}").pos for leg in LEGS] for part in ("hip", "thigh", "shank")]
        parts.append([model.geom(f"{leg}_foot").pos for leg in LEGS])
        self._legs = Constant(np.array(parts).transpose(0, 2, 1))  # (part, axis, leg)
        self.foot_radius = float(model.geom(f"{LEGS[0]}_foot").size[0])

    def _read_drives(self) -> None:
        """Gains (N m/rad, N m s/rad) and largest torque (N m) of a joint; all joints have the same."""
        drive, joint = self.model.actuator(JOINTS[0]), self.model.joint(JOINTS[0])
        self._stiffness, self._damping = float(drive.gainprm[0]), -float(drive.biasprm[2])
        self._torque = float(self.model.jnt_actfrcrange[joint.id, 1])

    def proprioception(self) -> tuple[Entry, ...]:
        """The first 45 numbers of every observation."""
        group, robot = self.robot.group, self.robot
        joints = robot.joints(JOINTS)
        by_joint = "permutation and signs of the joints"

        def velocity(state: State) -> Tensor:
            return into_base(rotation(state), state.qvel[:, 0:3])

        return (
            Entry("linear velocity", velocity, polar(group), "m/s", "base", "polar vector", LINEAR_SCALE),
            Entry(
                "angular velocity", lambda state: state.qvel[:, 3:6],
                axial(group), "rad/s", "base", "axial vector", ANGULAR_SCALE,
            ),
            Entry(
                "direction of gravity", lambda state: -rotation(state)[:, 2],
                polar(group), "1", "base", "polar vector",
            ),
            Entry(
                "joint positions from the standing pose",
                lambda state: state.qpos[:, 7:19] - self._pose.like(state.qpos),
                joints, "rad", "joints", by_joint,
            ),
            Entry(
                "joint velocities", lambda state: state.qvel[:, 6:18],
                joints, "rad/s", "joints", by_joint, JOINT_VELOCITY_SCALE,
            ),
            Entry(
                "last action", lambda state: state.variables["last_action"],
                robot.actuators, "2 rad", "joints", by_joint, ACTION_SCALE,
            ),
        )  # fmt: skip

    def variables(self) -> dict[str, Representation]:
        """Last action, joint velocities one step ago, time in the air of every foot, curriculum level."""
        group = self.robot.group
        knees = self.robot.joints([f"{leg}_KFE" for leg in LEGS]).absolute()
        return {
            "last_action": self.robot.actuators,
            "last_velocity": self.robot.joints(JOINTS),
            "air_time": knees,
            "level": invariant(group, 1),
        }

    def standing(self, n: int, yaw: Tensor, generator: torch.Generator | None) -> State:
        """Robots in about the standing pose at the origin, their lowest foot 5 mm above the ground.

        Args:
            n: how many.
            yaw: heading, ``(n,)``, rad.
            generator: source of the noise on the joints.
        """
        noise = draws(n, 12, generator) * 0.2 - 0.1
        qpos = noise.new_zeros(n, self.model.nq)
        qpos[:, 7:19] = self._pose.like(noise) + noise
        qpos[:, 3], qpos[:, 6] = (yaw / 2).cos(), (yaw / 2).sin()
        qpos[:, 2] = self.foot_radius + 0.005 - self.feet_in_base(qpos[:, 7:19])[..., 2].amin(dim=1)
        zeros, mocap_quat = noise.new_zeros(n, 12), noise.new_zeros(n, self.model.nmocap, 4)
        mocap_quat[..., 0] = 1.0
        return State(
            qpos=qpos,
            qvel=noise.new_zeros(n, self.model.nv),
            mocap_pos=noise.new_zeros(n, self.model.nmocap, 3),
            mocap_quat=mocap_quat,
            variables={
                "last_action": zeros,
                "last_velocity": zeros.clone(),
                "air_time": zeros[:, :4].clone(),
                "level": zeros[:, :1].clone(),
            },
        )

    def control(self, action: Tensor, state: State) -> Tensor:
        """Joint position targets, rad."""
        target = action.double().clamp(-1.0, 1.0) * ACTION_RANGE
        return target + self._pose.like(target)

    def update(self, state: State, action: Tensor) -> dict[str, Tensor]:
        """Remember the action, the joint velocities, and how long each foot has been in the air."""
        air = (state.variables["air_time"] + self.control_timestep) * ~self.touching(state)
        return {
            "last_action": action.double().clamp(-1.0, 1.0),
            "last_velocity": state.qvel[:, 6:18],
            "air_time": air,
        }

    def feet_in_base(self, joints: Tensor) -> Tensor:
        """Centres of the feet in the base frame, ``(n, 12)`` joint angles to ``(n, 4, 3)``, m."""
        hip, thigh, knee, foot = self._legs.like(joints)  # (axis, leg) each
        q1, q2, q3 = joints.unflatten(-1, (4, 3)).unbind(-1)
        q23 = q2 + q3
        sin, cos = q23.sin(), q23.cos()
        x = knee[2] * q2.sin() + foot[0] * cos + foot[2] * sin + thigh[0]
        z = knee[2] * q2.cos() - foot[0] * sin + foot[2] * cos
        y = thigh[1] + knee[1] + foot[1]
        sin, cos = q1.sin(), q1.cos()
        return torch.stack([x + hip[0], y * cos - z * sin + hip[1], y * sin + z * cos], dim=-1)

    def feet(self, state: State) -> Tensor:
        """Centres of the feet in the world frame, ``(n, 4, 3)``, m."""

        def compute() -> Tensor:
            return self.feet_in_base(state.qpos[:, 7:19]) @ rotation(state).mT + state.qpos[:, None, 0:3]

        return state.shared("feet", compute)

    def ground(self, state: State, points: Tensor) -> Tensor:
        """Height of the ground at points ``(n, p, 2 or more)`` of the world frame, ``(n, p)``, m."""
        return points.new_zeros(points.shape[:2])

    def touching(self, state: State) -> Tensor:
        """Whether each foot stands on something, ``(n, 4)``."""

        def compute() -> Tensor:
            feet = self.feet(state)
            return feet[..., 2] - self.ground(state, feet) < self.foot_radius + TOUCH_DISTANCE

        return state.shared("touching", compute)

    def first_touch(self, state: State, longest: float = 0.4, shortest: float = 0.1) -> Tensor:
        """Air time of the feet that touch down in this step, ``(n,)``, s: a reward for taking steps.

        Capped, and never negative: a penalty for short steps makes contact chatter so expensive that
        falling at once pays.
        """
        air = state.variables["air_time"]
        landed = self.touching(state) & (air > 0)
        return ((air.clamp(max=longest) - shortest).clamp(min=0.0) * landed).sum(dim=-1)

    def effort(self, state: State, action: Tensor) -> dict[str, Tensor]:
        """Regularisation: squares of torques, joint accelerations and changes of the action, ``(n,)``."""
        variables, velocity = state.variables, state.qvel[:, 6:18]
        stretch = self.control(action, state) - state.qpos[:, 7:19]
        torque = self._stiffness * stretch - self._damping * velocity
        acceleration = (velocity - variables["last_velocity"]) / self.control_timestep
        change = (action.double().clamp(-1.0, 1.0) - variables["last_action"]) * ACTION_RANGE
        return {
            "torque": torque.clamp(-self._torque, self._torque).square().sum(-1),
            "acceleration": acceleration.square().sum(-1),
            "action_rate": change.square().sum(-1),
        }

    def behaviour(self, state: State) -> dict[str, Tensor]:
        """How far the robot turns about the vertical, rad: to and fro adds up."""
        yaw_rate = (rotation(state)[:, 2] * state.qvel[:, 3:6]).sum(dim=-1)
        return {"turning": yaw_rate.abs() * self.control_timestep}

    def fallen(self, state: State, lowest: float) -> Tensor:
        """Tilted by more than 60 degrees, or with the base below a height over the ground, ``(n,)``."""
        base = state.qpos[:, None, 0:3]
        height = base[:, 0, 2] - self.ground(state, base)[:, 0]
        return (rotation(state)[:, 2, 2] < 0.5) | (height < lowest)

    def randomize(self, simulation, ids: Tensor, generator: torch.Generator | None) -> None:
        """Friction and mass; scalars, hence invariant under the group."""
        if self.friction is not None:
            self.scale_friction(simulation, ids, uniform(self.friction, len(ids), generator))
        if self.added_mass is not None:
            body = self.model.body("base").id
            mass = self._mass + uniform(self.added_mass, len(ids), generator)
            put(simulation.expand("body_mass")[:, body], ids, mass)
            simulation.refresh(ids)


def rotation(state: State) -> Tensor:
    """Rotation of the base, ``(n, 3, 3)``: base frame to world."""
    return state.shared("rotation", lambda: matrix_of(state.qpos[:, 3:7]))


def into_base(turn: Tensor, vector: Tensor) -> Tensor:
    """World vectors ``(n, 3)`` in the base frame, given the base's rotation."""
    return (turn * vector[:, :, None]).sum(dim=1)


def _edit(timestep: float, payload: float, position: list[float], weak_leg: str | None) -> Edit:
    def edit(spec) -> None:
        spec.option.timestep = timestep
        if payload > 0:
            body = spec.body("base").add_body(name="payload", pos=position)
            sphere = mujoco.mjtGeom.mjGEOM_SPHERE  # pyright: ignore[reportAttributeAccessIssue]
            body.add_geom(
                name="payload", type=sphere, size=[0.08, 0, 0], mass=payload, contype=0, conaffinity=0
            )
        if weak_leg is not None:
            for joint in ("HAA", "HFE", "KFE"):
                spec.actuator(f"{weak_leg}_{joint}").forcerange = [-40.0, 40.0]

    return edit
