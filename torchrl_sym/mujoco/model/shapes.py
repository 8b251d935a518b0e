"""Convex shapes, compared by what they are.

Two convex bodies are equal if and only if their support functions h(d) = max over their points p of d . p
are: under the isometry R a shape A becomes one with h_RA(d) = h_A(R^T d). So shapes are compared by what
they are, whatever frame or sign a modeller gave them: a sphere may be turned, a capsule flipped. Meshes
collide by their convex hull, hence the same comparison holds for their vertices. A plane is infinite for
contacts, so that only its normal and its height count.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from torchrl_sym.mujoco.model.types import Array, MjData, MjModel, mj

_GEOM = mj.mjtGeom
PLANE, SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX, MESH = (
    int(kind)
    for kind in (
        _GEOM.mjGEOM_PLANE,
        _GEOM.mjGEOM_SPHERE,
        _GEOM.mjGEOM_CAPSULE,
        _GEOM.mjGEOM_ELLIPSOID,
        _GEOM.mjGEOM_CYLINDER,
        _GEOM.mjGEOM_BOX,
        _GEOM.mjGEOM_MESH,
    )
)
SOLID = (SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX, MESH)  # what has a surface that is known here


def _directions(count: int = 96) -> Array:
    """Unit vectors spread over the sphere in a spiral that no point group keeps."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.pi * (3 - np.sqrt(5)) * np.arange(count) + 0.1
    radius = np.sqrt(1 - z**2)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=1)


DIRECTIONS = _directions()


def furthest(kind: int, sizes: Array, local: Array, vertices: Array | None = None) -> Array:
    """The point of each shape that lies furthest in each direction, in the shape's own frame.

    Args:
        kind: type of the shapes, as of geoms and sites.
        sizes: their sizes, ``(n, 3)``.
        local: directions in their frames, ``(n, m, 3)``.
        vertices: of the hull that all of them are, for meshes.

    Returns:
        Points ``(n, m, 3)``; the origin for shapes of which only the place is compared.
    """
    sizes = sizes[:, None]
    if kind == SPHERE:
        return sizes[..., :1] * local
    if kind == CAPSULE:
        return sizes[..., :1] * local + sizes[..., 1:2] * np.sign(local) * (0.0, 0.0, 1.0)
    if kind == CYLINDER:
        across = np.linalg.norm(local[..., :2], axis=-1, keepdims=True)
        rim = sizes[..., :1] * local[..., :2] / np.maximum(across, 1e-300)
        return np.concatenate([rim, sizes[..., 1:2] * np.sign(local[..., 2:])], axis=-1)
    if kind == ELLIPSOID:
        scaled = sizes * local
        return sizes * scaled / np.linalg.norm(scaled, axis=-1, keepdims=True)
    if kind == BOX:
        return sizes * np.sign(local)
    if vertices is not None:
        return vertices[(local @ vertices.T).argmax(axis=-1)]
    return np.zeros_like(local)


def supports(kind: int, sizes: Array, centers: Array, frames: Array, directions: Array) -> Array:
    """Support functions ``(n, m)`` of primitive shapes at directions ``(m, 3)`` of the world."""
    local = directions @ frames
    return centers @ directions.T + (local * furthest(kind, sizes, local)).sum(axis=-1)


def geom_supports(model: MjModel, pose: MjData, geoms: NDArray[np.intp], directions: Array) -> Array:
    """Support functions of geoms, ``(n, m)``; normal and height of planes, padded with zeros."""
    kinds, out = model.geom_type[geoms], np.zeros((len(geoms), len(directions)))
    for kind in np.unique(kinds):
        rows = np.flatnonzero(kinds == kind)
        some = geoms[rows]
        centers, frames = pose.geom_xpos[some], pose.geom_xmat[some].reshape(-1, 3, 3)
        if kind == MESH:
            for row, geom, center, frame in zip(rows, some, centers, frames, strict=True):
                hull = hull_vertices(model, int(model.geom_dataid[geom]))
                out[row] = directions @ center + (directions @ frame @ hull.T).max(axis=1)
        elif kind != PLANE:
            out[rows] = supports(int(kind), model.geom_size[some], centers, frames, directions)
    return out


def hull_vertices(model: MjModel, mesh: int) -> Array:
    """Corners of a mesh's convex hull, all its vertices if MuJoCo keeps no hull of it; ``(n, 3)``."""
    start, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
    vertices = np.asarray(model.mesh_vert[start : start + count], dtype=float)
    graph = int(model.mesh_graphadr[mesh])
    if graph < 0:
        return vertices
    corners = int(model.mesh_graph[graph])  # their number, that of faces, an address each, then themselves
    return vertices[model.mesh_graph[graph + 2 + corners : graph + 2 + 2 * corners]]
