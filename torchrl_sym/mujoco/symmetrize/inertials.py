"""Averages of masses, centres of mass and inertias."""

from __future__ import annotations

from typing import Any

import numpy as np

from torchrl_sym.mujoco.model.rotations import quaternion
from torchrl_sym.mujoco.model.types import Array, mj, name_of
from torchrl_sym.mujoco.symmetrize.averager import Averager


def average_inertials(averager: Averager) -> None:
    """Of every link; the inertia of several welded bodies goes to the one that moves."""
    model, turns, links = averager.model, averager.turns, averager.links
    masses = averager.mean(averager.bodies, lambda _, a: links[a].mass)
    lumps = averager.lumps
    centers = averager.points(averager.bodies, lumps.centers, int)
    inertias = averager.mean(averager.bodies, lambda g, a: turns[g] @ lumps.inertias[a] @ turns[g].T)
    for b in range(1, model.nbody):  # what the compiler found, as it shall not look at the geoms again
        found = (getattr(model, f"body_{name}")[b] for name in ("mass", "ipos", "iquat", "inertia"))
        _set_inertial(averager.spec.bodies[b], *found)
    compiler = averager.spec.compiler
    compiler.inertiafromgeom = mj.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
    compiler.boundmass = compiler.boundinertia = 0.0
    if getattr(compiler, "settotalmass", -1.0) > 0:  # deprecated since MuJoCo 3.17
        compiler.settotalmass = -1.0
    compiler.balanceinertia = False
    for b in averager.links.keys() - {0} - averager.carried:
        link, name, turn = links[b], name_of(model, "body", b), averager.rotation[b]
        if not masses[b] > 0:
            continue
        # the centre may have stayed in the world while the frame moved, which is no change of the robot
        new, size = averager.in_body(b, centers[b]), float(np.trace(lumps.inertias[b])) or 1.0
        old = turn.T @ (lumps.centers[b] - averager.data.xpos[b])
        changed = [
            averager.write(None, "", masses[b], link.mass, "mass", name),
            averager.write(None, "", new, old, "centre of mass", name, averager.extent),
            averager.write(None, "", inertias[b], lumps.inertias[b], "inertia", name, size),
        ]
        if any(changed):
            moments, axes = np.linalg.eigh(turn.T @ inertias[b] @ turn)
            axes[:, 0] *= np.linalg.det(axes)
            _set_inertial(averager.spec.bodies[b], float(masses[b]), new, quaternion(axes), moments)
            for welded in set(link.bodies) - {b}:
                _set_inertial(averager.spec.bodies[welded], 0.0, np.zeros(3), np.eye(4)[0], np.zeros(3))


def _set_inertial(body: Any, mass: float, place: Array, turn: Array, moments: Array) -> None:
    body.explicitinertial, body.mass = True, float(mass)
    body.ipos, body.iquat, body.inertia = place.tolist(), turn.tolist(), moments.tolist()
    body.ialt.type = mj.mjtOrientation.mjORIENTATION_QUAT
    body.fullinertia = [np.nan] * 6
