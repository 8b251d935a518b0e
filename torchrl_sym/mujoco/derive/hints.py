"""What speaks against a pair of parts beside geometry: names that have another counterpart, and ranges."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field

import numpy as np

from torchrl_sym.mujoco.derive.gaps import Gaps, Pairs, columns
from torchrl_sym.mujoco.derive.names import counterparts, exchanged
from torchrl_sym.mujoco.model.links import Skeleton
from torchrl_sym.mujoco.model.types import HINGE, SLIDE, Array

_NAME, _RANGE = 3e-2, 2e-2  # what a name or a range that disagrees costs


def exchanges(
    skeleton: Skeleton, images: dict[int, int], doubtful: Collection[int], acting: Array
) -> tuple[bool, bool]:
    """Whether left and right, front and hind change places, by the names of what is beyond doubt.

    Args:
        skeleton: of the model.
        images: of links.
        doubtful: links whose images are in doubt.
        acting: the element, which decides where names do not.
    """
    default, names = exchanged(acting), skeleton.names["body"]
    votes = {flags: 0 for flags in ((False, False), (True, False), (False, True), (True, True))}
    for a, b in images.items():
        if a and a not in doubtful and a != b:
            for flags in votes:
                votes[flags] += names[b] in counterparts(names[a], *flags)
    best = max(votes, key=lambda flags: (votes[flags], flags == default))
    return best if votes[best] > votes[default] else default


@dataclass
class Hints:
    """Says what pairs cost by names and ranges, once it is known what changes places.

    Attributes:
        gaps: of the isometry.
        flags: whether left and right change places, and front and hind.
    """

    gaps: Gaps
    flags: tuple[bool, bool]
    _meant: dict[tuple[str, int], list[int]] = field(default_factory=dict)

    def costs(self, pairs: Pairs, joints: Sequence[dict[int, int]]) -> list[float]:
        """Of pairs of links, with the images of the joints of each."""
        flat = [pair for images in joints for pair in images.items()]
        ranges = iter((_RANGE * range_gaps(self.gaps, flat)).tolist())
        return [
            _NAME * self._named_otherwise("body", a, b)
            + sum(_NAME * self._named_otherwise("joint", i, j) + next(ranges) for i, j in images.items())
            for (a, b), images in zip(pairs, joints, strict=True)
        ]

    def _named_otherwise(self, kind: str, a: int, b: int) -> bool:
        """Whether the name of a has counterparts in the model, and b is none of them."""
        if (kind, a) not in self._meant:
            skeleton = self.gaps.parts.skeleton
            known = skeleton.numbers[kind]
            names = counterparts(skeleton.names[kind][a], *self.flags)
            self._meant[kind, a] = [known[name] for name in names if name in known]
        meant = self._meant[kind, a]
        return bool(meant) and b not in meant


def range_gaps(gaps: Gaps, pairs: Pairs) -> Array:
    """How far the images of joints' ranges are from those of others, at most 1."""
    model, qpos = gaps.parts.model, gaps.parts.data.qpos
    i, j = columns(pairs)
    kind, other, limited = model.jnt_type[i], model.jnt_type[j], model.jnt_limited != 0
    sign, address = gaps.signs(pairs), model.jnt_qposadr
    shift = qpos[address[j]] - sign * qpos[address[i]]
    image = np.sort(sign[:, None] * model.jnt_range[i] + shift[:, None], axis=1)
    interval = model.jnt_range[j]
    apart = np.abs(image - interval).max(axis=1) / np.maximum(np.ptp(interval, axis=1), 1e-9)
    found = np.where(limited[i] & limited[j], np.minimum(apart, 1.0), limited[i] != limited[j])
    return found * (np.isin(kind, (HINGE, SLIDE)) & (kind == other))
