"""ANYmal-Climb: be on top of a box, in front of or behind the robot, when the time is over.

What counts is where the robot is in the last two seconds; how it gets there is its own affair. Such a
sparse and delayed reward is not found by chance, so training goes through three phases (Rudin et al. 2022;
the paper, Sec. IV): in A walking towards the target is rewarded, in B no longer, in C the robot starts with
any heading. The bias of phase A is towards the target, not "forward", which would break the symmetry of
front and back.
"""

from __future__ import annotations

import math
from typing import Any, Literal, get_args

import torch
from torch import Tensor
from typing_extensions import Unpack  # of typing since Python 3.11

from tasks.anymal import Anymal, RobotArguments, into_base, rotation
from tasks.base import register
from tasks.constants import Constant
from tasks.curriculum import Curriculum
from tasks.draws import draws
from tasks.observation import Entry
from tasks.state import State
from torchrl_sym import checks
from torchrl_sym.representations import heading, height_map, invariant, polar

# Where the centre of the box is, m: ahead, and at most this far to the side.
BOX_DISTANCE, BOX_OFFSET = (1.7, 2.0), 0.3
TARGET_HEIGHT = 0.5  # of the target over the top of the box, m: the height of a standing robot
# Height of the box, m: from the lowest to the task's own in LAST_LEVEL steps, each varied by a fifth.
LOWEST_BOX, LAST_LEVEL = 0.05, 8
# At the end of a successful episode the base is this near the target horizontally, and this far above the
# top of the box; beyond the third distance the episode counts as failed, m.
SUCCESS_DISTANCE, SUCCESS_HEIGHT, FAILURE_DISTANCE = 0.5, 0.3, 0.8
TASK_SECONDS = 2.0  # the position is rewarded in this time at the end, s
SPEED, STOP_DISTANCE = 0.8, 0.3  # asked for in phase A, m/s, until this near the target, m
BASE_HEIGHT, LOWEST = 0.5, 0.2  # asked for over the ground, and counted as fallen, m
FALL_PENALTY = 5.0
# The grid of the height map: 21 x 11 points, 0.1 m apart, that turn with the robot's heading.
ROWS, COLUMNS, SPACING = 21, 11, 0.1
# What heights (legged_gym) and the target's position, m, are multiplied by.
HEIGHT_SCALE, TARGET_SCALE = 5.0, 3.0
# A phase is over at this success rate and, for A, at this mean level.
PHASE_SUCCESS, PHASE_LEVEL = 0.7, 5.0
TASK_WEIGHTS = {"position": 20.0, "heading": 4.0}
BIAS_WEIGHTS = {"velocity": 4.0}
GAIT_WEIGHTS = {"alive": 0.5, "height": -40.0, "vertical": -0.5, "rolling": -0.05, "tilt": -2.0}
HEADING_WEIGHTS = {"turned": -0.3}
EFFORT_WEIGHTS = {"torque": -2e-5, "acceleration": -2.5e-7, "action_rate": -0.005}
Phase = Literal["A", "B", "C"]
PHASES = get_args(Phase)


