"""Trifinger-Repose: three fingers bring a cube to a goal, wherever on the table or above it.

The three fingers of TriFinger Pro are copies of one, turned by 120 degrees, and so are the task's three
equivalent goals. The fingers are chiral: a turn is the only symmetry. Difficulties follow the Real Robot
Challenge: a place on the table, a lift in the middle, a place in the air, place and orientation in the air.

No term of the reward prefers a direction or a finger: all are norms, or sums over fingers. A cube does not
look the same after a turn by 120 degrees and need not: the turn of the world carries it along
(`torchrl_sym.mujoco.derive`), and with it the goal. Its quaternion changes sign on the way, or three turns
would not add up to none; starts draw both signs with equal chance, so that turned starts are as likely.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from tasks.base import Edit, Task, check_timestep, register
from tasks.constants import Constant
from tasks.curriculum import Curriculum
from tasks.draws import Range, check_range, draws, put, uniform
from tasks.observation import Entry
from tasks.rotations import matrix_of
from tasks.state import State
from torchrl_sym import PointGroup, Representation, checks
from torchrl_sym.representations import invariant, polar, quaternion

FINGERS = ("0", "1", "2")
JOINTS = tuple(f"{joint}{finger}" for finger in FINGERS for joint in ("swing", "lift", "knee"))
# How far joints start from the model's reference pose, which observed positions are relative to, rad.
START_NOISE = 0.1
# What observations are multiplied by: a fingertip's m and rad/s are far from 1.
JOINT_VELOCITY_SCALE, POSITION_SCALE = 0.1, 10.0
ARENA = 0.1387  # the cube's centre starts, and has its goal, within this distance of the middle, m
# Share of that radius which starts and goals are drawn from at the first level; it grows to 1 at the last.
FIRST_SHARE, LAST_LEVEL = 0.4, 7
# An episode that ends farther from its goal, m, or turned farther from it, rad, lowers the level.
FAILURE_DISTANCE, FAILURE_ANGLE = 0.06, 0.8
LIFT, HIGHEST = 0.0825, 0.1  # goal of difficulty 2 and highest goal of 3 and 4, m
# Success: position error, m, at difficulty 1 and above; orientation error, rad, where the goal has one.
PLANAR_DISTANCE, SUCCESS_DISTANCE, SUCCESS_ANGLE = 0.03, 0.02, 0.4
# The cube has left the arena, m: beyond the upper edge of the wall.
OUTSIDE = 0.30
# Per metre: the kernel 1 / (e^x + 2 + e^-x) of a keypoint 3 cm off is 0.8 of its maximum.
KERNEL = 30.0
# Weights, per step. The first two are a hundredth of IsaacGymEnvs', the price of speed a thousandth.
WEIGHTS = {"keypoints": 0.4, "approach": 2.5, "speed": -5e-4, "torque": -5e-4, "action_rate": -5e-4}


@register
class TrifingerRepose(Task):
    """Bring a cube of 65 mm and 80 g to a goal with nine torques.

    Group: turns by 120 degrees. Action: torques, in units of 0.36 N m, less a safety damping that the
    platform adds. Observation: joint positions and velocities, cube pose, goal pose, last action. Where the
    goal has no orientation (difficulty 1 to 3, without ``yaw``), its quaternion is observed as zeros: they
    are invariant, as no constant orientation is, and say nothing that a policy would have to learn to
    ignore.

    Args:
        difficulty: 1, a place on the table; 2, 82.5 mm above the middle; 3, a place up to 0.1 m high;
            4, the same with an orientation.
        yaw: at difficulty 1, goals also have a heading: that of the cube at the start, turned by at most
            this, rad; less at lower levels. None: any heading will do.
        radius: of the disc of start and goal positions, m; at most and by default 0.1387.
        curriculum: start near the middle, where pushing is easy, and move outwards with success; if not,
            every episode draws from the whole disc.
        episode_seconds: length of an episode, s; None for 5 s at difficulty 1, else 15 s.
        physics_timestep: 0.005 s; 0.01 s simulates faster and was good enough to train in.
        cube_mass: range of the cube's mass, kg, drawn per episode; None keeps 0.08.
        friction: range of a factor on all sliding friction, drawn per episode; None keeps the model's.
        weak_finger: number of a finger (0, 1, 2) of half the strength, for studies of asymmetry.

    Raises:
        ValueError: an argument outside its range.

    Example:
        >>> import torch
        >>> task = TrifingerRepose(difficulty=4)
        >>> start = task.sample_goal_state(2, torch.Generator().manual_seed(0))
        >>> task.observe(start).shape
        torch.Size([2, 41])
    """

    name = "trifinger_repose"
    asset = "trifinger_repose.xml"
    control_timestep = 0.02
    goal_names = ("right", "back left", "front left")
    task_terms = ("keypoints",)
    carried = ("cube", "goal")
    observation_limit = 20.0
    max_velocity = 200.0

    def __init__(
        self,
        *,
        difficulty: int = 1,
        yaw: float | None = None,
        radius: float = ARENA,
        curriculum: bool = True,
        episode_seconds: float | None = None,
        physics_timestep: float = 0.005,
        cube_mass: Range | None = None,
        friction: Range | None = None,
        weak_finger: int | None = None,
    ) -> None:
        self.difficulty = difficulty = checks.whole("difficulty", difficulty, 1, 4)
        self.yaw = None if yaw is None else checks.real("yaw", yaw, above=0.0, high=math.pi)
        if yaw is not None and difficulty != 1:
            raise ValueError(
                f"expected a yaw at difficulty 1 only, got {yaw} at {difficulty}; difficulty 4 has "
                "orientations of its own"
            )
        self.radius = checks.real("radius", radius, above=0.0, high=ARENA)
        if weak_finger is not None:
            weak_finger = checks.whole("weak_finger", weak_finger, 0, 2)
        self.cube_mass = check_range("cube_mass", cube_mass, above=0.0)
        self.friction = check_range("friction", friction, above=0.0)
        self.oriented = difficulty == 4 or yaw is not None
        figures = ("success", "error", "level", *["angle"] * self.oriented)
        self.curriculum = Curriculum(LAST_LEVEL, *figures, rising=curriculum)
        self.episode_seconds = 5.0 if difficulty == 1 else 15.0
        edit = _edit(check_timestep(physics_timestep), weak_finger)
        super().__init__(PointGroup.rotation(3), episode_seconds=episode_seconds, edit=edit)
        self._start_pose = Constant(self.model.qpos0[:9])
        self._torque = float(self.model.actuator_ctrlrange[0, 1])  # the same for all
        turns = -torch.arange(3, dtype=torch.float64) * (2 * math.pi / 3)
        self._turn = Constant(torch.stack([turns.cos(), turns.sin()]))
        self._read_finger()
        self.cube = float(self.model.geom("cube").size[0])  # half its edge, m
        signs = torch.tensor([-self.cube, self.cube], dtype=torch.float64)
        self._corners = Constant(torch.cartesian_prod(signs, signs, signs))

        cube = self.model.body("cube")
        self._inertia = Constant(cube.inertia / cube.mass)  # per mass

    def _read_finger(self) -> None:
        """Kinematics, m: offset of the tip from the swing axis, lift axis along it, links, height."""
        upper, middle, lower = (self.model.body(f"{part}0").pos for part in ("upper", "middle", "lower"))
        tip = self.model.site("tip0").pos
        # a sum of lengths given in hundredths of a millimetre, without the rounding of sums
        self._side = round(float(middle[0] + lower[0] + tip[0]), 9)
        self._axis, self._link, self._height = float(middle[1]), -float(lower[2]), float(upper[2])

    def layout(self) -> tuple[Entry, ...]:
        """Joints, cube, goal, last action."""
        group, robot = self.robot.group, self.robot
        joints, position, orientation = robot.joints(JOINTS), polar(group), quaternion(group)
        by_finger, lift = "permutation of the fingers", "quaternion, multiplied from the left"

        def goal_orientation(state: State) -> Tensor:
            goal = state.mocap_turn(0)
            return goal if self.oriented else torch.zeros_like(goal)

        return (
            Entry(
                "joint positions from the starting pose",
                lambda state: state.qpos[:, :9] - self._start_pose.like(state.qpos),
                joints, "rad", "joints", by_finger,
            ),
            Entry(
                "joint velocities", lambda state: state.qvel[:, :9],
                joints, "rad/s", "joints", by_finger, JOINT_VELOCITY_SCALE,
            ),
            Entry(
                "cube position", lambda state: state.qpos[:, 9:12],
                position, "m", "world", "polar vector", POSITION_SCALE,
            ),
            Entry("cube orientation", lambda state: state.qpos[:, 12:16], orientation, "1", "world", lift),
            Entry(
                "goal position", lambda state: state.mocap_place(0),
                position, "m", "world", "polar vector", POSITION_SCALE,
            ),
            Entry(
                "goal orientation, zeros if it has none", goal_orientation, orientation, "1", "world", lift
            ),
            Entry(
                "last action", lambda state: state.variables["last_action"],
                robot.actuators, "0.36 N m", "joints", by_finger,
            ),
        )  # fmt: skip

    def variables(self) -> dict[str, Representation]:
        """Last action, distance of each fingertip from the cube one step ago, m, curriculum level."""
        tips = self.robot.joints([f"knee{finger}" for finger in FINGERS]).absolute()
        level = invariant(self.robot.group, 1)
        return {"last_action": self.robot.actuators, "tip_distance": tips, "level": level}

    def sample_goal_state(self, n: int, generator: torch.Generator | None) -> State:
        """The goal is on the right, give or take 60 degrees; at difficulty 2 the cube is."""
        return self._start(self.curriculum.hardest(n, generator), generator)

    def sample_initial_state(self, n: int, generator: torch.Generator | None) -> State:
        """All goals; the first level, or with ``curriculum=False`` the last."""
        return self.mapped_at_random(self._start(self.curriculum.start(n, generator), generator), generator)

    def restart(
        self, finished: State, generator: torch.Generator | None, rows: Tensor | None = None
    ) -> State:
        """Judge whole episodes: the next one reaches farther out after success, less far after failure."""
        over = finished.time > self.episode_seconds - self.control_timestep / 2
        figures = {"error": self.position_error(finished)}
        far = figures["error"] > FAILURE_DISTANCE
        if self.oriented:
            figures["angle"] = self.orientation_error(finished)
            far |= figures["angle"] > FAILURE_ANGLE
        level = self.curriculum.judge(
            finished.variables["level"][:, 0],
            whole=over | self.terminated(finished),
            success=self.success(finished),
            failed=far,
            generator=generator,
            rows=rows,
            **figures,
        )
        return self.mapped_at_random(self._start(level, generator), generator)

    def _start(self, level: Tensor, generator: torch.Generator | None) -> State:
        n = len(level)
        radius = self.radius * (FIRST_SHARE + (1 - FIRST_SHARE) * level / LAST_LEVEL)
        u = draws(n, 17, generator)
        qpos = u.new_zeros(n, self.model.nq)
        qpos[:, :9] = self._start_pose.like(qpos) + (2 * u[:, :9] - 1) * START_NOISE
        anywhere, right = (2 * u[:, 9] - 1) * math.pi, (2 * u[:, 10] - 1) * (math.pi / 3)
        qpos[:, 9:11] = _place(radius, right if self.difficulty == 2 else anywhere, u[:, 11])
        qpos[:, 11] = self.cube + 0.001  # exactly touching, rounding would decide which corners touch
        half = u[:, 12] * (2 * math.pi)  # half the yaw: over a whole turn, both signs of the quaternion
        qpos[:, 12], qpos[:, 15] = half.cos(), half.sin()
        goal = u.new_zeros(n, 1, 3)
        goal[:, 0, 2] = self._goal_height(u[:, 14])
        if self.difficulty != 2:
            goal[:, 0, :2] = _place(radius, right, u[:, 13])
        orientation = qpos[:, 12:16].clone()  # shown where the goal has none
        if self.yaw is not None:
            half = half + (2 * u[:, 15] - 1) * (self.yaw / 2) * (1 + level) / (1 + LAST_LEVEL)
            orientation[:, 0], orientation[:, 3] = half.cos(), half.sin()
        if self.difficulty == 4:
            drawn = torch.randn(n, 4, generator=generator, dtype=u.dtype, device=u.device)
            orientation = drawn / drawn.norm(dim=-1, keepdim=True)
        state = State(
            qpos=qpos,
            qvel=u.new_zeros(n, self.model.nv),
            mocap_pos=goal,
            mocap_quat=orientation[:, None],
            variables={
                "last_action": u.new_zeros(n, 9),
                "level": level[:, None].clone(),
            },
        )
        state.variables["tip_distance"] = self.tip_distance(state)
        return state

    def _goal_height(self, u: Tensor) -> Tensor:
        if self.difficulty <= 2:
            return torch.full_like(u, self.cube if self.difficulty == 1 else LIFT)
        lowest = self.cube if self.difficulty == 3 else math.sqrt(3) * self.cube
        return lowest + (HIGHEST - lowest) * u

    def randomize(self, simulation, ids: Tensor, generator: torch.Generator | None) -> None:
        """Mass of the cube and friction; scalars, hence invariant under the group."""
        if self.friction is not None:
            self.scale_friction(simulation, ids, uniform(self.friction, len(ids), generator))
        if self.cube_mass is not None:
            mass = uniform(self.cube_mass, len(ids), generator)
            cube = self.model.body("cube").id
            put(simulation.expand("body_mass")[:, cube], ids, mass)
            put(simulation.expand("body_inertia")[:, cube], ids, mass[:, None] * self._inertia.like(mass))
            simulation.refresh(ids)

    def control(self, action: Tensor, state: State) -> Tensor:
        """Torques, N m."""
        return action.double().clamp(-1.0, 1.0) * self._torque

    def update(self, state: State, action: Tensor) -> dict[str, Tensor]:
        """Remember the action and the distances of the fingertips."""
        return {"last_action": action.double().clamp(-1.0, 1.0), "tip_distance": self.tip_distance(state)}

    def fingertips(self, state: State) -> tuple[Tensor, Tensor]:
        """Centres of the fingertips, ``(n, 3, 3)``, m, and squares of their speeds, ``(n, 3)``, m^2/s^2.

        Closed form: derived fields of the simulator lag by one physics step.
        """
        q0, q1, q2 = state.qpos[:, :9].unflatten(-1, (3, 3)).unbind(-1)
        w0, w1, w2 = state.qvel[:, :9].unflatten(-1, (3, 3)).unbind(-1)
        q12, w12 = q1 + q2, w1 + w2
        sin1, cos1, sin12, cos12 = q1.sin(), q1.cos(), q12.sin(), q12.cos()
        along = self._axis + self._link * (sin1 + sin12)  # the swing axis
        down = -self._link * (cos1 + cos12)
        sin0, cos0 = q0.sin(), q0.cos()
        across, height = self._side * cos0 + down * sin0, self._height - self._side * sin0 + down * cos0
        cos, sin = self._turn.like(q0)
        tips = torch.stack([across * cos - along * sin, across * sin + along * cos, height], dim=-1)
        speed_along = self._link * (cos1 * w1 + cos12 * w12)
        speed_down = self._link * (sin1 * w1 + sin12 * w12)
        # In the plane that swings: the tip turns about the axis and moves down.
        square = speed_along.square() + (down * w0).square() + (speed_down - self._side * w0).square()
        return tips, square

    def tip_distance(self, state: State) -> Tensor:
        """Distance of every fingertip from the cube's centre, ``(n, 3)``, m."""

        def compute() -> Tensor:
            return (self.fingertips(state)[0] - state.qpos[:, None, 9:12]).norm(dim=-1)

        return state.shared("tip_distance", compute)

    def position_error(self, state: State) -> Tensor:
        """Distance of the cube from its goal, ``(n,)``, m."""
        goal = state.mocap_place(0)
        return state.shared("position_error", lambda: (state.qpos[:, 9:12] - goal).norm(dim=-1))

    def orientation_error(self, state: State) -> Tensor:
        """Angle between cube and goal, ``(n,)``, rad; the same for both signs of a quaternion."""
        product = (state.qpos[:, 12:16] * state.mocap_turn(0)).sum(dim=-1).abs()
        return 2 * product.clamp(max=1.0).acos()

    def _keypoint_distance(self, state: State) -> Tensor:
        """Distance of the cube's corners from the goal's, ``(n, 8)``, m; or of the centres, ``(n, 1)``."""
        if not self.oriented:  # then all corners are off by the same
            return self.position_error(state)[:, None]
        turn = matrix_of(state.qpos[:, 12:16]) - matrix_of(state.mocap_turn(0))
        offset = state.qpos[:, 9:12] - state.mocap_place(0)
        return (self._corners.like(turn) @ turn.mT + offset[:, None]).norm(dim=-1)

    def reward_terms(self, state: State, action: Tensor) -> dict[str, Tensor]:
        """Bring the corners to their goals, the fingertips to the cube, gently."""
        far = KERNEL * self._keypoint_distance(state)
        closer = state.variables["tip_distance"] - self.tip_distance(state)
        action = action.double().clamp(-1.0, 1.0)
        terms = {
            "keypoints": (1 / (far.exp() + 2 + (-far).exp())).mean(dim=-1),
            "approach": closer.sum(dim=-1),
            "speed": self.fingertips(state)[1].sum(dim=-1),
            "torque": action.square().sum(dim=-1),
            "action_rate": (action - state.variables["last_action"]).square().sum(dim=-1),
        }
        return {name: WEIGHTS[name] * term for name, term in terms.items()}

    def terminated(self, state: State) -> Tensor:
        """The cube is outside the arena: over the wall, or thrown up."""
        x, y, z = state.qpos[:, 9:12].unbind(-1)
        return (x.square() + y.square() > OUTSIDE**2) | (z.abs() > OUTSIDE)

    def success(self, state: State) -> Tensor:
        """Within 3 cm of the goal at difficulty 1, else within 2 cm; within 0.4 rad of its orientation."""
        limit = PLANAR_DISTANCE if self.difficulty == 1 else SUCCESS_DISTANCE
        close = self.position_error(state) < limit
        return close & (self.orientation_error(state) < SUCCESS_ANGLE) if self.oriented else close

    def metrics(self) -> dict[str, float]:
        """Success rate, final errors (m, rad) and level, means of about the last 500 episodes."""
        return self.curriculum.averages.numbers()

    def state_dict(self) -> dict[str, Any]:
        """The averages that :meth:`metrics` reports."""
        return self.curriculum.averages.numbers()

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Continue from :meth:`state_dict`."""
        self.curriculum.averages.load(saved)


def _place(radius: Tensor, bearing: Tensor, u: Tensor) -> Tensor:
    """Uniform over a disc, or a sector of it, ``(n, 2)``."""
    return (radius * u.sqrt())[:, None] * torch.stack([bearing.cos(), bearing.sin()], dim=-1)


def _edit(timestep: float, weak_finger: int | None) -> Edit:
    def edit(spec) -> None:
        spec.option.timestep = timestep
        for joint in JOINTS if weak_finger is not None else ():
            if joint.endswith(str(weak_finger)):
                spec.actuator(joint).forcerange = spec.actuator(joint).forcerange / 2

    return edit
