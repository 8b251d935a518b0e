"""How far pairs of links and of joints are from being images of each other, many pairs at once.

Matching compares thousands of pairs, of which each takes a few numbers: numpy needs as long for one pair as
for a hundred.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from torchrl_sym.mujoco.derive.parts import Parts
from torchrl_sym.mujoco.model.types import BALL, FREE, HINGE, SLIDE, Array

Pairs = Sequence[tuple[int, int]]


class Gaps:
    """Compares images of parts under one isometry with other parts; about the points of their trees.

    Args:
        parts: the model at a pose.
        matrix: the isometry R, ``(3, 3)``.
    """

    def __init__(self, parts: Parts, matrix: Array) -> None:
        self.parts, self.matrix, self.kinds = parts, matrix, parts.model.jnt_type
        self.det = round(float(np.linalg.det(matrix)))
        self.centers = parts.centers @ matrix.T
        self.inertias = matrix @ parts.inertias @ matrix.T
        self.axes, self.anchors = parts.axes @ matrix.T, parts.anchors @ matrix.T

    def of_centers(self, pairs: Pairs) -> Array:
        """Distance (m) of the centre of mass of each link's image from that of another; 0 without mass."""
        one, other = columns(pairs)
        masses = self.parts.skeleton.masses
        apart = self.centers[one] - self.parts.centers[other]
        return np.sqrt((apart * apart).sum(axis=1)) * (np.minimum(masses[one], masses[other]) > 0)

    def of_links(self, pairs: Pairs) -> Array:
        """How unlike links are in the place, size and spread of their masses, relative to what moves."""
        one, other = columns(pairs)
        parts, masses = self.parts, self.parts.skeleton.masses
        heavier = np.abs(masses[one] - masses[other]) / parts.skeleton.total_mass
        inertia = np.abs(self.inertias[one] - parts.inertias[other]).max(axis=(1, 2))
        apart = self.of_centers(pairs) / parts.link_sizes[other]
        return apart + heavier + inertia / parts.total_inertia

    def of_joints(self, pairs: Pairs) -> tuple[Array, Array]:
        """Angles (rad) between axes and distances (m) between anchors; infinite for other types."""
        i, j = columns(pairs)
        image, axis, kind = self.axes[i], self.parts.axes[j], self.kinds[i]
        offset = self.anchors[i] - self.parts.anchors[j]
        (x, y, z), (u, v, w) = image.T, axis.T
        sine = np.sqrt((y * w - z * v) ** 2 + (z * u - x * w) ** 2 + (x * v - y * u) ** 2)
        turn = np.arctan2(sine, np.abs((image * axis).sum(axis=1)))
        # a hinge's anchor may be anywhere on its axis, and that of a slide does not matter
        offset = offset - (kind == HINGE)[:, None] * (offset * axis).sum(axis=1, keepdims=True) * axis
        away = np.sqrt((offset * offset).sum(axis=1))

        turn[(kind == BALL) | (kind == FREE)] = 0.0
        away[(kind == SLIDE) | (kind == FREE)] = 0.0
        other = kind != self.kinds[j]
        turn[other] = away[other] = np.inf
        return turn, away

    def signs(self, pairs: Pairs) -> Array:
        """Signs between the coordinates of hinges and slides that are images of each other."""
        i, j = columns(pairs)
        along = (self.axes[i] * self.parts.axes[j]).sum(axis=1)
        return np.where(np.where(self.kinds[i] == HINGE, self.det, 1.0) * along > 0, 1.0, -1.0)

    def joint_costs(self, pairs: Pairs, misfit: float) -> Array:
        """1 - cos of the angle between the axes, plus the distance of the anchors relative to their tree.

        Args:
            pairs: of joints.
            misfit: what a joint of another type costs.
        """
        turn, away = self.of_joints(pairs)
        sizes = self.parts.link_sizes[self.parts.skeleton.joint_links[columns(pairs)[1]]]
        fits = np.isfinite(turn)
        return np.where(fits, 1 - np.cos(np.where(fits, turn, 0.0)) + away / sizes, misfit)


def columns(pairs: Pairs) -> NDArray[np.intp]:
    """The first of every pair, and the second, ``(2, n)``."""
    return np.array(pairs, dtype=np.intp).reshape(-1, 2).T
