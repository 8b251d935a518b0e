"""Which symmetries does a model have? Every element about its vertical axis, tried one by one.

The isometries that keep the vertical axis are its turns and the mirrors in planes through it. A finite set
of them that is closed is C_n (the n turns by 360/n degrees) or D_n (these and n mirrors), so it is enough
to know the largest n and one mirror. Turns by 360/12 contain those by 360/2, 360/3, 360/4 and 360/6: where
an order fails, its multiples need not be tried. Mirror planes are proposed by the links
(:mod:`~torchrl_sym.mujoco.symmetries.planes`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from torchrl_sym import checks
from torchrl_sym.groups import PointGroup
from torchrl_sym.mujoco.audit import AuditReport
from torchrl_sym.mujoco.audit.audit import audit_derived, refused
from torchrl_sym.mujoco.derive import ModelSymmetry, SymmetryError, derive
from torchrl_sym.mujoco.model.poses import reference_pose
from torchrl_sym.mujoco.model.types import MjModel, check_model
from torchrl_sym.mujoco.symmetries.planes import candidate_planes
from torchrl_sym.mujoco.symmetries.report import Candidate, SymmetriesReport

MOST_FOLD = 12
_USUAL_FOLD = 4  # half, third and quarter turns are reported even where they fail
_TURNED = "turned by"  # in the words for a pose: a free base was turned to suit the group
_NEAR_PLANE = 10.0  # of planes nearer than this to each other, only the better one counts
_SAME_PLANE = 0.5  # degrees; candidate planes nearer than this to one that was found are that one


def symmetries(
    model: MjModel,
    keyframe: int | str | None = None,
    *,
    axis: tuple[float, float] | None = None,
    tolerance: float = 1e-8,
    carried: Sequence[str] = (),
) -> SymmetriesReport:
    """Every symmetry about the vertical axis that a model has: turns up to 12-fold, mirrors in any plane.

    Args:
        model: the compiled model.
        keyframe: a pose that the symmetries keep, by name or number. By default it is found, as in
            :func:`~torchrl_sym.mujoco.derive`.
        axis: where the vertical axis stands, (x, y) in metres. By default it is found.
        tolerance: largest residual that counts as exact, as in :func:`~torchrl_sym.mujoco.audit`.
        carried: bodies that turns only carry along, as in :func:`~torchrl_sym.mujoco.derive`.

    Raises:
        KeyError: no such keyframe, or no such body to be carried.
        TypeError, ValueError: no model, or an argument out of its range.

    Example:
        >>> import mujoco
        >>> model = mujoco.MjModel.from_xml_string('''<mujoco><worldbody>
        ...   <body name="left" pos="0 .1 0"><joint axis="1 0 0"/><geom size=".1" mass="1"/></body>
        ...   <body name="right" pos="0 -.1 0"><joint axis="1 0 0"/><geom size=".1" mass="1"/></body>
        ... </worldbody></mujoco>''')
        >>> print(symmetries(model).verdict)
        reflect-y: exact
    """
    check_model(model)
    checks.real("tolerance", tolerance, 0.0)

    names = [carried] if isinstance(carried, str) else checks.sequence("carried", carried)
    search = _Search(model, keyframe, axis, tolerance, tuple(names))
    turns = search.turns()
    mirrors = search.mirrors(max(turns, default=1))
    group = search.largest(turns, mirrors, ("exact", "approximate"))
    exact_group = search.largest(turns, mirrors, ("exact",))

    pose, place = "", (0.0, 0.0)
    if group.order > 1:
        robot, _ = search.look(group)
        assert robot is not None
        pose, place = robot.pose, robot.axis
    return SymmetriesReport(
        tuple(search.tried.values()), group, exact_group, search.look(group)[1], pose, place
    )


@dataclass
class _Search:
    """Audits elements, each within the smallest group that contains it."""

    model: MjModel
    keyframe: int | str | None
    axis: tuple[float, float] | None
    tolerance: float
    carried: tuple[str, ...]
    tried: dict[str, Candidate] = field(default_factory=dict)
    known: dict[PointGroup, tuple[ModelSymmetry | None, AuditReport]] = field(default_factory=dict)

    def look(self, group: PointGroup) -> tuple[ModelSymmetry | None, AuditReport]:
        """What a group does to the model, None if it has no images, and the audit."""
        if group not in self.known:
            self.known[group] = self._look(group)
        return self.known[group]

    def _look(self, group: PointGroup) -> tuple[ModelSymmetry | None, AuditReport]:
        try:
            robot = derive(self.model, group, self.keyframe, axis=self.axis, carried=self.carried)
        except SymmetryError as error:
            return None, refused(self.model, group, self.tolerance, str(error))
        if _TURNED in robot.pose:  # it is another plane of the robot's own frame, and is tried there
            reason = f"only with the base turned: {robot.pose}"
            return None, refused(self.model, group, self.tolerance, reason)
        return robot, audit_derived(robot, self.tolerance)

    def examine(self, group: PointGroup, usual: bool) -> Candidate:
        """Audit the group that an element generates; elements that people ask for are reported always."""
        (robot, report), name, moves = self.look(group), group.names[1], False
        if robot is not None and report.outcome in ("exact", "approximate"):
            moves = _moves(robot, 1)
        candidate = Candidate(name, report, moves)
        if candidate.found or usual:
            self.tried[name] = candidate
        return candidate

    def turns(self) -> dict[int, Candidate]:
        """The turns by 360/n degrees that the model has, by n."""
        found: dict[int, Candidate] = {}
        for n in range(2, MOST_FOLD + 1):
            if all(d in found for d in range(2, n) if n % d == 0):
                candidate = self.examine(PointGroup.rotation(n), usual=n <= _USUAL_FOLD)
                if candidate.found:
                    found[n] = candidate
        return found

    def mirrors(self, fold: int) -> dict[float, Candidate]:
        """Mirrors that the model has, by the angle of their normal; those that turns add are left out."""
        found: dict[float, Candidate] = {}
        for angle in candidate_planes(self.model, reference_pose(self.model, self.keyframe)):
            usual = angle in (0.0, 90.0)
            apart = {other: abs((angle - other + 90 / fold) % (180 / fold) - 90 / fold) for other in found}
            near = min(apart, key=lambda other: apart[other], default=None)
            if usual or near is None or apart[near] > _SAME_PLANE:
                candidate = self.examine(PointGroup.reflection(angle), usual)
                if not candidate.found:
                    continue
                if (
                    usual
                    or near is None
                    or apart[near] > _NEAR_PLANE
                    or _misfit(candidate) < _misfit(found[near])
                ):
                    found[angle] = candidate
                else:  # a plane that is nearly a better one
                    del self.tried[candidate.name]
        return found

    def largest(
        self, turns: dict[int, Candidate], mirrors: dict[float, Candidate], outcomes: tuple[str, ...]
    ) -> PointGroup:
        """The largest group of elements with these outcomes, all of which move something."""
        folds = [n for n, candidate in turns.items() if candidate.report.outcome in outcomes]
        angles = [angle for angle, candidate in mirrors.items() if candidate.report.outcome in outcomes]
        angles.sort(key=lambda angle: mirrors[angle].report.outcome != "exact")
        groups = [PointGroup.dihedral(n).turned(angle - 90.0) for n in folds for angle in angles]
        groups += [PointGroup.rotation(n) for n in folds]
        groups += [PointGroup.reflection(angle) for angle in angles]
        for group in sorted(groups, key=lambda group: -group.order):
            robot, report = self.look(group)
            if robot is not None and report.outcome in outcomes:
                faithful = _faithful(group, robot)
                if faithful.order > 1:
                    return faithful
        return PointGroup.trivial()


def _misfit(candidate: Candidate) -> float:
    worst = candidate.report.worst
    return 0.0 if worst is None else worst.residual


def _moves(robot: ModelSymmetry, g: int) -> bool:
    """Whether an element moves any coordinate, control or mocap body."""
    action = robot.actions[g]
    matrices = (
        action.coordinates.qpos,
        action.coordinates.mocap_position,
        action.coordinates.mocap_rotation,
        action.ctrl,
    )
    offsets = (action.coordinates.qpos_offset, action.ctrl_offset)
    fixed = all(np.allclose(m, np.eye(len(m)), atol=1e-9) for m in matrices)
    return not (fixed and all(np.allclose(x, 0.0, atol=1e-9) for x in offsets))


def _faithful(group: PointGroup, robot: ModelSymmetry) -> PointGroup:
    """A largest subgroup whose elements all move something: the others would only repeat samples."""
    idle = {name for g, name in enumerate(group.names) if g and not _moves(robot, g)}
    chosen: list[str] = []
    for name in group.names[1:]:
        if not idle & set(group.subgroup([*chosen, name]).names):
            chosen.append(name)
    return group.subgroup(chosen)
