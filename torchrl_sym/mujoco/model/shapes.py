"""Convex shapes, compared by what they are, and which of them may collide.

Two convex bodies are equal if and only if their support functions h(d) = max over their points p of d . p
are: under the isometry R a shape A becomes one with h_RA(d) = h_A(R^T d). So shapes are compared by what
they are, whatever frame or sign a modeller gave them: a sphere may be turned, a capsule flipped. Meshes
collide by their convex hull, hence the same comparison holds for their vertices.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from torchrl_sym.mujoco.model.types import Array, MjModel, mj

_GEOM = mj.mjtGeom


def _directions(count: int = 96) -> Array:
    """Unit vectors spread over the sphere in a spiral that no point group keeps."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(count) + 0.1
    radius = np.sqrt(1 - z**2)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)


DIRECTIONS = _directions()


def support(
    kind: int,
    size: Array,
    center: Array,
    rotation: Array,
    directions: Array,
    vertices: Array | None = None,
) -> Array:
    """Support function of a primitive or of the hull of vertices, at each direction ``(n, 3)``."""
    local = directions @ rotation
    if kind == _GEOM.mjGEOM_SPHERE:
        reach = np.full(len(local), size[0])
    elif kind == _GEOM.mjGEOM_CAPSULE:
        reach = size[0] + size[1] * np.abs(local[:, 2])
    elif kind == _GEOM.mjGEOM_CYLINDER:
        reach = size[0] * np.linalg.norm(local[:, :2], axis=1) + size[1] * np.abs(local[:, 2])
    elif kind == _GEOM.mjGEOM_ELLIPSOID:
        reach = np.linalg.norm(local * size, axis=1)
    elif kind == _GEOM.mjGEOM_BOX:
        reach = np.abs(local) @ size
    elif vertices is not None:
        reach = (local @ vertices.T).max(axis=1)
    else:
        reach = np.zeros(len(local))  # only the place is compared
    return directions @ center + reach


def touching(model: MjModel) -> NDArray[np.bool_]:
    """Which pairs of geoms may collide according to their bits, before excludes; ``(ngeom, ngeom)``."""
    if model.opt.disableflags & int(mj.mjtDisableBit.mjDSBL_CONTACT):
        return np.zeros((model.ngeom, model.ngeom), dtype=bool)
    bits = (model.geom_contype[:, None] & model.geom_conaffinity) != 0
    link = model.body_weldid[model.geom_bodyid]
    return (bits | bits.T) & (link[:, None] != link)


def active_geoms(model: MjModel) -> NDArray[np.intp]:
    """Numbers of the geoms that matter for motion: they may collide or feel a fluid."""
    active = np.array(touching(model).any(axis=1))
    if not model.opt.disableflags & int(mj.mjtDisableBit.mjDSBL_CONTACT):
        active[model.pair_geom1] = active[model.pair_geom2] = True
    if model.opt.density > 0 or model.opt.viscosity > 0:
        active |= model.geom_fluid[:, 0] > 0
    return np.flatnonzero(active)
