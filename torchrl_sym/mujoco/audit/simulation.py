"""Settings and contacts with which the simulator breaks a symmetry that a model has.

Even an exactly symmetric model is simulated symmetrically only if the solver treats all contacts alike, the
friction cones look the same from every side, and contacts are found by formulas rather than by iteration.
The warnings name the settings, and the pairs of geoms, for which that fails.
"""

from __future__ import annotations

import numpy as np

from torchrl_sym.groups import PointGroup
from torchrl_sym.mujoco.audit.contacts import contact_warnings
from torchrl_sym.mujoco.model.filters import active_geoms
from torchrl_sym.mujoco.model.releases import weld_ids
from torchrl_sym.mujoco.model.types import BALL, FREE, HINGE, SLIDE, MjModel, mj, name_of

_OPAQUE = {
    int(mj.mjtGeom.mjGEOM_HFIELD): "height field",
    int(mj.mjtGeom.mjGEOM_SDF): "signed distance field",
}


def simulation_warnings(model: MjModel, group: PointGroup) -> tuple[str, ...]:
    """Settings and contacts with which the simulator breaks a symmetry that the model has."""
    out, option = [], model.opt
    solver = mj.mjtSolver(option.solver)
    if solver != mj.mjtSolver.mjSOL_NEWTON:
        why = (
            "treats contacts in order"
            if solver == mj.mjtSolver.mjSOL_PGS
            else "stops before it has converged"
        )
        name = solver.name.removeprefix("mjSOL_")
        out.append(f'solver {name} {why}, so that a mirrored state moves differently; use solver="Newton"')
    if option.noslip_iterations > 0:
        out.append("noslip_iterations > 0 treats contacts in order; set it to 0")
    active = active_geoms(model)
    has_friction = bool((model.geom_condim[active] > 1).any() or (model.pair_dim > 1).any())
    if option.cone == int(mj.mjtCone.mjCONE_PYRAMIDAL) and has_friction:
        remedy = 'use cone="elliptic"'
        turned = [
            name
            for name, matrix in zip(group.names, group.matrices.numpy(), strict=True)
            if np.abs(matrix - matrix.round()).max() > 1e-9
        ]
        if turned:
            out.append(f"pyramidal friction cones follow the world's axes and break {turned}; {remedy}")
        elif _can_yaw(model):
            out.append(
                "pyramidal friction cones follow the world's axes, and the base can yaw: the symmetry "
                f"holds in the world's frame but not in the robot's; {remedy}"
            )
    if (model.sensor_type == int(mj.mjtSensor.mjSENS_MAGNETOMETER)).any():
        field = np.asarray(option.magnetic)
        for name, matrix in zip(group.names, group.matrices.numpy(), strict=True):
            if not np.allclose(np.linalg.det(matrix) * matrix @ field, field, atol=1e-9):
                out.append(f"{name!r} turns the magnetic field, so that magnetometers break it")
    return (*out, *contact_warnings(model))


def _can_yaw(model: MjModel) -> bool:
    """Whether a body floats in the plane and turns about the vertical axis."""
    for body in np.flatnonzero((weld_ids(model)[model.body_parentid] == 0) & (model.body_jntnum > 0)):
        joints = int(model.body_jntadr[body]) + np.arange(int(model.body_jntnum[body]))
        kinds = model.jnt_type[joints]
        turns = (kinds == BALL) | ((kinds == HINGE) & (np.abs(model.jnt_axis[joints, 2]) > 0.5))
        if (kinds == FREE).any() or ((kinds == SLIDE).sum() >= 2 and turns.any()):
            return True
    return False


def unchecked_elements(model: MjModel) -> tuple[str, ...]:
    """What :func:`~torchrl_sym.mujoco.audit` does not compare in a model, in words."""
    out = [
        f"the shape of {_OPAQUE[int(model.geom_type[g])]} {name_of(model, 'geom', int(g))!r}"
        for g in active_geoms(model)
        if int(model.geom_type[g]) in _OPAQUE
    ]
    counts = {"plugins": model.nplugin, "flexes": model.nflex, "skins": model.nskin}
    out += [f"{count} {name}" for name, count in counts.items() if count]
    out += ["surface velocities of geoms"] * bool(np.any(model.geom_surfacevel))
    out += ["actuators with several controls"] * (getattr(model, "nactuator", model.nu) != model.nu)
    return tuple(out)
