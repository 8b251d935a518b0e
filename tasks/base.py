"""What a task is: one description in torch, batched, from which both faces are made.

A task says how a robot problem looks (layout), what is good (reward_terms), when it is over
(terminated), how it starts (sample_goal_state) and how its symmetry group acts on its full state
(transform_state). It holds no simulation: every method is a function of a `State` of n rows. The
batched TorchRL environment (environment.py) and the dm_control environment (suite.py) call the same
methods, so that they cannot disagree.

Every task file has the same anatomy: constants with meaning and unit, then one class decorated with
`@register`, its methods in the order of the methods below.
"""

from __future__ import annotations

import abc
import importlib.resources
import inspect
import math
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, TypeVar

import mujoco
import torch
from torch import Tensor
from typing_extensions import Self  # of typing since Python 3.11

from tasks.constants import Constant
from tasks.draws import device_of, put
from tasks.engine import Engine
from tasks.observation import Entry, Observation
from tasks.state import Element, State, concatenate
from torchrl_sym import PointGroup, Representation, Symmetry, checks
from torchrl_sym.mujoco import derive

mj: Any = mujoco  # its compiled modules have no type stubs
Edit = Callable[[Any], None]

_TASKS: dict[str, type[Task]] = {}

T = TypeVar("T", bound="type[Task]")


