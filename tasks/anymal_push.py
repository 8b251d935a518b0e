"""ANYmal-Push: walk to a cube and push it to a target, wherever around the robot the two are.

Cube and target lie on one ray from the robot. Pushing with the front and with the back is then equally
hard, and so is pushing to the left and to the right; a policy without symmetry typically learns to turn
and to use two of its legs only. The target moves farther away as pushes succeed.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
from typing_extensions import Unpack  # of typing since Python 3.11

from tasks.anymal import Anymal, RobotArguments, into_base, rotation
from tasks.base import register
from tasks.curriculum import Curriculum
from tasks.draws import draws
from tasks.observation import Entry
from tasks.state import State
from torchrl_sym import Representation, checks
from torchrl_sym.representations import invariant, polar

# Where the cube starts: distance from the robot, m, and how far a face is turned from it, rad.
CUBE_DISTANCE, CUBE_TURN = (1.0, 1.3), 0.3
# How far behind the cube the target is, m: 0.3 + 0.15 level U(0.5, 1), at most 1.35 at the last level.
NEAREST_TARGET, TARGET_STEP, LAST_LEVEL = 0.3, 0.15, 7
# What observed positions are multiplied by. What is left to push is observed itself, and much enlarged: the
# robot has to tell 10 cm, where it stops, from 20 cm, which is not enough.
CUBE_SCALE, GAP_SCALE = 2.0, 5.0
SUCCESS_DISTANCE = 0.2  # of cube and target at the end of an episode, m
# Motion is rewarded until the cube is this close, m: nearer than needed, so that stopping there succeeds.
STOP_DISTANCE = 0.12
# The speed asked for, m/s. Near the target it falls in proportion to the distance left, to a third: a cube
# that is pushed past its target is hard to get back. The tolerance of the velocity's reward falls with
# it, or standing still short of the target would pay nearly as well.
SPEED, SLOW_DISTANCE, SLOWEST = 0.6, 0.5, 0.2
TOLERANCE = 0.8  # of the speed asked for: standing still earns a fifth
BASE_HEIGHT, LOWEST = 0.48, 0.22  # asked for, and counted as fallen, m
FALL_PENALTY = 5.0
# Weights of the reward's terms. The first group is the task; the others ask for a gait that lasts.
# Holding the cube at the target must pay much more than walking on with it: while it did not, policies
# pushed ever faster past the target. Crouching must cost: with a quarter of the weight of height and a
# third of that of tilt, robots leaned on the cube and came to a stop half way to far targets. Facing pays
# alike with the front and with the back: without it, robots set out sideways and pushed the cube off its
# line while turning.
TASK_WEIGHTS = {"velocity": 4.0, "progress": 10.0, "tracking": 5.0}
GAIT_WEIGHTS = {
    "facing": 2.0,
    "alive": 0.5,
    "height": -80.0,
    "vertical": -1.0,
    "rolling": -0.05,
    "tilt": -3.0,
}
EFFORT_WEIGHTS = {"torque": -2e-5, "acceleration": -2.5e-7, "action_rate": -0.005}


@register
class AnymalPush(Anymal):
    """Push a cube of 0.6 m and 8 kg to a target 0.3 to 1.35 m away.

    Group: Klein four. Observation: 45 proprioceptive numbers, position of the cube and from there to the
    target in the base frame.
    An episode succeeds if the cube ends within 0.2 m of the target.

    Args:
        curriculum: start with near targets and move them away as pushes succeed; if not, every episode
            draws from the whole range.
        **robot: arguments of :class:`~tasks.anymal.Anymal`.

    Example:
        >>> import torch
        >>> task = AnymalPush()
        >>> start = task.sample_goal_state(2, torch.Generator().manual_seed(0))
        >>> task.observe(start).shape
        torch.Size([2, 51])
    """

    name = "anymal_push"
    asset = "anymal_push.xml"
    episode_seconds = 7.0
    goal_names = ("front left", "back left", "front right", "back right")
    task_terms = tuple(TASK_WEIGHTS)

    def __init__(self, *, curriculum: bool = True, **robot: Unpack[RobotArguments]) -> None:
        super().__init__(**robot)
        self.cube = float(self.model.geom("cube").size[0])  # half its edge, m
        self.curriculum = Curriculum(LAST_LEVEL, "success", "level", rising=curriculum)

    def layout(self) -> tuple[Entry, ...]:
        """Proprioception, then where the cube is, and where it has to go."""
        position = polar(self.robot.group)

        def cube(state: State) -> Tensor:
            return into_base(rotation(state), state.qpos[:, 19:22] - state.qpos[:, 0:3])

        def gap(state: State) -> Tensor:
            return into_base(rotation(state), state.mocap_place(0) - state.qpos[:, 19:22])

        return (
            *self.proprioception(),
            Entry("cube position", cube, position, "m", "base", "polar vector", CUBE_SCALE),
            Entry("from cube to target", gap, position, "m", "base", "polar vector", GAP_SCALE),
        )

    def variables(self) -> dict[str, Representation]:
        """Those of the robot; distances of cube and target one step ago and at the start, m."""
        distance = invariant(self.robot.group, 1)
        return super().variables() | {"distance": distance, "start_distance": distance}

    def sample_goal_state(self, n: int, generator: torch.Generator | None) -> State:
        """Cube and target in front on the left, at any distance of the curriculum."""
        return self._start(self.curriculum.hardest(n, generator), generator, spread=0.0)

    def sample_initial_state(self, n: int, generator: torch.Generator | None) -> State:
        """Any direction; near targets, or with ``curriculum=False`` the whole range."""
        return self._training_start(self.curriculum.start(n, generator), generator)

    def restart(
        self, finished: State, generator: torch.Generator | None, rows: Tensor | None = None
    ) -> State:
        """Judge whole episodes: the next target is farther after success, nearer after no progress."""
        distance, start = self._distance(finished), finished.variables["start_distance"][:, 0]
        over = finished.time > self.episode_seconds - self.control_timestep / 2
        level = self.curriculum.judge(
            finished.variables["level"][:, 0],
            whole=over | self.fallen(finished, LOWEST),
            success=self.success(finished),
            failed=distance > 0.7 * start,
            generator=generator,
            rows=rows,
        )
        return self._training_start(level, generator)

    def _training_start(self, level: Tensor, generator: torch.Generator | None) -> State:
        spread = 0.5 if self.curriculum.rising else 0.0
        return self.mapped_at_random(self._start(level, generator, spread), generator)

    def _start(self, level: Tensor, generator: torch.Generator | None, spread: float) -> State:
        """Starts with the cube in front on the left and the target behind it.

        Args:
            level: curriculum level of every row, ``(n,)``.
            generator: source of the draws.
            spread: targets are at ``spread`` to 1 times the level's distance.
        """
        n = len(level)
        u = draws(n, 5, generator)
        yaw = (2 * u[:, 0] - 1) * math.pi
        state = self.standing(n, yaw, generator)
        state.variables["level"] = level[:, None].clone()
        bearing = yaw + u[:, 1] * math.pi / 2
        ray = torch.stack([bearing.cos(), bearing.sin()], dim=-1)
        distance = CUBE_DISTANCE[0] + (CUBE_DISTANCE[1] - CUBE_DISTANCE[0]) * u[:, 2]
        state.qpos[:, 19:21] = distance[:, None] * ray
        state.qpos[:, 21] = self.cube + 0.001  # exactly touching, rounding would decide which corners touch
        turn = bearing + (2 * u[:, 3] - 1) * CUBE_TURN
        state.qpos[:, 22], state.qpos[:, 25] = (turn / 2).cos(), (turn / 2).sin()
        reach = NEAREST_TARGET + TARGET_STEP * level * (spread + (1 - spread) * u[:, 4])
        target = state.mocap_place(0)
        target[:, :2] = (distance + reach)[:, None] * ray
        target[:, 2] = self.cube
        state.variables["distance"] = reach[:, None].clone()
        state.variables["start_distance"] = reach[:, None].clone()
        return state

    def update(self, state: State, action: Tensor) -> dict[str, Tensor]:
        """Those of the robot, and the distance of cube and target."""
        return super().update(state, action) | {"distance": self._distance(state)[:, None]}

    def _gap(self, state: State) -> Tensor:
        """From the cube to the target, horizontally, ``(n, 2)``, m."""
        return state.mocap_place(0)[:, :2] - state.qpos[:, 19:21]

    def _distance(self, state: State) -> Tensor:
        return state.shared("distance", lambda: self._gap(state).norm(dim=-1))

    def reward_terms(self, state: State, action: Tensor) -> dict[str, Tensor]:
        """Approach the cube from behind, move it to the target, hold it there; walk well."""
        distance, gap = self._distance(state), self._gap(state)
        velocity, turning, turn = state.qvel[:, 0:3], state.qvel[:, 3:6], rotation(state)
        pushing = distance > STOP_DISTANCE
        ahead = gap / distance.clamp(min=1e-6)[:, None]
        to_cube = state.qpos[:, 19:21] - state.qpos[:, 0:2]
        toward = to_cube / to_cube.norm(dim=-1).clamp(min=1e-6)[:, None]
        speed = (SPEED * distance / SLOW_DISTANCE).clamp(SLOWEST, SPEED)
        asked = dipole(toward, ahead) * (speed * pushing)[:, None]
        miss = (velocity[:, :2] - asked).square().sum(-1) / (TOLERANCE * speed).square()
        progress = (state.variables["distance"][:, 0] - distance) / self.control_timestep
        terms = {
            "velocity": (-miss).exp(),
            "progress": progress.clamp(-1.5, SPEED),  # no more for a kick than for a push
            "tracking": 1 / (1 + (distance / 0.15).square()),
            "facing": torch.where(pushing, facing(turn, toward), 1.0),
            "alive": torch.ones_like(distance),
            "height": (state.qpos[:, 2] - BASE_HEIGHT).square(),
            "vertical": velocity[:, 2].square(),
            "rolling": turning[:, :2].square().sum(-1),
            "tilt": turn[:, 2, :2].square().sum(-1),
            **self.effort(state, action),
        }
        weights = TASK_WEIGHTS | GAIT_WEIGHTS | EFFORT_WEIGHTS
        weighted = {name: weights[name] * self.control_timestep * x for name, x in terms.items()}
        weighted["step"] = self.first_touch(state) * pushing
        weighted["fall"] = -FALL_PENALTY * self.fallen(state, LOWEST).double()
        return weighted

    def terminated(self, state: State) -> Tensor:
        """The robot has fallen."""
        return self.fallen(state, LOWEST)

    def success(self, state: State) -> Tensor:
        """The cube is within 0.2 m of the target, and the robot stands."""
        return (self._distance(state) < SUCCESS_DISTANCE) & ~self.fallen(state, LOWEST)

    def metrics(self) -> dict[str, float]:
        """Success rate and level, averaged over about the last 500 training episodes."""
        return self.curriculum.averages.numbers()

    def state_dict(self) -> dict[str, Any]:
        """The averages; levels are part of the state of the rows."""
        return {"averages": self.curriculum.averages.numbers()}

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Continue from :meth:`state_dict`."""
        self.curriculum.averages.load(*checks.entries("saved", saved, "averages"))


