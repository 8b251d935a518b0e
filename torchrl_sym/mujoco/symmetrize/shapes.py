"""Averages of sites and of primitive geoms."""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment

from torchrl_sym.mujoco.model.releases import weld_ids
from torchrl_sym.mujoco.model.types import Array, mj, name_of
from torchrl_sym.mujoco.symmetrize.averager import Averager
from torchrl_sym.mujoco.symmetrize.parameters import average_unsigned

_GEOM = mj.mjtGeom
_ROUND = (int(_GEOM.mjGEOM_CAPSULE), int(_GEOM.mjGEOM_CYLINDER))
_SPHERE, PLANE = int(_GEOM.mjGEOM_SPHERE), int(_GEOM.mjGEOM_PLANE)
_SQUARE = (int(_GEOM.mjGEOM_BOX), int(_GEOM.mjGEOM_ELLIPSOID))
PRIMITIVE = (_SPHERE, *_ROUND, *_SQUARE)
_SAME = ("type", "contype", "conaffinity", "condim")
_GEOM_FIELDS = ("friction", "solref", "solimp", "solmix", "margin", "gap")


def average_sites(averager: Averager) -> None:
    """Places of sites."""
    model = averager.model
    maps = averager.closed([action.sites for action in averager.actions], "site")
    owner = weld_ids(model)[model.site_bodyid]
    for b, place in averager.points(maps, averager.data.site_xpos, lambda s: int(owner[s])).items():
        local = averager.in_body(int(model.site_bodyid[b]), place)
        name = name_of(model, "site", b)
        averager.local(averager.spec.sites[b], local, model.site_pos[b], "site position", name)


def average_geoms(averager: Averager) -> None:
    """Places, sizes and contact parameters of primitive geoms."""
    model, geoms = averager.model, _Geoms(averager)
    maps = averager.closed([geoms.match(g) for g in range(len(averager.turns))], "geom")
    average_unsigned(
        averager, maps, "geom", {name: getattr(model, f"geom_{name}") for name in _GEOM_FIELDS}
    )
    maps = [{a: b for a, b in m.items() if int(model.geom_type[a]) in PRIMITIVE} for m in maps]
    places = averager.points(maps, geoms.centers, lambda a: geoms.links[a])
    turns = averager.mean(maps, lambda g, a: geoms.alignment(g, a, maps[g][a])[0])
    sizes = averager.mean(maps, lambda g, a: geoms.alignment(g, a, maps[g][a])[1])
    for b, place in places.items():
        geom, name, body = averager.spec.geoms[b], name_of(model, "geom", b), int(model.geom_bodyid[b])
        if geom.meshname:
            averager.report.left.append(f"geom {name!r} is fitted to a mesh")
            continue
        averager.write(None, "", sizes[b], model.geom_size[b], "geom size", name, averager.extent)
        left, _, right = np.linalg.svd(turns[b])
        turn = left @ right
        if int(model.geom_type[b]) in _ROUND:
            z = turns[b][:, 2] / np.linalg.norm(turns[b][:, 2])
            turn = _rotate(geoms.frames[b][:, 2], z) @ geoms.frames[b]
        turn = averager.rotation[body].T @ turn
        averager.settle(geom, "geom")
        geom.fromto, geom.size = [np.nan] * 6, sizes[b].tolist()
        averager.pose(geom, averager.in_body(body, place), turn, "geom", name)


class _Geoms:
    """Finds the image of every geom at its link's new place.

    Geoms go along with their links, which have moved to symmetric places in their trees by now.
    """

    def __init__(self, averager: Averager) -> None:
        self.averager, self.model, self.turns = averager, averager.model, averager.turns
        self.owner = weld_ids(self.model)[self.model.geom_bodyid]
        self.links = [int(b) for b in self.owner]
        moved = np.array([averager.moved[b] for b in self.links]).reshape(-1, 3)
        self.centers = averager.data.geom_xpos + moved
        self.offsets = self.centers - np.array([averager.origin[b] for b in self.links]).reshape(-1, 3)
        self.frames = averager.data.geom_xmat.reshape(-1, 3, 3)

    def match(self, g: int) -> dict[int, int]:
        """Image of every geom whose shape is where the element sends it, within tolerance."""
        images = {}
        for a, b in self.averager.bodies[g].items():
            mine, theirs = np.flatnonzero(self.owner == a), np.flatnonzero(self.owner == b)
            cost = np.array([[self.misfit(g, int(i), int(j)) for j in theirs] for i in mine])
            cost = cost.reshape(len(mine), len(theirs))
            for r, c in zip(*linear_sum_assignment(cost + 1e-9 * (mine[:, None] != theirs)), strict=True):
                if cost[r, c] <= self.averager.tolerance:
                    images[int(mine[r])] = int(theirs[c])
        return images

    def misfit(self, g: int, a: int, b: int) -> float:
        """Distance of geom a's image from geom b relative to the extent; large if they do not fit."""
        model = self.model
        same = all(getattr(model, f"geom_{n}")[a] == getattr(model, f"geom_{n}")[b] for n in _SAME)
        offset = self.turns[g] @ self.offsets[a] - self.offsets[b]
        if int(model.geom_type[a]) == PLANE:
            offset = offset @ self.frames[b][:, 2]
        if not same or int(model.geom_type[a]) not in PRIMITIVE:
            return float(np.linalg.norm(offset)) / self.averager.extent if same else 1e3
        frame, size = self.alignment(g, a, b)
        reach = np.abs(frame - self.frames[b])[:, 2 * (model.geom_type[a] in _ROUND) :].max() * size.max()
        growth = float(np.abs(size - model.geom_size[b]).max())
        return max(float(np.linalg.norm(offset)), float(reach), growth) / self.averager.extent

    def alignment(self, g: int, a: int, b: int) -> tuple[Array, Array]:
        """Image of a's frame, its axes renamed and turned round to be near those of b; sizes likewise."""
        kind, size, frame = int(self.model.geom_type[b]), self.model.geom_size[a], self.frames[b]
        if kind == _SPHERE:
            return frame, size
        turned = self.turns[g] @ self.frames[a]
        relative = turned.T @ frame
        if kind in _ROUND:
            return turned * np.sign(relative[2, 2]), size
        rename = np.round(relative)
        if not np.allclose(rename @ rename.T, np.eye(3)):
            return np.full((3, 3), 1e3), size
        return turned @ rename, np.abs(rename).T @ size


def _rotate(start: Array, end: Array) -> Array:
    """Smallest rotation that carries one unit vector to another, less than a half turn away."""
    x, y, z = np.cross(start, end)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + cross + cross @ cross / (1 + start @ end)
