"""Where an element of a model goes."""

from __future__ import annotations

from dataclasses import dataclass


class SymmetryError(ValueError):
    """The model does not have the requested symmetry, not even nearly; the message says why."""


@dataclass
class Image:
    """Where an element goes: the index of its image, a sign, and an offset of its coordinate."""

    index: int
    sign: float = 1.0
    offset: float = 0.0
