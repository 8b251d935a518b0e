"""The joints of one body: which goes to which, which mix, and whether they act in the same order.

Several joints of a body act one after another, each in the frame that those before it have turned. Two
slides commute; a hinge commutes with a slide along its axis, and with a hinge on its line. Others do not:
turning about x and then y is another motion than about y and then x, though at the reference pose every
axis is where it should be. So an image must keep the order of all joints that do not commute.

Since slides commute, only the space that they span matters. If R sends the axes A (as columns, orthonormal)
of a body's slides into the space of those of its image, A', then

    sum_i q_i R a_i = sum_j q'_j a'_j    for    q' = A'^T R A q,

which is a signed permutation if axes go to axes, and mixes the slides of a planar base under 120 degrees.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from torchrl_sym.mujoco.derive.parts import Parts
from torchrl_sym.mujoco.model.types import BALL, HINGE, SLIDE, Array

_RANK = 1e-3  # what another place in the order costs: joints in one place go to each other in order
_ALIGNED = 1e-6  # 1 - cos below which axes of slides are parallel: numbers are written with six digits
_SQUARE = 1e-5  # largest cosine between slides that are at right angles


@dataclass(frozen=True)
class JointPairs:
    """Images of the joints of one body.

    Attributes:
        images: the image of each.
        costs: how far off each is; of slides that mix, the space that they span.
        order: 0 if they act in the same order, or commute; 1 if two that are at right angles do not.
        mixes: whether slides mix, as no axis goes to an axis.
    """

    images: dict[int, int]
    costs: dict[int, float]
    order: float = 0.0
    mixes: bool = False


def pair_joints(
    parts: Parts, matrix: Array, mine: Sequence[int], theirs: Sequence[int], cost: Array
) -> JointPairs:
    """Images of joints ``mine`` of a body among those of its image, ``theirs``, by the cost of pairs."""
    columns = linear_sum_assignment(cost + _places(len(mine)))[1].tolist()
    images = {i: theirs[c] for i, c in zip(mine, columns, strict=True)}
    costs = {i: float(cost[r, c]) for r, (i, c) in enumerate(zip(mine, columns, strict=True))}

    weights = {(i, j): 1.0 for i, j in images.items()}
    slides, others = (_slides(parts, joints) for joints in (mine, theirs))
    mixes = False
    worst = max((costs[i] for i in slides), default=0.0)
    if len(slides) == len(others) > 1 and worst > _ALIGNED:
        mixing = parts.axes[others] @ matrix @ parts.axes[slides].T
        span = 1 - float(np.linalg.svd(mixing, compute_uv=False)[-1])  # 1 - cos of the largest angle
        mixes = _square(parts, slides) and _square(parts, others) and span < worst
        if mixes:
            costs |= dict.fromkeys(slides, max(span, 0.0))
            weights = {pair: w for pair, w in weights.items() if pair[0] not in slides}
            weights |= {
                (i, j): float(mixing[y, x]) for x, i in enumerate(slides) for y, j in enumerate(others)
            }
    in_order = not mixes and columns == sorted(columns)
    return JointPairs(images, costs, 0.0 if in_order else _order_gap(parts, mine, theirs, weights), mixes)


@functools.cache  # bodies have a few joints
def _places(count: int) -> Array:
    """What it costs to go to another place in the order."""
    return _RANK * np.abs(np.subtract.outer(np.arange(count), np.arange(count)))


def _slides(parts: Parts, joints: Sequence[int]) -> list[int]:
    return [j for j in joints if parts.skeleton.kinds[j] == SLIDE]


def _square(parts: Parts, slides: list[int]) -> bool:
    axes = parts.axes[slides]
    return bool(np.abs(axes @ axes.T - np.eye(len(slides))).max() < _SQUARE)


def _order_gap(
    parts: Parts, mine: Sequence[int], theirs: Sequence[int], weights: dict[tuple[int, int], float]
) -> float:
    """How much it matters that images act in another order: 0 to 1."""
    worst = 0.0
    rank = {j: r for r, j in enumerate(theirs)}
    images = {
        i: [(j, abs(w)) for (k, j), w in weights.items() if k == i and abs(w) > _ALIGNED] for i in mine
    }
    for first, i in enumerate(mine):
        for k in mine[first + 1 :]:
            for j, weight in images[i]:
                for m, other in images[k]:
                    if rank[j] > rank[m]:
                        gap = max(_commutator(parts, i, k), _commutator(parts, j, m))
                        worst = max(worst, gap * weight * other)
    return worst


def _commutator(parts: Parts, i: int, j: int) -> float:
    """How far two joints of one body are from commuting: 0 to 1."""
    kinds = {parts.skeleton.kinds[i], parts.skeleton.kinds[j]}
    if kinds == {SLIDE}:
        return 0.0
    if BALL in kinds:
        return 1.0
    (x, y, z), (u, v, w) = parts.axes[[i, j]].tolist()
    turn = math.hypot(y * w - z * v, z * u - x * w, x * v - y * u)
    if kinds == {HINGE}:
        a, b, c = (parts.anchors[j] - parts.anchors[i]).tolist()
        along = a * x + b * y + c * z
        gap = math.hypot(a - along * x, b - along * y, c - along * z)
        turn = max(turn, gap / parts.size(int(parts.model.jnt_bodyid[i])))
    return min(turn, 1.0)


def mixing_axes(
    parts: Parts, actions: Sequence[tuple[Array, dict[int, int], dict[int, JointPairs]]]
) -> dict[int, Array]:
    """Orthonormal axes ``(3, k)`` of the slides of each link whose slides some element mixes.

    The spaces that slides span are averaged over the group, so that the maps compose exactly also where a
    model is symmetric only nearly.

    Args:
        parts: the model at the reference pose.
        actions: R, the images of links and those of the joints of each link, for every element.
    """
    mixing = {a for _, _, joints in actions for a, pairs in joints.items() if pairs.mixes}
    mixing |= {images[a] for a in mixing for _, images, _ in actions}
    axes = {a: parts.axes[_slides(parts, parts.links[a].joints)].T for a in sorted(mixing)}
    sums = {a: np.zeros((3, 3)) for a in axes}
    for matrix, images, _ in actions:
        for a in axes:
            turned = matrix @ axes[a]
            sums[images[a]] += turned @ turned.T

    for a, projection in sums.items():
        space = np.linalg.eigh(projection)[1][:, -axes[a].shape[1] :]
        left, _, right = np.linalg.svd(space @ space.T @ axes[a], full_matrices=False)
        axes[a] = left @ right
    return axes