def facing(turn: Tensor, toward: Tensor) -> Tensor:
    """How much the robot's front or back faces an object, ``(n,)``: squared cosine, 0 beside it.

    Args:
        turn: rotation of the base, ``(n, 3, 3)``.
        toward: horizontal direction to the object, ``(n, 2)``, unit vectors.

    Example:
        >>> facing(torch.eye(3)[None], torch.tensor([[-1.0, 0.0]]))
        tensor([1.])
    """
    ahead = turn[:, :2, 0]
    return (ahead * toward).sum(-1).square() / ahead.square().sum(-1).clamp(min=1e-6)


def dipole(toward: Tensor, ahead: Tensor) -> Tensor:
    """Which way a robot pushes an object to a target: along a dipole field, ``(n, 2)`` unit vectors.

    Straight on from behind the object, around it from beside it, and away from it where it stands between
    object and target (Igarashi, Kamiyama and Inami, "A dipole field for object delivery by pushing on a
    flat surface", ICRA 2010): with r the direction to the object and e the one from there to the
    target, u = 2 (e . r) r - e.

    Args:
        toward: direction from the robot to the object, ``(n, 2)``, unit vectors.
        ahead: direction from the object to its target, ``(n, 2)``, unit vectors.

    Example:
        >>> beside, ahead = torch.tensor([[0.0, -1.0]]), torch.tensor([[1.0, 0.0]])
        >>> dipole(beside, ahead)  # first get behind it
        tensor([[-1., -0.]])
    """
    return 2 * (ahead * toward).sum(-1, keepdim=True) * toward - ahead
