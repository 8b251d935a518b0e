"""The parts of a model at one pose, each tree in coordinates about a point of its own.

A tree that nothing holds may stand anywhere, so that its place says nothing about symmetry: it is looked at
about the point that would come to stand on the axis, its frame's origin. Trees that are fixed to the world
are looked at about the axis itself.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from torchrl_sym.mujoco.model.links import Link, is_loose, links_of, sizes_of
from torchrl_sym.mujoco.model.releases import weld_ids
from torchrl_sym.mujoco.model.types import Array, MjData, MjModel


@dataclass
class Parts:
    """Links and joints of a model at one pose.

    Attributes:
        points: of every tree, the point (world) that its positions are relative to.
        anchors, axes: of joints, ``(njnt, 3)``.
        centers: centres of mass of links by body number, ``(nbody, 3)``; zero elsewhere.
        sizes: of every tree.
        carried: bodies that are only carried along; they are their own images.
    """

    model: MjModel
    data: MjData
    links: dict[int, Link]
    points: dict[int, Array]
    anchors: Array
    axes: Array
    centers: Array
    sizes: dict[int, float]
    carried: frozenset[int]

    @classmethod
    def of(cls, model: MjModel, data: MjData, carried: frozenset[int]) -> Parts:
        """Read them off kinematics; loose trees about their frame's origin, others about the world's."""
        links = links_of(model, data)
        trees = links[0].children
        points = {b: data.xpos[b].copy() if is_loose(model, b) else np.zeros(3) for b in trees}
        centers = np.zeros((model.nbody, 3))
        for body, link in links.items():
            centers[body] = link.com
        whole = cls(
            model,
            data,
            links,
            dict.fromkeys(trees, np.zeros(3)),
            data.xanchor.copy(),
            data.xaxis.copy(),
            centers,
            sizes_of(model, data, links),
            carried,
        )
        return whole.about(points)

    def about(self, points: dict[int, Array]) -> Parts:
        """The same with some trees about other points."""
        model, shift = self.model, np.zeros((self.model.nbody, 3))
        for body, link in self.links.items():
            if link.tree in points:
                shift[body] = points[link.tree] - self.points[link.tree]
        owners = weld_ids(model)[model.jnt_bodyid]
        return replace(
            self,
            points={**self.points, **points},
            anchors=self.anchors - shift[owners],
            centers=self.centers - shift,
        )

    @property
    def fixed(self) -> list[int]:
        """Trees that hang on the world."""
        return [b for b in self.links[0].children if not is_loose(self.model, b)]

    @property
    def loose(self) -> list[int]:
        """Trees that nothing holds, other than carried bodies."""
        return [b for b in self.links[0].children if b not in self.carried and is_loose(self.model, b)]

    @property
    def extent(self) -> float:
        """Size of the largest tree; of the scene if nothing moves."""
        return max(self.sizes.values(), default=max(float(self.model.stat.extent), 1e-6))

    def tree(self, root: int) -> list[int]:
        """Links of a tree, the root first."""
        return [b for b, link in self.links.items() if b and link.tree == root]

    def size(self, link: int) -> float:
        """Size of the tree that a link is in."""
        return self.sizes.get(self.links[link].tree, self.extent)
