"""What an audit says: its verdict and table, what it warns of, and what it does not look at.

Even an exactly symmetric model is simulated symmetrically only if the solver treats all contacts alike, the
friction cones look the same from every side, and contacts are found by formulas rather than by iteration.
The warnings name the settings, and the pairs of geoms, for which that fails.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchrl_sym.groups import PointGroup
from torchrl_sym.mujoco.contacts import contact_warnings
from torchrl_sym.mujoco.geoms import active_geoms
from torchrl_sym.mujoco.links import BALL, FREE, HINGE, SLIDE, MjModel, mj, name_of

_OPAQUE = {
    int(mj.mjtGeom.mjGEOM_HFIELD): "height field",
    int(mj.mjtGeom.mjGEOM_SDF): "signed distance field",
}


@dataclass(frozen=True)
class Residual:
    """The worst part for one term under one element; ``name`` reads "part -> its image"."""

    element: str
    term: str
    residual: float
    name: str


@dataclass(frozen=True)
class AuditReport:
    """What :func:`audit` found; ``str()`` gives a table.

    Attributes:
        elements: names of the elements that were tried, without the identity.
        residuals: one row per term and element that the model has.
        tolerance: largest residual that counts as exact.
        reason: why the model lacks the symmetry, None if it has it at least approximately.
        warnings: settings and contacts with which even an exact model is not simulated symmetrically.
        unchecked: what was not compared.
    """

    elements: tuple[str, ...]
    residuals: tuple[Residual, ...]
    tolerance: float
    reason: str | None = None
    warnings: tuple[str, ...] = ()
    unchecked: tuple[str, ...] = ()

    @property
    def worst(self) -> Residual | None:
        """The row with the largest residual."""
        return max(self.residuals, key=lambda row: row.residual, default=None)

    @property
    def exact(self) -> bool:
        """Whether everything that was compared agrees to the tolerance."""
        return self.reason is None and all(row.residual <= self.tolerance for row in self.residuals)

    @property
    def verdict(self) -> str:
        """One line: exact, approximate or not a symmetry."""
        if self.reason is not None:
            return f"not a symmetry ({self.reason})"
        if self.exact:
            return "exact" if not self.unchecked else "exact in what was checked"
        assert self.worst is not None
        return f"approximate (largest residual {phrase(self.worst)})"

    def __str__(self) -> str:
        lines = [self.verdict]
        terms = list(dict.fromkeys(row.term for row in self.residuals))
        cells = {(row.term, row.element): row for row in self.residuals}
        table = [["term", *self.elements, "worst"]]
        for term in terms:
            rows = [cells.get((term, element)) for element in self.elements]
            worst = max((row for row in rows if row), key=lambda row: row.residual)
            shown = worst.name if worst.residual > self.tolerance else ""
            numbers = ["-" if row is None else self._number(row.residual) for row in rows]
            table.append([term, *numbers, shown])
        if terms:
            widths = [max(map(len, column)) for column in zip(*table, strict=True)]
            lines.append("")
            for row in table:
                lines.append("  ".join(f"{c:<{w}s}" for c, w in zip(row, widths, strict=True)).rstrip())
        lines += ["", *(f"warning: {text}" for text in self.warnings)] if self.warnings else []
        lines += ["", *(f"not checked: {text}" for text in self.unchecked)] if self.unchecked else []
        return "\n".join(lines)

    def _number(self, residual: float) -> str:
        return "0" if residual <= self.tolerance else f"{residual:.1e}"


def phrase(row: Residual) -> str:
    """A row in words."""
    return f"{row.residual:.2g}: {row.term}, {row.element}, {row.name}"


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
    for body in np.flatnonzero((model.body_weldid[model.body_parentid] == 0) & (model.body_jntnum > 0)):
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
    polynomials = ("jnt_stiffnesspoly", "dof_dampingpoly", "tendon_stiffnesspoly", "tendon_dampingpoly")
    out += [f"{field}" for field in polynomials if np.any(getattr(model, field, 0))]
    out += ["actuators with several controls"] * (getattr(model, "nactuator", model.nu) != model.nu)
    return tuple(out)
