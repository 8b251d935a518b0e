"""Solve images = data rho(g)^T for a representation rho.

Entries that always agree up to a sign are taken together: several signed permutations fit, and of all
choices the k-th of a class goes to the k-th of its image, which composes, and stays in place where it can.
Entries that never change stay. What no entry, up to a sign, is the image of is looked for among mixtures.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from torchrl_sym.groups import PointGroup
from torchrl_sym.mujoco.infer.columns import Classes, Flags, classes_of, matches
from torchrl_sym.mujoco.infer.mixing import least_squares, polished
from torchrl_sym.mujoco.model.types import Array

_ORTHOGONAL = 1e-4  # how far from orthogonal a fit may be, before it is made so


@dataclass
class Solution:
    """What was found for some entries.

    Attributes:
        matrices: ``(N, d, d)``; rows that were not found are zero.
        failed: entries without an image, ``(N, d)`` bool.
        reasons: why, where more is known than that nothing fits, by element and entry.
        constant: entries that never change, ``(d,)`` bool.
        twins: entries that always agree up to a sign, two or more.
        events: how many samples differ from the most common value, ``(d,)``.
        off: largest distance of each entry from its image, relative to the entry, ``(d,)``.
        surprised: entries whose image fits all samples but the ones held out, ``(N, d)`` bool.
    """

    matrices: Array
    failed: Flags
    reasons: dict[tuple[int, int], str] = field(default_factory=dict)
    constant: Flags = field(default_factory=lambda: np.zeros(0, dtype=bool))
    twins: list[list[int]] = field(default_factory=list)
    events: Array = field(default_factory=lambda: np.zeros(0, dtype=int))
    off: Array = field(default_factory=lambda: np.zeros(0))
    surprised: Flags = field(default_factory=lambda: np.zeros((0, 0), dtype=bool))

    @property
    def complete(self) -> bool:
        """Whether every entry has an image."""
        return not self.failed.any()


def solve(group: PointGroup, samples: Array, margin: Array, rounding: Array) -> Solution:
    """Find how entries transform.

    Args:
        group: the group.
        samples: what is observed in states and their images, ``(N, n, d)``.
        margin: largest difference of each entry from its image, ``(d,)``.
        rounding: largest difference between entries of one state that counts as none, ``(d,)``.
    """
    order, count, size = samples.shape
    data = samples.reshape(order * count, size)  # states h s
    images = np.stack(
        [samples[group.table[g].numpy()].reshape(order * count, size) for g in range(order)]
    )  # g h s

    classes = classes_of(data, rounding)
    found = Solution(np.zeros((order, size, size)), np.zeros((order, size), dtype=bool))
    found.constant, found.twins = classes.constant, [m for m in classes.members if len(m) > 1]
    found.events = _events(samples[0], rounding)
    stay = np.flatnonzero(classes.constant)
    found.matrices[:, stay, stay] = 1.0

    firsts = [members[0] for members in classes.members]
    reduced, failed = _reduced(
        group, data[:, firsts], images[:, :, firsts], margin[firsts], rounding[firsts]
    )
    _expand(classes, reduced, failed, found)
    return found


def _events(samples: Array, rounding: Array) -> Array:
    """How many samples differ from the entry's most common value."""
    ordered = np.sort(samples, axis=0)
    out = np.zeros(samples.shape[1], dtype=int)
    for i, column in enumerate(ordered.T):
        ends = np.searchsorted(column, column + rounding[i], side="right")
        out[i] = len(column) - int((ends - np.arange(len(column))).max(initial=0))
    return out


def _reduced(
    group: PointGroup, data: Array, images: Array, margin: Array, rounding: Array
) -> tuple[Array, Flags]:
    """Matrices on one entry of each class, and which rows have none."""
    order, size = len(images), data.shape[1]
    matrices, failed = np.zeros((order, size, size)), np.zeros((order, size), dtype=bool)
    mixed: set[int] = set()
    for g in range(order):
        for i, candidates in enumerate(matches(data, images[g], margin)):
            if candidates:
                equal = max(10 * candidates[0].off, rounding[i])  # as good as the best
                best = [match for match in candidates if match.off <= equal]
                match = min(best, key=lambda match: (match.index != i, match.off))
                matrices[g, i, match.index] = match.sign
            else:
                mixed.add(i)
    while True:  # entries that are exchanged with mixed ones are mixed by other elements
        more = {int(j) for i in mixed for j in np.flatnonzero(matrices[:, i].any(axis=0))} - mixed
        if not more:
            break
        mixed |= more

    if mixed:
        places = np.array(sorted(mixed))
        part, wrong = least_squares(data[:, places], images[:, :, places], margin[places])
        part, wrong = _orthogonal(group, part, wrong)
        off = np.abs(images[:, :, places] - np.einsum("nk,gik->gni", data[:, places], part)).max(axis=1)
        wrong |= off > margin[places]
        matrices[:, places] = 0.0
        matrices[np.ix_(np.arange(order), places, places)] = np.where(wrong[..., None], 0.0, part)
        failed[:, places] = wrong
    return matrices, failed


def _orthogonal(group: PointGroup, matrices: Array, wrong: Flags) -> tuple[Array, Flags]:
    """Make nearly orthogonal matrices so; rows of blocks that are not are wrong, too."""
    size = matrices.shape[-1]
    touched = np.asarray((np.abs(matrices) > 0).any(axis=0))
    label = np.arange(size)
    linked = touched | touched.T | np.eye(size, dtype=bool)
    while True:
        smallest = np.where(linked, label, len(label)).min(axis=1)
        if (smallest == label).all():
            break
        label = smallest
    out, wrong = matrices.copy(), wrong.copy()
    for first in np.unique(label):
        block = np.flatnonzero(label == first)
        part = matrices[np.ix_(np.arange(len(matrices)), block, block)]
        gap = np.abs(part @ part.swapaxes(1, 2) - np.eye(len(block))).max()
        if wrong[:, block].any() or gap > _ORTHOGONAL:
            wrong[1:, block] |= (
                np.abs(part @ part.swapaxes(1, 2) - np.eye(len(block))).max(axis=2) > _ORTHOGONAL
            )[1:]
        else:
            out[np.ix_(np.arange(len(matrices)), block, block)] = polished(group, part)
    return out, wrong


def _expand(classes: Classes, reduced: Array, failed: Flags, found: Solution) -> None:
    """From one entry of each class to all: the k-th goes to the k-th."""
    members, sign = classes.members, classes.sign
    for g, i in np.argwhere(failed):
        found.failed[g, members[i]] = True
    for g, i, j in np.argwhere(reduced):
        mine, theirs = members[i], members[j]
        if len(mine) != len(theirs):
            found.failed[g, mine] = True
            for entry in mine:
                found.reasons[int(g), entry] = (
                    f"it is there {_times(len(mine))}, what becomes it {_times(len(theirs))} (entries "
                    f"{mine} and {theirs}); observe both as often"
                )
            continue
        for a, b in zip(mine, theirs, strict=True):
            found.matrices[g, a, b] = reduced[g, i, j] * sign[a] * sign[b]


def _times(n: int) -> str:
    return "once" if n == 1 else f"{n} times"