class Task(abc.ABC):
    """Description of one robot task; subclass it, decorate the class with :func:`register`.

    Class attributes a task sets: ``name``; ``asset`` (its file in tasks/assets);
    ``control_timestep`` [s]; ``episode_seconds`` [s];
    ``goal_names``, one per group element in the group's order; ``carried``, names of objects whose
    orientation the group only carries along (:func:`~torchrl_sym.mujoco.derive`); ``task_terms``, names
    of the reward's terms that are the task itself rather than gait or effort; ``observation_limit``, beyond
    which observations are cut off; and if 1000 is not right, ``max_velocity`` (m/s or rad/s) above which a
    simulation counts as diverged.

    The group acts on three things that must agree: observations and actions (``symmetry``) and the
    full state (:meth:`transform_state`). Then for every element g, with L_g and K_g of the paper::

        T(L_g s, K_g a) = L_g T(s, a),  r(L_g s, K_g a) = r(s, a),  observe(L_g s) = L_g observe(s)

    All of it is derived from the model: a task states every entry of its observation once, in
    :meth:`layout`, in terms of ``robot``; what is observed, its size and its symmetry follow.

    Args:
        group: the group that acts, about the vertical axis through the world's origin.
        episode_seconds: length of an episode, s; None for the task's own.
        edit: changes the model's specification (``MjSpec``) before it is compiled.

    Attributes:
        model: the compiled model.
        robot: the symmetry derived from it.
        arguments: what the task was made with, by name.
        symmetry: how the group acts on observation and action.
        observation_size: numbers observed.
        action_size: numbers in an action, one per actuator.

    Example:
        >>> from tasks.base import create
        >>> task = create("cartpole")
        >>> task.max_steps, task.goal_names
        (200, ('right', 'left'))
    """

    name: ClassVar[str]
    asset: ClassVar[str]
    control_timestep: ClassVar[float]
    episode_seconds: float
    goal_names: ClassVar[tuple[str, ...]]
    carried: ClassVar[tuple[str, ...]] = ()
    task_terms: ClassVar[tuple[str, ...]] = ()
    observation_limit: ClassVar[float | None] = None
    max_velocity: float = 1000.0
    arguments: dict[str, Any]

    def __new__(cls, *args: Any, **kwargs: Any) -> Self:
        """Keep the arguments, whatever a task does with them: a run says by them what it was trained on."""
        task = super().__new__(cls)
        names = list(inspect.signature(cls.__init__).parameters)[1:]
        task.arguments = dict(zip(names, args, strict=False)) | kwargs
        return task

    def __init__(
        self, group: PointGroup, *, episode_seconds: float | None = None, edit: Edit | None = None
    ) -> None:
        if episode_seconds is not None:
            self.episode_seconds = checks.real("episode_seconds", episode_seconds)
        if not self.control_timestep <= self.episode_seconds < math.inf:
            raise ValueError(
                "expected finite episode_seconds of at least one control step "
                f"({self.control_timestep} s), got {self.episode_seconds}"
            )
        self.model = load_model(self.asset, edit)
        timestep = self.model.opt.timestep
        if timestep <= 0 or not math.isclose(self.substeps * timestep, self.control_timestep):
            raise ValueError(
                f"expected a control_timestep that is a multiple of the model's timestep "
                f"{timestep} s, got {self.control_timestep} s; change one of the two"
            )
        self._friction = Constant(self.model.geom_friction[:, 0])
        self.robot = derive(self.model, group, carried=self.carried)
        self._observation = Observation(self.layout(), self.observation_limit)
        self.symmetry = Symmetry(
            group, {"observation": self._observation.representation, "action": self.robot.actuators}
        )
        self.observation_size = self.symmetry["observation"].dim
        self.action_size = self.symmetry["action"].dim
        self._variables = self.variables()

    def __getstate__(self) -> dict[str, Any]:  # functions in the layout need not be picklable
        return {name: value for name, value in vars(self).items() if name != "_observation"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._observation = Observation(self.layout(), self.observation_limit)

    @abc.abstractmethod
    def layout(self) -> tuple[Entry, ...]:
        """The blocks of the observation, in order: the only place that says what is observed."""

    def variables(self) -> dict[str, Representation]:
        """How the group acts on each of the task's own variables, ``(n, dim)``; none by default."""
        return {}

    @property
    def substeps(self) -> int:
        """Physics steps per control step."""
        return round(self.control_timestep / self.model.opt.timestep)

    @property
    def max_steps(self) -> int:
        """Control steps after which an episode is truncated."""
        return round(self.episode_seconds / self.control_timestep)

    @abc.abstractmethod
    def sample_goal_state(self, n: int, generator: torch.Generator | None) -> State:
        """Sample n start states of the canonical goal, the one of the identity.

        The start of the equivalent goal g is ``transform_state(state, g)``: the starts of all goals
        are paired, so that goals are compared on the same draws.
        """

    def sample_goal_states(
        self, n: int, generator: torch.Generator | None, elements: Sequence[int] | None = None
    ) -> State:
        """Paired starts, n of every goal, goal by goal; of some goals only, given their elements."""
        canonical = self.sample_goal_state(n, generator)
        group = self.symmetry.group
        goals = range(group.order) if elements is None else checks.sequence("elements", elements, "indices")
        return concatenate([self.transform_state(canonical, g) for g in goals])

    def sample_initial_state(self, n: int, generator: torch.Generator | None) -> State:
        """Sample n start states for training, by default of all goals with equal chance.

        Mapping each draw by a uniformly drawn element makes the distribution exactly symmetric.
        """
        return self.mapped_at_random(self.sample_goal_state(n, generator), generator)

    def mapped_at_random(self, state: State, generator: torch.Generator | None) -> State:
        """Every row mapped by a uniformly drawn element: makes any distribution exactly symmetric."""
        device_of(generator)
        rows = len(checks.instance("state", state, State))
        order, device = self.symmetry.group.order, state.qpos.device
        element = torch.randint(order, (rows,), generator=generator, device=device)
        return self.transform_state(state, element)

    def restart(
        self, finished: State, generator: torch.Generator | None, rows: Tensor | None = None
    ) -> State:
        """Start states for rows whose episode is over; a curriculum judges ``finished`` here.

        Args:
            finished: the last state of these rows; ``finished.time`` is 0 where no step was made.
            generator: the environment's generator; draw from nothing else.
            rows: on a device, where to know how many rows are over is a stop, ``finished`` is the state of
                all n, and this a mask ``(n,)`` of those that are over: starts of the others are not used,
                and a curriculum must not judge them. None: all are over.
        """
        return self.sample_initial_state(len(finished), generator)

    def randomize(  # noqa: B027  (optional, so not abstract)
        self, simulation: Engine, ids: Tensor, generator: torch.Generator | None
    ) -> None:
        """Randomise the physics of rows about to start (``Engine.expand``); off by default.

        Draw values whose distribution the group maps onto itself, or the task stops being
        symmetric.

        Args:
            simulation: the engine, whose fields are written to.
            ids: k row numbers; on a device, a mask of all n rows. Draw ``len(ids)`` values, and write them
                by :func:`tasks.draws.put`, which takes both.
            generator: the environment's generator; draw from nothing else.
        """

    def scale_friction(self, simulation: Engine, ids: Tensor, factor: Tensor) -> None:
        """Multiply the model's sliding friction, of all geoms, by a factor per row, ``(len(ids),)``."""
        put(simulation.expand("geom_friction")[..., 0], ids, factor[:, None] * self._friction.like(factor))

    @abc.abstractmethod
    def control(self, action: Tensor, state: State) -> Tensor:
        """Actuator controls for finite actions: ``(n, action_size)``, meant for [-1, 1], to ``(n, nu)``."""

    def update(self, state: State, action: Tensor) -> dict[str, Tensor]:
        """Task variables after a step (last action, ...), by name; those not returned stay.

        Called after the reward and before the observation: the reward sees the variables from
        before the step.
        """
        return {}

    def observe(self, state: State) -> Tensor:
        """Observation, a new tensor of shape ``(n, observation_size)``, float32: the layout's entries."""
        return self._observation(state)

    def check_observation(self, state: State) -> None:
        """ValueError unless what is observed in a state has the sizes that the layout says."""
        self._observation.check(state)
        if (shape := tuple(self.observe(state).shape)) != (len(state), self.observation_size):
            raise ValueError(
                f"observation: expected {self.observation_size} numbers a row, as the layout of task "
                f"{self.name!r} says, got shape {shape}; leave observe() as it is, or correct the layout"
            )

    @abc.abstractmethod
    def reward_terms(self, state: State, action: Tensor) -> dict[str, Tensor]:
        """Terms of the reward of the step that led to ``state`` by ``action``, weighted, ``(n,)`` each."""

    def reward(self, state: State, action: Tensor) -> Tensor:
        """The sum of the terms, ``(n,)``."""
        terms = tuple(self.reward_terms(state, action).values())
        return terms[0] if len(terms) == 1 else torch.stack(terms).sum(dim=0)

    def terminated(self, state: State) -> Tensor | None:
        """Whether the episode ends here with no future value, ``(n,)`` bool; None: in no row."""
        return None

    def success(self, state: State) -> Tensor | None:
        """Whether an episode that ends in ``state`` reached its goal, ``(n,)`` bool; None: undefined."""
        return None

    def behaviour(self, state: State) -> dict[str, Tensor]:
        """What the robot does in the step that led to ``state``, whatever it is paid for, ``(n,)`` each.

        Evaluations add it up over an episode (how far did it turn?); empty by default. Invariant under
        the group, like the reward, or goals could not be compared.
        """
        return {}

    def transform_state(self, state: State, g: Element) -> State:
        """L_g on the full state, task variables included; a new state.

        Args:
            state: n rows.
            g: an element by index or name, or one index per row, ``(n,)``.

        Raises:
            KeyError: a variable that :meth:`variables` does not declare.
        """
        checks.instance("state", state, State)
        unknown = [name for name in state.variables if name not in self._variables]
        if unknown:
            raise KeyError(
                f"expected every task variable in variables(), which declares {list(self._variables)}, got "
                f"{unknown}; say how they transform"
            )
        position, rotation = state.mocap_pos, state.mocap_quat
        if position is not None and rotation is not None and self.model.nmocap:
            position, rotation = self.robot.map_mocap(position, rotation, g)
        return State(
            qpos=self.robot.map_qpos(state.qpos, g),
            qvel=self.robot.map_qvel(state.qvel, g),
            mocap_pos=position,
            mocap_quat=rotation,
            time=state.time.clone(),
            variables={name: self._variables[name](x, g) for name, x in state.variables.items()},
        )

    def metrics(self) -> dict[str, float]:
        """How training goes (success rate, curriculum level), always the same names; empty by default."""
        return {}

    def state_dict(self) -> dict[str, Any]:
        """What the task learned itself during training (a curriculum phase); empty by default."""
        return {}

    def load_state_dict(self, saved: dict[str, Any]) -> None:  # noqa: B027
        """Continue from :meth:`state_dict`."""


def check_timestep(timestep: float) -> float:
    """A step of the physics, s; one of less than a microsecond would never get to the end of an episode."""
    return checks.real("physics_timestep", timestep, 1e-6)


def load_model(asset: str, edit: Edit | None = None) -> Any:
    """Compile an MJCF file of tasks/assets; its includes are found there too.

    Args:
        asset: file name, such as ``"cartpole.xml"``.
        edit: changes the ``MjSpec`` before it is compiled.

    Example:
        >>> load_model("cartpole.xml").nu
        1
    """
    folder = importlib.resources.files("tasks") / "assets"
    files = {f.name: f.read_bytes() for f in folder.iterdir() if f.name.endswith(".xml")}
    if not isinstance(asset, str) or asset not in files:
        raise FileNotFoundError(
            f"expected {asset!r} among the files of tasks/assets, got {sorted(files)}; "
            "a missing file there means that the package was installed without its data"
        )
    spec = mj.MjSpec.from_string(files.pop(asset).decode(), include=files)
    if edit is not None:
        checks.function("edit", edit)(spec)
    return spec.compile()


def register(cls: T) -> T:
    """Class decorator that makes a task known under its ``name``.

    Raises:
        ValueError: the name is taken.
        TypeError: no task, or one without a name.
    """
    if not isinstance(cls, type) or not issubclass(cls, Task):
        raise TypeError(f"expected a subclass of Task, got {checks.shown(cls)}; decorate the class itself")
    checks.instance(f"{cls.__name__}.name", getattr(cls, "name", None), str, "give the class a name")
    if cls.name in _TASKS:
        raise ValueError(
            f"expected a new task name, got {cls.name!r}, which "
            f"{_TASKS[cls.name].__qualname__} has; rename one of the two"
        )
    _TASKS[cls.name] = cls
    return cls


def registered() -> tuple[str, ...]:
    """Names of all tasks, in the order of their definition."""
    return tuple(_TASKS)


def create(name: str, **task_kwargs: Any) -> Task:
    """The description of a task by name.

    Args:
        name: one of ``tasks.ALL_TASKS``.
        **task_kwargs: keyword arguments of the task's class.

    Raises:
        KeyError: no such task; the message lists the names.
        TypeError: an argument that this task does not take; the message lists the ones it takes.

    Example:
        >>> create("cartpole", episode_seconds=2.0).max_steps
        100
    """
    checks.one_of("task", name, _TASKS, KeyError)
    checks.refuse_unknown(f"task {name!r}", task_kwargs, checks.keywords(_TASKS[name]))
    return _TASKS[name](**task_kwargs)
