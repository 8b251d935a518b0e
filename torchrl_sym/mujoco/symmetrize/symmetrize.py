"""Make a nearly symmetric MuJoCo model exactly symmetric, by averaging over the group.

Robots are meant to be symmetric, but their models come from weighing and from drawings with cables in them:
a hip's centre of mass is 0.1 mm off, a battery sits to the left. If sigma_g(a) is the image of element a
under the group element g, and rho_g says how g moves a quantity x (a mass stays, a position becomes R_g x,
an inertia R_g x R_g^T, a joint's range is flipped by its sign and shifted by its offset), then the average

    x'_b = 1/|G| sum over g of rho_g(x_a),   with b = sigma_g(a),

is kept by every element, and equals x if x was kept already.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from torchrl_sym.groups import PointGroup
from torchrl_sym.mujoco.model.shapes import PLANE
from torchrl_sym.mujoco.symmetrize.averager import Averager, MjSpec
from torchrl_sym.mujoco.symmetrize.inertials import average_inertials
from torchrl_sym.mujoco.symmetrize.parameters import average_actuators, average_joints
from torchrl_sym.mujoco.symmetrize.places import place_joints
from torchrl_sym.mujoco.symmetrize.report import SymmetrizeReport
from torchrl_sym.mujoco.symmetrize.shapes import PRIMITIVE, average_geoms, average_sites


def symmetrize(
    spec: MjSpec,
    group: PointGroup,
    keyframe: int | str | None = None,
    *,
    tolerance: float = 1e-2,
    carried: Sequence[str] = (),
    axis: tuple[float, float] | None = None,
) -> MjSpec:
    """A copy of a model that is exactly symmetric; see :func:`symmetrize_with_report`.

    Example:
        >>> import mujoco
        >>> from torchrl_sym import PointGroup
        >>> spec = mujoco.MjSpec.from_string('''<mujoco><worldbody>
        ...   <body name="left" pos="0 .1 0"><joint axis="1 0 0"/><geom size=".1" mass="1.1"/></body>
        ...   <body name="right" pos="0 -.1 0"><joint axis="1 0 0"/><geom size=".1" mass="0.9"/></body>
        ... </worldbody></mujoco>''')
        >>> symmetrize(spec, PointGroup.reflection("y")).compile().body("left").mass.item()
        1.0
    """
    return symmetrize_with_report(spec, group, keyframe, tolerance=tolerance, carried=carried, axis=axis)[0]


def symmetrize_with_report(
    spec: MjSpec,
    group: PointGroup,
    keyframe: int | str | None = None,
    *,
    tolerance: float = 1e-2,
    carried: Sequence[str] = (),
    axis: tuple[float, float] | None = None,
) -> tuple[MjSpec, SymmetrizeReport]:
    """A copy of a model that is exactly symmetric, and what was changed for it.

    Averaged are masses, centres of mass and inertias; joint anchors, axes, ranges, springs, damping,
    armature and friction losses; gains, biases and ranges of actuators; the places of sites; and the
    places, sizes and contact parameters of spheres, capsules, cylinders, boxes and ellipsoids. Not
    averaged, and listed if the model has any: meshes and other shapes, tendons, equality constraints and
    contact pairs. Bodies and sites keep their rotation. A link of several welded bodies whose inertia
    changes gets it on the body that moves, and the others become massless.

    Compile the result where exactness matters: ``to_xml`` rounds numbers, and a model read back from it is
    symmetric to about five digits.

    Args:
        spec: the model; it is not modified.
        group: the group that the model nearly has.
        keyframe: a pose that the group keeps, by name or number; by default it is found, as in
            :func:`~torchrl_sym.mujoco.derive`.
        tolerance: how far joints, sites and geoms may be from their image's, as in
            :func:`~torchrl_sym.mujoco.derive`.
        carried: names of bodies that a turn of the world only carries along, as in
            :func:`~torchrl_sym.mujoco.derive`. They need no symmetry and are left as they are.
        axis: a point (x, y) of the axis that the group acts about; by default it is found.

    Raises:
        SymmetryError: a joint or actuator has no image, or a body cannot be carried by an element; the
            message names it.
        KeyError: no such keyframe, or no such body to be carried.
    """
    averager = Averager(spec, group, keyframe, tolerance, carried, axis)
    place_joints(averager)
    average_inertials(averager)
    average_joints(averager)
    average_actuators(averager)
    average_sites(averager)
    average_geoms(averager)
    model = averager.model
    others = int((~np.isin(model.geom_type, (*PRIMITIVE, PLANE))).sum())
    counts = {"meshes and other shapes": others, "tendons": model.ntendon}
    counts |= {"equality constraints": model.neq, "contact pairs": model.npair}
    averager.report.left += [f"{n} {what}" for what, n in counts.items() if n]
    return averager.spec, averager.report
