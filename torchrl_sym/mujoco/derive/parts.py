"""The parts of a model at one pose, each tree in coordinates about a point of its own.

A tree that nothing holds may stand anywhere, so that its place says nothing about symmetry: it is looked at
about the point that would come to stand on the axis, its frame's origin. Trees that are fixed to the world
are looked at about the axis itself.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np

from torchrl_sym.mujoco.model.links import Link, Skeleton
from torchrl_sym.mujoco.model.types import Array, MjData, MjModel

_NO_INERTIA = 1e-12  # kg m^2; what is taken for the inertia of what has none, to divide by


@dataclass
class Parts:
    """Links and joints of a model at one pose.

    Attributes:
        skeleton: how the links hang together.
        points: of every tree, the point (world) that its positions are relative to.
        anchors, axes: of joints, ``(njnt, 3)``.
        centers: centres of mass of links by body number, ``(nbody, 3)``; zero elsewhere.
        inertias: of links about their centres of mass, likewise, ``(nbody, 3, 3)``.
        sizes: of every tree.
        carried: bodies that are only carried along; they are their own images.
    """

    skeleton: Skeleton
    data: MjData
    points: dict[int, Array]
    anchors: Array
    axes: Array
    centers: Array
    inertias: Array
    sizes: dict[int, float]
    carried: frozenset[int]

    @classmethod
    def of(cls, skeleton: Skeleton, data: MjData, carried: frozenset[int]) -> Parts:
        """Read them off kinematics; loose trees about their frame's origin, others about the world's."""
        lumps, trees = skeleton.lumps(data), skeleton.links[0].children
        whole = cls(
            skeleton,
            data,
            dict.fromkeys(trees, np.zeros(3)),
            data.xanchor.copy(),
            data.xaxis.copy(),
            lumps.centers,
            lumps.inertias,
            skeleton.sizes(data),
            carried,
        )
        return whole.about({b: data.xpos[b].copy() for b in skeleton.loose})

    def about(self, points: dict[int, Array]) -> Parts:
        """The same with some trees about other points."""
        if not points:
            return self
        skeleton, shift = self.skeleton, np.zeros_like(self.centers)
        for tree, point in points.items():
            shift[tree] = point - self.points[tree]
        shift = shift[skeleton.tree]
        return replace(
            self,
            points={**self.points, **points},
            anchors=self.anchors - shift[skeleton.joint_links],
            centers=self.centers - shift,
        )

    @property
    def model(self) -> MjModel:
        return self.skeleton.model

    @property
    def links(self) -> dict[int, Link]:
        """The links by body number, the world first."""
        return self.skeleton.links

    @property
    def fixed(self) -> list[int]:
        """Trees that hang on the world."""
        return self.skeleton.fixed

    @property
    def loose(self) -> list[int]:
        """Trees that nothing holds, other than carried bodies."""
        return [b for b in self.skeleton.loose if b not in self.carried]

    @functools.cached_property
    def extent(self) -> float:
        """Size of the largest tree; of the scene if nothing moves."""
        return max(self.sizes.values(), default=max(float(self.model.stat.extent), 1e-6))

    @functools.cached_property
    def total_inertia(self) -> float:
        """The largest inertia of a link that moves."""
        traces = np.trace(self.inertias[1:], axis1=1, axis2=2)
        return max(float(traces.max(initial=0.0)), _NO_INERTIA)

    def tree(self, root: int) -> list[int]:
        """Links of a tree, the root first."""
        return [b for b, link in self.links.items() if b and link.tree == root]

    def size(self, link: int) -> float:
        """Size of the tree that a link is in."""
        return self.sizes[tree] if (tree := self.links[link].tree) in self.sizes else self.extent

    @functools.cached_property
    def link_sizes(self) -> Array:
        """Sizes of the trees that links are in, by body number; that of the largest elsewhere."""
        sizes = np.full(len(self.centers), self.extent)
        sizes[list(self.sizes)] = list(self.sizes.values())
        return sizes[self.skeleton.tree]