@register
class AnymalClimb(Anymal):
    """Climb a box in front of or behind the robot and stand on it at the end.

    Group: Klein four. Observation: 45 proprioceptive numbers; target position, heading error (cos, sin) and
    time left; 231 heights of the ground around the robot. The heading asked for is the one at the start.
    An episode succeeds if the robot ends within 0.5 m of the box's centre, standing on it. Episodes have a
    fixed length which is observed, so that reaching it ends them with no future value.

    Args:
        height: of the highest box, m.
        phase: phase of training to start in.
        curriculum: raise the box and go on to the next phase as climbing succeeds; if not, every episode
            has a box of full height, and the phase stays.
        **robot: arguments of :class:`~tasks.anymal.Anymal`.

    Raises:
        ValueError: no such phase, or a box lower than 5 cm.

    Example:
        >>> import torch
        >>> task = AnymalClimb(height=0.2)
        >>> start = task.sample_goal_state(2, torch.Generator().manual_seed(0))
        >>> task.observe(start).shape
        torch.Size([2, 282])
    """

    name = "anymal_climb"
    asset = "anymal_climb.xml"
    episode_seconds = 6.0
    goal_names = ("front left", "back left", "front right", "back right")
    task_terms = tuple(TASK_WEIGHTS)

    def __init__(
        self,
        *,
        height: float = 0.3,
        phase: Phase = "A",
        curriculum: bool = True,
        **robot: Unpack[RobotArguments],
    ) -> None:
        self.height = checks.real("height", height, LOWEST_BOX)
        self._phase: Any = PHASES.index(checks.one_of("phase", phase, PHASES))  # on a device, a tensor
        self.curriculum = Curriculum(LAST_LEVEL, "success", "level", "distance", rising=curriculum)
        super().__init__(**robot)
        self.box = float(self.model.geom("box").size[0])  # half its edge, m; a cube sunk in the ground
        grid = torch.cartesian_prod(*_axes()).T
        self._grid = Constant(grid)  # x and y of every point
        self._below = Constant(((grid[0].abs() < 0.45) & (grid[1].abs() < 0.25)).nonzero().squeeze(1))

    def layout(self) -> tuple[Entry, ...]:
        """Proprioception, command, height map."""
        group = self.robot.group

        def target(state: State) -> Tensor:
            return into_base(rotation(state), self._gap(state))

        def time_left(state: State) -> Tensor:
            return 1 - state.time[:, None] / self.episode_seconds

        def heights(state: State) -> Tensor:  # below a standing robot's base
            level = (state.qpos[:, 2:3] - BASE_HEIGHT).float()
            return (self.heights(state) - level).clamp_(-1.0, 1.0)

        turned = "sine changes sign in a mirror"
        return (
            *self.proprioception(),
            Entry("target position", target, polar(group), "m", "base", "polar vector", TARGET_SCALE),
            Entry("heading error (cos, sin)", self._heading_error, heading(group), "1", "base", turned),
            Entry("time left", time_left, invariant(group, 1), "1", "-", "invariant"),
            Entry(
                "heights of the ground", heights, height_map(group, *_axes()), "m", "heading",
                "permutation of the grid's points", HEIGHT_SCALE,
            ),
        )  # fmt: skip

    def sample_goal_state(self, n: int, generator: torch.Generator | None) -> State:
        """A box of full height in front, on the left; any heading in phase C, else towards the box."""
        return self._start(self.curriculum.hardest(n, generator), generator, vary=0.0)

    def sample_initial_state(self, n: int, generator: torch.Generator | None) -> State:
        """Boxes on all sides that the group reaches; low ones, or with ``curriculum=False`` the highest."""
        return self._training_start(self.curriculum.start(n, generator), generator)

    def restart(
        self, finished: State, generator: torch.Generator | None, rows: Tensor | None = None
    ) -> State:
        """Judge whole episodes: higher boxes after success, lower ones after failure, the next phase."""
        distance, fallen = self._distance(finished), self.fallen(finished, LOWEST)
        level = self.curriculum.judge(
            finished.variables["level"][:, 0],
            whole=fallen | self._over(finished),
            success=self.success(finished),
            failed=fallen | (distance > FAILURE_DISTANCE),
            generator=generator,
            rows=rows,
            distance=distance,
        )
        if self.curriculum.rising:
            self._advance()
        return self._training_start(level, generator)

    def _training_start(self, level: Tensor, generator: torch.Generator | None) -> State:
        start = self._start(level, generator, vary=0.2 * self.curriculum.rising)
        return self.mapped_at_random(start, generator)

    @property
    def phase(self) -> Phase:
        """Phase of training."""
        return PHASES[int(self._phase)]

    def in_phase(self, phase: Phase) -> bool | Tensor:
        """Whether training is in a phase; on a device, a tensor that says so there."""
        return self._phase == PHASES.index(phase)

    def _advance(self) -> None:
        """On to the next phase; by arithmetic, since on a device nothing is asked."""
        values = self.curriculum.averages.values
        good = (values["success"] > PHASE_SUCCESS) & (values["level"] > PHASE_LEVEL)
        over = good & (self._phase < len(PHASES) - 1)
        self._phase = self._phase + over
        values["success"] = values["success"] * (over == 0)  # the next phase is judged by its own episodes

    def _start(self, level: Tensor, generator: torch.Generator | None, vary: float) -> State:
        """Starts with the box in front, its centre on the left.

        Args:
            level: curriculum level of every row, ``(n,)``.
            generator: source of the draws.
            vary: boxes are up to this share lower than the level's.
        """
        n = len(level)
        u = draws(n, 4, generator)
        yaw = (2 * u[:, 0] - 1) * math.pi * self.in_phase("C")
        state = self.standing(n, yaw, generator)
        state.variables["level"] = level[:, None].clone()
        height = LOWEST_BOX + (self.height - LOWEST_BOX) * level / LAST_LEVEL
        height = height * (1 - vary * u[:, 3])
        box, target = state.mocap_place(0), state.mocap_place(1)
        box[:, 0] = BOX_DISTANCE[0] + (BOX_DISTANCE[1] - BOX_DISTANCE[0]) * u[:, 1]
        box[:, 1] = BOX_OFFSET * u[:, 2]
        box[:, 2] = height - self.box
        target[:] = box
        target[:, 2] = height + TARGET_HEIGHT
        state.mocap_turn(1)[:] = state.qpos[:, 3:7]
        return state

    def ground(self, state: State, points: Tensor) -> Tensor:
        """Height of the box where it is, else zero."""
        box = state.mocap_place(0).to(points.dtype)
        gap = (points[..., :2] - box[:, None, :2]).abs_()
        return (gap <= self.box).all(dim=-1) * (box[:, None, 2] + self.box)

    def heights(self, state: State) -> Tensor:
        """Height of the ground at the points of the map, ``(n, 231)`` float32, m, in the world frame."""

        def compute() -> Tensor:
            ahead = self._ahead(state)
            cos, sin = ahead.float().unsqueeze(-1).unbind(1)
            box = state.mocap_place(0)
            offset = (state.qpos[:, 0:2] - box[:, :2]).float()
            grid_x, grid_y = self._grid.like(cos)
            x = torch.addcmul(offset[:, :1], cos, grid_x).addcmul_(sin, grid_y, value=-1)
            y = torch.addcmul(offset[:, 1:], sin, grid_x).addcmul_(cos, grid_y)
            inside = torch.maximum(x.abs_(), y.abs_(), out=x) <= self.box
            return torch.mul(inside, (box[:, 2:] + self.box).float(), out=y)

        return state.shared("heights", compute)

    def _ahead(self, state: State) -> Tensor:
        """Direction of the robot's heading, horizontal, ``(n, 2)``."""

        def compute() -> Tensor:
            forward = rotation(state)[:, :2, 0]
            return forward / forward.norm(dim=-1, keepdim=True).clamp(min=1e-6)

        return state.shared("ahead", compute)

    def _heading_error(self, state: State) -> Tensor:
        """(cos, sin) of the turn from the robot's heading to the one asked for, ``(n, 2)``."""
        w, _, _, z = state.mocap_turn(1).unbind(-1)
        cos, sin = w * w - z * z, 2 * w * z
        x, y = self._ahead(state).unbind(-1)
        return torch.stack([cos * x + sin * y, sin * x - cos * y], dim=-1)

    def _gap(self, state: State) -> Tensor:
        return state.mocap_place(1) - state.qpos[:, 0:3]

    def _distance(self, state: State) -> Tensor:
        """Horizontal distance of base and target, ``(n,)``, m."""
        return self._gap(state)[:, :2].norm(dim=-1)

    def _over(self, state: State) -> Tensor:
        return state.time > self.episode_seconds - self.control_timestep / 2

    def reward_terms(self, state: State, action: Tensor) -> dict[str, Tensor]:
        """Be on the box at the end; in phase A also walk towards it; walk well."""
        gap, velocity, turning = self._gap(state), state.qvel[:, 0:3], state.qvel[:, 3:6]
        distance, turned = self._distance(state), 1 - self._heading_error(state)[:, 0]
        last = (state.time > self.episode_seconds - TASK_SECONDS).double() / TASK_SECONDS
        ground = self.heights(state)
        ground = ground.index_select(1, self._below.like(ground)).mean(dim=1).double()
        walking = distance > STOP_DISTANCE
        asked = SPEED * gap[:, :2] / distance.clamp(min=1e-6)[:, None] * walking[:, None]
        near = 1 / (1 + 4 * gap.square().sum(-1))
        terms = {
            "position": last * near,
            "heading": last * near * (1 - 0.5 * turned),
            "velocity": (-(velocity[:, :2] - asked).square().sum(-1) / 0.25).exp() * self.in_phase("A"),
            "alive": torch.ones_like(distance),
            "height": (state.qpos[:, 2] - ground - BASE_HEIGHT).square(),
            "vertical": velocity[:, 2].square(),
            "rolling": turning[:, :2].square().sum(-1),
            "tilt": rotation(state)[:, 2, :2].square().sum(-1),
            "turned": turned,
            **self.effort(state, action),
        }
        weights = TASK_WEIGHTS | BIAS_WEIGHTS | GAIT_WEIGHTS | HEADING_WEIGHTS | EFFORT_WEIGHTS
        weighted = {name: weights[name] * self.control_timestep * x for name, x in terms.items()}
        weighted["step"] = self.first_touch(state) * walking
        weighted["fall"] = -FALL_PENALTY * self.fallen(state, LOWEST).double()
        return weighted

    def terminated(self, state: State) -> Tensor:
        """The robot has fallen, or the time that it observes is over."""
        return self.fallen(state, LOWEST) | self._over(state)

    def success(self, state: State) -> Tensor:
        """The robot stands on the box, near its centre."""
        above = state.qpos[:, 2] - (state.mocap_place(0)[:, 2] + self.box) > SUCCESS_HEIGHT
        return above & (self._distance(state) < SUCCESS_DISTANCE) & ~self.fallen(state, LOWEST)

    def metrics(self) -> dict[str, float]:
        """Averages over about 500 training episodes, and the phase (0, 1, 2 for A, B, C)."""
        return {**self.curriculum.averages.numbers(), "phase": float(self._phase)}

    def state_dict(self) -> dict[str, Any]:
        """Phase and averages; levels are part of the state of the rows."""
        return {"phase": self.phase, "averages": self.curriculum.averages.numbers()}

    def load_state_dict(self, saved: dict[str, Any]) -> None:
        """Continue from :meth:`state_dict`."""
        phase, averages = checks.entries("saved", saved, "phase", "averages")
        checks.one_of("phase", phase, PHASES)
        self.curriculum.averages.load(averages)
        if self.curriculum.rising:  # without one it stays what was asked for
            self._phase = PHASES.index(phase)


def _axes() -> tuple[Tensor, Tensor]:
    """Grid lines of the height map along and across the heading, m; exactly symmetric about zero."""
    lines = (torch.arange(count, dtype=torch.float32) - count // 2 for count in (ROWS, COLUMNS))
    x, y = (line * SPACING for line in lines)
    return x, y
