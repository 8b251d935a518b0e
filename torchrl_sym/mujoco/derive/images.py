"""Where an element of a model goes, and how the best images are chosen."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import linear_sum_assignment

from torchrl_sym.mujoco.model.types import Array

_NONE = 1e-9  # weights below it are none


class SymmetryError(ValueError):
    """The model does not have the requested symmetry, not even nearly; the message says why."""


@dataclass
class Image:
    """Where an element goes: the index of its image, a sign, and an offset of its coordinate.

    Attributes:
        index: the image; of what is mixed, the one that it is compared with.
        sign: of the image's coordinate.
        offset: what is added to the image's coordinate (of an actuator, to its control).
        length_offset, state_offset: what is added to the length and to the state of an actuator.
        mixture: of what has several images (motors of slides that a turn by 120 degrees mixes), the weight
            in each; empty if there is one.
        misfit: how far the image is from what it should be, relative; 0 in an exact model.
        through: the equality constraints that it takes for this to be the image.
        keeps: whether an actuator's control keeps its sign, whatever that of its length: that of a damper,
            whose force -k u v changes with the velocity.
    """

    index: int
    sign: float = 1.0
    offset: float = 0.0
    length_offset: float = 0.0
    state_offset: float = 0.0
    mixture: dict[int, float] = field(default_factory=dict)
    misfit: float = 0.0
    through: str = ""
    keeps: bool = False

    @property
    def control_sign(self) -> float:
        """Sign of the image's control and state, which for dampers is not that of its length."""
        return 1.0 if self.keeps else self.sign

    @property
    def weights(self) -> dict[int, float]:
        """The weight in each image."""
        return self.mixture or {self.index: self.control_sign}

    def text(self, name: Callable[[int], str]) -> str:
        """The image in words: a name with its sign, or a sum."""
        if not self.mixture:
            return "-" * (self.control_sign < 0) + name(self.index)
        terms = [f"{'-' if w < 0 else '+'} {abs(w):.4g} {name(i)}" for i, w in sorted(self.mixture.items())]
        whole = " ".join(terms)
        return (
            whole.removeprefix("+ ").replace("- ", "-", 1) if whole[0] == "-" else whole.removeprefix("+ ")
        )


def assign(cost: Array) -> list[tuple[int, int]]:
    """Best pairs; of elements that are alike each goes to its image in order, so that the maps compose."""
    if not cost.size:
        return []
    rows, columns = _ranks(cost), _ranks(cost.T)
    ranked = cost + 1e-8 * np.abs(np.subtract.outer(rows, columns))
    return [(int(r), int(c)) for r, c in zip(*linear_sum_assignment(ranked), strict=True)]


def _ranks(rows: Array) -> Array:
    """How many equal rows come before each."""
    labels = np.unique(np.round(rows, 9), axis=0, return_inverse=True)[1].reshape(-1)
    seen, ranks = np.zeros(len(rows), dtype=int), np.zeros(len(rows), dtype=int)
    for i, label in enumerate(labels):
        ranks[i] = seen[label]
        seen[label] += 1
    return ranks


def mixture(target: Array, parts: Mapping[int, Array]) -> dict[int, float]:
    """Weights of unit vectors that add up to a unit vector; empty if they do not."""
    if not parts:
        return {}
    matrix = np.stack([part / np.linalg.norm(part) for part in parts.values()], axis=1)
    weights = np.linalg.lstsq(matrix, target / np.linalg.norm(target), rcond=None)[0]
    gap = np.linalg.norm(matrix @ weights - target / np.linalg.norm(target))
    if gap > 1e-6 or abs(weights @ weights - 1) > 1e-6:
        return {}
    return {i: float(w) for i, w in zip(parts, weights, strict=True) if abs(w) > _NONE}
