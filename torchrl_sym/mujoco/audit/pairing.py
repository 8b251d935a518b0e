"""Pairs vectors of one set with the nearest ones of another, each at most once.

Few vectors are paired at best by an assignment; of many, as a terrain has them, each is first offered those
that lie nearest to its image, so that time does not grow with the square of their number.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial import KDTree

from torchrl_sym.mujoco.model.shapes import DIRECTIONS
from torchrl_sym.mujoco.model.types import Array

_FEW = 64 * 64  # entries of a table of costs that takes a millisecond
_NEAREST = 4  # candidates offered at a time
_STAYS = 1e-9  # what is in one place is told apart by staying what it is, and by its order
_ORDER = 1e-13
_UNLIKE = 1e-8  # what touches otherwise, in the same place

Numbers = NDArray[np.intp]


def pair(
    mine: Array,
    theirs: Array,
    my_ids: Numbers,
    their_ids: Numbers,
    labels: tuple[Numbers, Numbers] | None = None,
) -> tuple[Numbers, Numbers]:
    """Rows of two sets of support functions that belong together.

    Args:
        mine: support functions at the directions of :mod:`~torchrl_sym.mujoco.model.shapes`, ``(n, d)``.
        theirs: those they are to be paired with, ``(m, d)``.
        my_ids: what they are; of equal costs, the pair of equal numbers is taken.
        their_ids: likewise for the others.
        labels: of both; of what lies in one place, like labels are paired.

    Returns:
        Rows of ``mine`` and of ``theirs``, ``min(n, m)`` each.
    """
    rows, columns = np.arange(len(mine)), np.arange(len(theirs))
    pairs: list[tuple[int, int]] = []
    while len(rows) * len(columns) > _FEW:
        found = _offer(mine[rows], theirs[columns], my_ids[rows], their_ids[columns])
        pairs += [(int(rows[r]), int(columns[c])) for r, c in found]
        rows, columns = (np.delete(x, [p[k] for p in found]) for k, x in enumerate((rows, columns)))

    if len(rows) and len(columns):
        cost = np.abs(mine[rows][:, None] - theirs[columns]).max(axis=-1)
        cost += _STAYS * (my_ids[rows][:, None] != their_ids[columns])
        cost += _ORDER * np.abs(rows[:, None] - columns)
        if labels is not None:
            cost += _UNLIKE * (labels[0][rows][:, None] != labels[1][columns])
        best = linear_sum_assignment(cost)
        pairs += list(zip(rows[best[0]].tolist(), columns[best[1]].tolist(), strict=True))
    out = np.array(sorted(pairs), dtype=np.intp).reshape(-1, 2)
    return out[:, 0], out[:, 1]


def _offer(mine: Array, theirs: Array, my_ids: Numbers, their_ids: Numbers) -> list[tuple[int, int]]:
    """Pairs in the order of their costs, among the nearest of each."""
    count = min(_NEAREST, len(theirs))
    # the mean of d h(d) is a point of the shape: it moves by at most what the support function does
    tree = KDTree(theirs @ DIRECTIONS)
    near = tree.query(mine @ DIRECTIONS, k=count)[1].reshape(len(mine), count)
    cost = np.stack([np.abs(mine - theirs[near[:, k]]).max(axis=1) for k in range(count)], axis=1)
    cost += _STAYS * (my_ids[:, None] != their_ids[near])
    used_rows, used_columns, pairs = set(), set(), []
    for k in np.argsort(cost, axis=None, kind="stable"):
        r, c = int(k) // count, int(near.flat[k])
        if r not in used_rows and c not in used_columns:
            used_rows.add(r)
            used_columns.add(c)
            pairs.append((r, c))
    return pairs
