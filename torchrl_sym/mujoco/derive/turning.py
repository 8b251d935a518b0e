"""How a tree that nothing holds may be turned, so that the group acts on it.

Where a free base or an object stands is a state, and so is which way it looks. It is tried as the pose has
it, then with its heading removed, then as in qpos0. An object, a single rigid body that nothing drives, may
also lie in any way: upright, and with its principal axes along the world's. A robot may not: laid on its
side, or turned by a quarter, it would be found symmetric front to back. Its heading is searched among
those where pairs of its links are mirrored, at most an eighth of a turn away from that of its frame.

There is one turn for all elements of a group: only then is V = X^T R X a representation.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from torchrl_sym.mujoco.derive.pairing import Pairing
from torchrl_sym.mujoco.derive.parts import Parts
from torchrl_sym.mujoco.model.releases import weld_ids
from torchrl_sym.mujoco.model.rotations import rotation
from torchrl_sym.mujoco.model.shapes import DIRECTIONS, PLANE, geom_supports
from torchrl_sym.mujoco.model.types import Array, mj

_FAR = 1e3  # misfit (in tolerances) where links have no image nearby
_MOST = 24  # headings that are tried at most
_NEAR = 0.1  # of a tree's size: farther from every other link, a link's image is no link
_QUARTER = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])  # renames the axes


class Turning:
    """Tries turns of the loose trees of a model at one pose.

    Args:
        parts: the model at a pose.
        matrices: the group's elements, ``(n, 3, 3)``.
        generators: elements that are tried.
        tolerance: of the pairs of joints.
    """

    def __init__(self, parts: Parts, matrices: Array, generators: list[int], tolerance: float) -> None:
        self.parts, self.model, self.matrices, self.tolerance = parts, parts.model, matrices, tolerance
        self.generators = generators
        # trees whose first joints have images in some turn: then it is the pose, if others have none
        self.held: set[int] = set()
        # support functions of trees, by what the directions are turned by: many pairs ask for the same
        self._hulls: dict[tuple[int, bytes], Array] = {}

    def usual(self, tree: int) -> list[tuple[str, Array]]:
        """Turns that are tried first, in words and as matrices: the same for all trees."""
        frame = self.parts.data.xmat[tree].reshape(3, 3)
        start = rotation(self.model.body_quat[tree])
        return [
            ("as it is", np.eye(3)),
            ("heading removed", _heading(frame).T),
            ("as in qpos0", start @ frame.T),
            ("as in qpos0, heading removed", _heading(start).T @ start @ frame.T),
        ]

    def more(self, tree: int) -> Iterator[tuple[str, Array]]:
        """Turns for which a tree's shape has to be looked at."""
        frame = self.parts.data.xmat[tree].reshape(3, 3)
        if self.is_object(tree):
            yield "upright", frame.T
            moments, axes = np.linalg.eigh(self.parts.inertias[tree])
            axes[:, 0] *= np.linalg.det(axes)
            if np.ptp(moments) > 1e-6 * moments.max():
                for k in range(3):
                    yield "principal axes along the world's", np.linalg.matrix_power(_QUARTER, k) @ axes.T
        else:
            for name, base in self.usual(tree)[1:4:2]:
                for angle in self._headings(tree, base):
                    yield f"{name}, turned by {np.degrees(angle):.3g} degrees", _turn(angle) @ base

    def is_object(self, tree: int) -> bool:
        """Whether a tree is a single rigid body that nothing drives, beside others that move."""
        model, bodies = self.model, self.parts.links[tree].bodies
        driven = {
            int(model.site_bodyid[model.actuator_trnid[a, 0]])
            if model.actuator_trntype[a] == int(mj.mjtTrn.mjTRN_SITE)
            else int(model.jnt_bodyid[model.actuator_trnid[a, 0]])
            for a in range(model.nu)
            if model.actuator_trntype[a] in (int(mj.mjtTrn.mjTRN_SITE), int(mj.mjtTrn.mjTRN_JOINT))
        }
        alone = len(self.parts.links) == 2
        return self.is_rigid(tree) and not alone and not driven & set(bodies)

    def is_rigid(self, tree: int) -> bool:
        """Whether nothing moves on the first link of a tree."""
        return not self.parts.links[tree].children

    def misfit(self, a: int, b: int, turns: tuple[Array, Array], elements: Sequence[int]) -> float:
        """How far tree b, turned, is from the images of tree a, turned, in tolerances."""
        worst = 0.0
        for g in elements:
            matrix = turns[1].T @ self.matrices[g] @ turns[0]
            worst = max(worst, self._misfit(a, b, matrix, self.matrices[g]))
            if not np.isfinite(worst):
                break
        return worst

    def _misfit(self, a: int, b: int, matrix: Array, acting: Array) -> float:
        if self.is_rigid(a) and self.is_rigid(b):
            return self._rigid(a, b, matrix)
        pairing = Pairing(self.parts, matrix, acting)
        if not pairing.holds(a, b, self.tolerance):
            return np.inf
        self.held.add(a)
        if not self._near(a, b, matrix):
            return _FAR
        return pairing.worst(pairing.images(a, b), self.tolerance).size

    def _near(self, a: int, b: int, matrix: Array) -> bool:
        """Whether each link's image has a link nearby: quickly said, and of most turns it is not so."""
        mine = self.parts.centers[[x for x in self.parts.tree(a) if self.parts.links[x].mass > 0]]
        theirs = self.parts.centers[self.parts.tree(b)]
        apart = np.linalg.norm((mine @ matrix.T)[:, None] - theirs, axis=-1)
        limit = max(_NEAR, 10 * self.tolerance) * self.parts.sizes[b]
        return bool((apart.min(axis=1, initial=np.inf) <= limit).all())

    def _rigid(self, a: int, b: int, matrix: Array) -> float:
        """Inertia, centre of mass and hull of two rigid bodies."""
        one, other = self.parts.links[a], self.parts.links[b]
        size = self.parts.sizes[b]
        gaps = [float(np.linalg.norm(matrix @ self.parts.centers[a] - self.parts.centers[b])) / size]
        gaps.append(abs(one.mass - other.mass) / max(one.mass, other.mass, 1e-12))
        inertia = matrix @ self.parts.inertias[a] @ matrix.T - self.parts.inertias[b]
        gaps.append(float(np.abs(inertia).max()) / max(float(np.trace(self.parts.inertias[b])), 1e-12))
        gaps.append(float(np.abs(self._hull(a, matrix) - self._hull(b, np.eye(3))).max()) / size)
        return max(gaps) / max(self.tolerance, 1e-12)

    def _hull(self, tree: int, matrix: Array) -> Array:
        """Support function of the image of a tree's first link: of what may collide on it, else of all."""
        key = tree, matrix.tobytes()
        if key not in self._hulls:
            self._hulls[key] = self._support(tree, DIRECTIONS @ matrix)
        return self._hulls[key]

    def _support(self, tree: int, directions: Array) -> Array:
        model = self.model
        geoms = np.flatnonzero((weld_ids(model)[model.geom_bodyid] == tree) & (model.geom_type != PLANE))
        touching = geoms[(model.geom_contype[geoms] != 0) | (model.geom_conaffinity[geoms] != 0)]
        geoms = touching if len(touching) else geoms
        if not len(geoms):
            return np.zeros(len(directions))
        reach = geom_supports(model, self.parts.data, geoms, directions).max(axis=0)
        return reach - directions @ self.parts.points[tree]

    def _headings(self, tree: int, base: Array) -> list[float]:
        """Angles by which a robot may be turned so that some pair of its links is mirrored, least first."""
        mirrors = [m for m in self.matrices if np.linalg.det(m) < 0]
        if not mirrors:
            return []
        normal = np.linalg.eigh(mirrors[0])[1][:, 0]  # of the eigenvalue -1
        aim = float(np.arctan2(normal[1], normal[0]))
        links = [self.parts.links[b] for b in self.parts.tree(tree) if self.parts.links[b].mass > 0]
        points = np.array([base @ self.parts.centers[link.body] for link in links]).reshape(-1, 3)
        masses = np.array([link.mass for link in links])
        first, second = np.triu_indices(len(links), 1)
        like = np.abs(masses[first] - masses[second]) < 0.1 * masses[first]
        along = (points[first] - points[second])[like]
        level = np.linalg.norm(along[:, :2], axis=1) > 0.02 * self.parts.sizes[tree]
        across = aim - np.arctan2(along[level, 1], along[level, 0])
        in_plane = points[np.linalg.norm(points[:, :2], axis=1) > 0.02 * self.parts.sizes[tree]]
        beside = aim + np.pi / 2 - np.arctan2(in_plane[:, 1], in_plane[:, 0])
        angles = (
            np.concatenate([across, beside]) + np.pi / 2
        ) % np.pi - np.pi / 2  # a plane has two normals
        angles = angles[(np.abs(angles) < np.pi / 4 - 1e-3) & (np.abs(angles) > 1e-9)]
        found: list[float] = []
        for angle in angles[np.argsort(np.abs(angles), kind="stable")]:
            if not any(abs(angle - other) < 1e-6 for other in found):
                found.append(float(angle))
        return found[:_MOST]


def _heading(frame: Array) -> Array:
    """Turn about the vertical that a frame whose z axis is nearly upright has."""
    return _turn(float(np.arctan2(frame[1, 0], frame[0, 0]))) if frame[2, 2] > 0.7 else np.eye(3)


def _turn(angle: float) -> Array:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
