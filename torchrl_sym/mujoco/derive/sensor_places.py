"""Objects that sensors are on, or look at: how far one is from the image of another.

Distances are relative to the size of the tree of moving links that an object is in.
"""

from __future__ import annotations

import functools

import numpy as np

from torchrl_sym.mujoco.derive.matching import Matcher
from torchrl_sym.mujoco.derive.sensor_rules import POSES
from torchrl_sym.mujoco.model.filters import active_geoms
from torchrl_sym.mujoco.model.releases import weld_ids
from torchrl_sym.mujoco.model.shapes import DIRECTIONS, supports
from torchrl_sym.mujoco.model.types import Array, MjData

MISFIT = 1e6  # of a pair that cannot be the image of each other
Object = tuple[str, int]  # type and number, as in mjtObj


class Places:
    """Compares objects with the images of others, under one element."""

    def __init__(self, matcher: Matcher) -> None:
        self.matcher, self.model, self.turn = matcher, matcher.model, matcher.matrix
        self.data, self.image = matcher.data, matcher.image

    def link(self, kind: str, index: int) -> int:
        """The link that an object is on."""
        owners = {"SITE": "site_bodyid", "GEOM": "geom_bodyid", "CAMERA": "cam_bodyid"}
        body = int(getattr(self.model, owners[kind])[index]) if kind in owners else index
        return int(weld_ids(self.model)[body])

    def gap(self, kind: str, a: int, b: int) -> float:
        """Distance of object b from the image of a, on its link."""
        other = self.link(kind, b)
        if self.matcher.images.get(self.link(kind, a)) != other:
            return MISFIT
        positions = (getattr(pose, POSES[kind][0]) for pose in (self.data, self.image))
        distance = float(np.linalg.norm(self.turn @ next(positions)[a] - next(positions)[b]))
        return distance / self.matcher.size(other)

    def body_gap(self, a: int, b: int) -> float:
        """The same for whole bodies: one that moves a link, or a part welded to it, by its mass centre."""
        welds = weld_ids(self.model)
        if int(welds[a]) == a or int(welds[b]) == b:
            return 0.0 if self.matcher.images.get(a) == b else MISFIT
        return self.gap("BODY", a, b)

    def volume_gap(self, a: int, b: int) -> float:
        """The same for the volumes of sites, by their support functions."""
        if self.gap("SITE", a, b) >= MISFIT:
            return MISFIT

        def reach(pose: MjData, site: int, directions: Array) -> Array:
            rotation, kind = pose.site_xmat[site].reshape(3, 3), int(self.model.site_type[site])
            size, place = self.model.site_size[[site]], pose.site_xpos[[site]]
            return supports(kind, size, place, rotation[None], directions)[0]

        away = reach(self.data, a, DIRECTIONS @ self.turn) - reach(self.image, b, DIRECTIONS)
        return float(np.abs(away).max()) / self.matcher.size(self.link("SITE", b))

    def geom_gap(self, a: int, b: int) -> float:
        """The same for geoms, of one type."""
        same = self.model.geom_type[a] == self.model.geom_type[b]
        return self.gap("GEOM", a, b) if same else MISFIT

    @functools.cached_property
    def _active(self) -> list[int]:
        return active_geoms(self.model).tolist()

    def geoms(self, body: int, subtree: bool = False) -> list[int]:
        """Geoms of a body, or of its subtree, that may collide."""
        owners, parents = self.model.geom_bodyid, self.model.body_parentid

        def inside(owner: int) -> bool:
            while subtree and owner > body:
                owner = int(parents[owner])
            return owner == body

        return [g for g in self._active if inside(int(owners[g]))]

    def frame(self, one: Object | None, other: Object | None) -> Array:
        """The matrix V between the frames of two objects; R itself for the world's."""
        if one is None or other is None:
            return self.turn
        start, end = self.rotations(one, other)
        return end.T @ self.turn @ start

    def rotations(self, one: Object, other: Object) -> tuple[Array, Array]:
        """Rotations of an object, and of its image where images are looked for."""
        start, end = getattr(self.data, POSES[one[0]][1]), getattr(self.image, POSES[other[0]][1])
        return start[one[1]].reshape(3, 3), end[other[1]].reshape(3, 3)
