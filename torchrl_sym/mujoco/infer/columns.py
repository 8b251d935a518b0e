"""Columns that agree up to a sign: which entries are equal, and which entry is the image of which.

A column holds one entry over all samples. Comparing every column with every other costs d^2 columns; so
each is compared by one number first, its product with a random vector, and only those whose numbers agree
are compared whole.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from torchrl_sym.mujoco.model.types import Array

Flags = NDArray[np.bool_]
TINY = 1e-9  # no more than rounding: an entry that is never larger is zero


@dataclass(frozen=True)
class Match:
    """A column that agrees with another, up to a sign: how far off, which, and the sign."""

    off: float
    index: int
    sign: float


def matches(columns: Array, wanted: Array, margin: Array) -> list[list[Match]]:
    """For each wanted column, those that agree with it: ``|wanted - sign * column| <= margin``; best first.

    Args:
        columns: ``(samples, d)``.
        wanted: ``(samples, k)``.
        margin: largest difference for each wanted column, ``(k,)``.
    """
    random = np.random.default_rng(0).uniform(0.5, 1.5, len(columns))
    number, target = random @ columns, random @ wanted
    order = np.argsort(number)
    reach = margin * random.sum() + 1e-12 * (np.abs(target) + np.abs(number).max(initial=0.0))
    found: list[list[Match]] = []
    for i, column in enumerate(wanted.T):
        near = []
        for sign in (1.0, -1.0):
            ends = sign * target[i] - reach[i], sign * target[i] + reach[i]
            low, high = np.searchsorted(number[order], ends)
            candidates = order[low:high]
            off = np.abs(column[:, None] - sign * columns[:, candidates]).max(axis=0, initial=0.0)
            hits = zip(off[off <= margin[i]], candidates[off <= margin[i]], strict=True)
            near += [Match(float(gap), int(j), sign) for gap, j in hits]
        found.append(sorted(near, key=lambda match: (match.off, match.index)))
    return found


@dataclass
class Classes:
    """Entries that always agree up to a sign, sorted into classes.

    Attributes:
        members: entries of each class, in order; the first represents it.
        sign: of each entry relative to the first of its class, ``(d,)``.
        constant: entries that never change, ``(d,)``; in no class.
    """

    members: list[list[int]]
    sign: Array
    constant: Flags


def classes_of(data: Array, rounding: Array) -> Classes:
    """Sort the columns of ``(samples, d)`` into classes; differences up to ``rounding`` count as none."""
    middle = (data.max(axis=0) + data.min(axis=0)) / 2
    constant = np.abs(data - middle).max(axis=0) <= np.maximum(rounding, TINY) / 2
    moving = np.flatnonzero(~constant)
    members, sign = [], np.ones(data.shape[1])
    done: set[int] = set()
    agree = matches(data[:, moving], data[:, moving], rounding[moving])
    for i, found in zip(moving.tolist(), agree, strict=True):
        if i in done:
            continue
        same = {int(moving[match.index]): match.sign for match in found} | {i: 1.0}
        members.append(sorted(j for j in same if j not in done))
        for j in members[-1]:
            sign[j] = same[j]
        done |= set(members[-1])
    return Classes(members, sign, constant)
