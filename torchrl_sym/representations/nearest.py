"""The nearest of many points, for each of many places, without comparing all of them with all.

Points are sorted by the cell of a grid that they lie in. If a cell's edge is twice the distance at which a
point counts as found, then whatever is near a place lies in one of the 2^d cells that the corners of a
small box around the place lie in.
"""

from __future__ import annotations

import itertools

import torch
from torch import Tensor

_CLOSE = 1e-6  # metres: where most are found; wide cells, which many points share, are for the rest
_FINEST = 1e-12  # metres: the edge of the cells where the tolerance is 0
_MIXERS = (73856093, 19349663, 83492791)  # primes that turn three cell numbers into one
_CELLS = 2**40  # per axis, after which the numbers start again


def nearest(places: Tensor, points: Tensor, tolerance: float) -> Tensor:
    """Which point is nearest to each place, -1 where none is within the tolerance.

    Args:
        places: ``(M, d)`` with d = 2 or 3.
        points: ``(P, d)``.
        tolerance: the largest distance.

    Returns:
        Indices of points, ``(M,)`` int64.
    """
    reach = min(tolerance, _CLOSE)
    found = _within(places, points, reach)
    while reach < tolerance and (found < 0).any():
        reach = min(8 * reach, tolerance)
        lost = (found < 0).nonzero()[:, 0]
        found[lost] = _within(places[lost], points, reach)
    return found


def _within(places: Tensor, points: Tensor, tolerance: float) -> Tensor:
    edge = max(2 * tolerance, _FINEST)
    cells, order = _cells(points, edge).sort(stable=True)
    best = torch.full((len(places),), torch.inf, dtype=torch.float64, device="cpu")
    found = torch.full((len(places),), -1, device="cpu")
    for corner in itertools.product((-edge / 2, edge / 2), repeat=places.shape[1]):
        near = places + torch.tensor(corner, dtype=torch.float64, device="cpu")
        cell = _cells(near, edge)
        start, end = (torch.searchsorted(cells, cell, right=right) for right in (False, True))
        while (start < end).any():  # another point of every cell
            left = (start < end).nonzero()[:, 0]
            candidate = order[start[left]]
            distance = (places[left] - points[candidate]).norm(dim=-1)
            closer = (distance < best[left]) & (distance <= tolerance)
            best[left[closer]], found[left[closer]] = distance[closer], candidate[closer]
            start = start + 1
    return found


def _cells(points: Tensor, edge: float) -> Tensor:
    """One number for the cell of each point; cells that share one cost a comparison, no more."""
    numbers = torch.remainder((points / edge).floor(), _CELLS).long()
    mixers = torch.tensor(_MIXERS[: points.shape[1]], device="cpu")
    return (numbers * mixers).sum(-1)  # overflows, which is a remainder
