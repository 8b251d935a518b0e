"""Is a MuJoCo model really symmetric? Compare every physical term of each part with its image's.

`derive` finds where everything goes; it says nothing on whether the left leg weighs what the right one
does. `audit` does: for each element g of a group, the mass, inertia, axes, ranges, gains, shapes, ... of
every part are moved by g and compared with those of the part's image. What differs in unit is made
relative, to what is much for a robot:

====================================  ==============================================================
masses, gravity compensation          the total mass of what moves
lengths (centres of mass, anchors)    the size of the moving bodies, whatever room they stand in
angles (axes, gravity)                a radian
inertias                              the largest inertia of a link
friction, damping, springs of joints  the joint's torque (:mod:`~torchrl_sym.mujoco.audit.scales`)
ranges                                their width
everything else                       the largest value among parts of its kind
====================================  ==============================================================

A model is *exact* if nothing of its dynamics and collision shapes differs: its steps then commute with g to
rounding. Whatever changes a mirrored step is compared, which a test makes sure of: it changes every number
of a rich model. The report also warns of settings that make the solver itself break the symmetry.
"""

from __future__ import annotations

from collections.abc import Sequence

from torchrl_sym import checks
from torchrl_sym.groups import PointGroup, check_group
from torchrl_sym.mujoco.audit.actuators import compare_actuators
from torchrl_sym.mujoco.audit.bodies import compare_fluid, compare_gravity, compare_links
from torchrl_sym.mujoco.audit.comparison import Comparison
from torchrl_sym.mujoco.audit.equalities import compare_equalities
from torchrl_sym.mujoco.audit.filters import compare_contacts
from torchrl_sym.mujoco.audit.joints import (
    compare_constraint_weights,
    compare_dofs,
    compare_joints,
    compare_order,
)
from torchrl_sym.mujoco.audit.report import AuditReport, Residual
from torchrl_sym.mujoco.audit.scales import efforts_of
from torchrl_sym.mujoco.audit.shapes import compare_shapes
from torchrl_sym.mujoco.audit.simulation import simulation_warnings, unchecked_elements
from torchrl_sym.mujoco.audit.sites import compare_sites
from torchrl_sym.mujoco.audit.tendons import compare_tendons
from torchrl_sym.mujoco.derive import ModelSymmetry, SymmetryError, derive
from torchrl_sym.mujoco.model.types import MjModel

_STILL = (
    "nothing in the model can move; a robot whose root is nailed to the world, as every URDF's is, needs a "
    "free joint: --free-base on the command line, or <freejoint/> in its body"
)


def audit(
    model: MjModel,
    group: PointGroup,
    keyframe: int | str | None = None,
    *,
    axis: tuple[float, float] | None = None,
    tolerance: float = 1e-8,
    carried: Sequence[str] = (),
) -> AuditReport:
    """How far each element of a group is from a symmetry of a model, term by term.

    Args:
        model: the compiled model.
        group: the group to try; it acts about a vertical axis.
        keyframe: a pose that the group keeps, by name or number. By default it is found, as in
            :func:`~torchrl_sym.mujoco.derive`.
        axis: where the vertical axis stands, (x, y) in metres. By default it is found.
        tolerance: largest residual that counts as exact.
        carried: names of bodies that a turn of the world only carries along, as in
            :func:`~torchrl_sym.mujoco.derive`; their shape and inertia need no symmetry.

    Raises:
        KeyError: no such keyframe, or no such body to be carried.
        ValueError: a body that cannot be carried under any group.

    Example:
        >>> import mujoco
        >>> from torchrl_sym import PointGroup
        >>> model = mujoco.MjModel.from_xml_string('''<mujoco><worldbody>
        ...   <body name="left" pos="0 .1 0"><joint axis="1 0 0"/><geom size=".1" mass="1"/></body>
        ...   <body name="right" pos="0 -.1 0"><joint axis="1 0 0"/><geom size=".1" mass="1.02"/></body>
        ... </worldbody></mujoco>''')
        >>> audit(model, PointGroup.reflection("y")).verdict
        'approximate (largest residual 0.02: inertia, reflect-y, ...)'
    """
    tolerance, group = checks.real("tolerance", tolerance, 0.0), check_group(group)
    try:
        symmetry = derive(model, group, keyframe, axis=axis, carried=carried)
    except SymmetryError as error:
        return refused(model, group, tolerance, str(error))
    return audit_derived(symmetry, tolerance)


def refused(model: MjModel, group: PointGroup, tolerance: float, reason: str) -> AuditReport:
    """The report on a group of which an element has no images."""
    elements = tuple(group.names[1:])
    if not can_move(model):
        return AuditReport(elements, (), tolerance, _STILL, "nothing")
    warnings, unchecked = simulation_warnings(model, group), unchecked_elements(model)
    return AuditReport(elements, (), tolerance, reason, "no", warnings, unchecked)


def audit_derived(symmetry: ModelSymmetry, tolerance: float) -> AuditReport:
    """The report on a symmetry that has been derived."""
    model, group = symmetry.model, symmetry.group
    elements = tuple(group.names[1:])
    if not can_move(model):
        return AuditReport(elements, (), tolerance, _STILL, "nothing")
    warnings, unchecked = simulation_warnings(model, group), unchecked_elements(model)
    matcher = symmetry.actions[0].matcher
    efforts = efforts_of(model, matcher.data, matcher.extent)

    rows: list[Residual] = []
    untold: tuple[str, ...] = ()
    loose: dict[str, None] = {}
    for g in range(1, group.order):
        run = Comparison(symmetry, g, efforts)
        loose |= dict.fromkeys(_compare(run))
        rows += run.worst.values()
        unchecked += tuple(text for text in run.unchecked if text not in unchecked)
        warnings += tuple(text for text in run.warnings if text not in warnings)
        untold += tuple(text for text in run.untold if text not in untold)
    if loose:
        shown = ", ".join(list(loose)[:4]) + ", ..." * (len(loose) > 4)
        text = f"{len(loose)} sites are out of place ({shown}); nothing in the model uses them, so do not"
        warnings += (f"{text} observe them",)
    return AuditReport(
        elements, tuple(rows), tolerance, warnings=warnings, unchecked=unchecked, untold=untold
    )


def can_move(model: MjModel) -> bool:
    """Whether anything in a model can move."""
    return model.nv > 0 or model.nmocap > 0


def _compare(c: Comparison) -> list[str]:
    """Run all comparisons; returns the unused sites that are out of place."""
    compare_gravity(c)
    compare_links(c)
    compare_joints(c)
    compare_order(c)
    compare_dofs(c)
    compare_actuators(c)
    compare_tendons(c)
    compare_equalities(c)
    compare_fluid(c)
    compare_contacts(c, compare_shapes(c))
    loose = compare_sites(c)
    compare_constraint_weights(c)
    return loose
