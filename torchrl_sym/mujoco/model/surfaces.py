"""Surfaces of convex shapes: points on them, and how far other points are outside.

Modellers build one surface of different pieces: a box twice, or cut into halves. What touches the outside
is the union of the pieces, and a shape is covered by others if no point of its surface is outside of all of
them.
"""

from __future__ import annotations

import numpy as np

from torchrl_sym.mujoco.model.shapes import (
    BOX,
    CAPSULE,
    CYLINDER,
    DIRECTIONS,
    ELLIPSOID,
    MESH,
    SPHERE,
    furthest,
    hull_vertices,
)
from torchrl_sym.mujoco.model.types import Array, MjData, MjModel

_BISECTIONS = 12  # points end up within a thousandth of a shape's size under its surface


def surface_points(model: MjModel, pose: MjData, geom: int) -> Array:
    """Points of the world on a geom's surface: its corners, and points all around just below it."""
    kind = int(model.geom_type[geom])
    vertices = hull_vertices(model, int(model.geom_dataid[geom])) if kind == MESH else None
    corners = furthest(kind, model.geom_size[geom][None], DIRECTIONS[None], vertices)[0]

    rays = DIRECTIONS * model.geom_aabb[geom, 3:]  # long shapes get points along their whole length
    low, high = np.zeros(len(rays)), np.full(len(rays), 4.0)
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        inside = _excess(model, geom, middle[:, None] * rays) <= 0
        low, high = np.where(inside, middle, low), np.where(inside, high, middle)

    frame = pose.geom_xmat[geom].reshape(3, 3)
    return pose.geom_xpos[geom] + np.concatenate([corners, low[:, None] * rays]) @ frame.T


def outside(model: MjModel, pose: MjData, geom: int, points: Array) -> Array:
    """How far points of the world are outside of a geom, 0 within it; ``(n, 3)`` to ``(n,)``.

    Exact for spheres, capsules, cylinders and boxes; near the edges of meshes and far from ellipsoids it is
    too small.
    """
    frame = pose.geom_xmat[geom].reshape(3, 3)
    return np.maximum(_excess(model, geom, (points - pose.geom_xpos[geom]) @ frame), 0.0)


def _excess(model: MjModel, geom: int, x: Array) -> Array:
    """Distance from a geom's surface of points in its frame; negative or zero inside."""
    kind, size = int(model.geom_type[geom]), model.geom_size[geom]
    if kind == SPHERE:
        return np.linalg.norm(x, axis=1) - size[0]
    if kind == CAPSULE:
        along = np.clip(x[:, 2], -size[1], size[1])
        return np.hypot(np.hypot(x[:, 0], x[:, 1]), x[:, 2] - along) - size[0]
    if kind == CYLINDER:
        across = np.hypot(x[:, 0], x[:, 1]) - size[0]
        return np.hypot(np.maximum(across, 0.0), np.maximum(np.abs(x[:, 2]) - size[1], 0.0))
    if kind == ELLIPSOID:
        reach, slope = (np.linalg.norm(x / size**power, axis=1) for power in (1, 2))
        return reach * (reach - 1) / np.maximum(slope, 1e-300)
    if kind == BOX:
        return np.linalg.norm(np.maximum(np.abs(x) - size, 0.0), axis=1)
    return _excess_of_hull(model, int(model.geom_dataid[geom]), x)


def _excess_of_hull(model: MjModel, mesh: int, x: Array) -> Array:
    faces = int(model.mesh_polyadr[mesh]) + np.arange(int(model.mesh_polynum[mesh]))
    if not len(faces):
        return np.full(len(x), np.inf)
    corners = model.mesh_vertadr[mesh] + model.mesh_polyvert[model.mesh_polyvertadr[faces]]
    normals = np.asarray(model.mesh_polynormal[faces], dtype=float)
    heights = (normals * model.mesh_vert[corners]).sum(axis=1)
    return (x @ normals.T - heights).max(axis=1)
