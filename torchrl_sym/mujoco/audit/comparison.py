"""Residuals of numbers that a symmetry maps onto each other, made relative."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from torchrl_sym.mujoco.audit.report import Kind, Residual
from torchrl_sym.mujoco.audit.scales import Efforts
from torchrl_sym.mujoco.derive.symmetry import ModelSymmetry
from torchrl_sym.mujoco.model.types import Array, name_of


class Comparison:
    """Compares everything in a model with its image under one element; ``worst`` holds the outcome."""

    def __init__(self, symmetry: ModelSymmetry, g: int, efforts: Efforts) -> None:
        self.model, self.action = symmetry.model, symmetry.actions[g]
        self.matcher = self.action.matcher
        self.data, self.image = self.matcher.data, self.matcher.image
        self.links = self.matcher.links
        self.map = self.action.coordinates
        self.element, self.efforts = symmetry.group.names[g], efforts
        self._columns: dict[tuple[str, bytes | None], tuple[Array, Array]] = {}
        self.worst: dict[str, Residual] = {}
        self.unchecked: list[str] = []
        self.untold: list[str] = []
        self.warnings: list[str] = []

    def add(self, term: str, residual: float, name: str, kind: Kind = "dynamics", amount: str = "") -> None:
        """Keep the worst part of each term."""
        if term not in self.worst or residual > self.worst[term].residual:
            self.worst[term] = Residual(self.element, term, residual, name, kind, amount)

    def name(self, kind: str, a: int, b: int) -> str:
        names = self.matcher.skeleton.names.get(kind)
        one, other = (names[x] if names else name_of(self.model, kind, x) for x in (a, b))
        return one if a == b else f"{one} -> {other}"

    def range(
        self,
        term: str,
        field: str,
        limited: str | None,
        i: int,
        j: int,
        sign: float,
        shift: float,
        name: str,
    ) -> None:
        """An interval goes to ``sign * interval + shift``; compared relative to its width."""
        model = self.model
        flags = [bool(getattr(model, limited)[k]) if limited else True for k in (i, j)]
        if flags[0] != flags[1]:
            self.add(term, 1.0, f"{name} (only one is limited)")
        elif flags[0]:
            one, other = getattr(model, field)[i], getattr(model, field)[j]
            image = np.sort(sign * one + shift)
            scale = max(np.ptp(one), np.ptp(other)) or np.abs(other).max() or 1.0
            self.add(term, float(np.abs(image - other).max()) / scale, name)

    def fields(
        self, term: str, fields: list[str], i: int, j: int, name: str, alike: NDArray[np.intp] | None = None
    ) -> None:
        """Model fields that must be equal, relative to the largest among elements of like units."""
        for field in fields:
            values, scale = self._column(field, alike)
            if len(scale):
                self.add(term, float((np.abs(values[i] - values[j]) / scale).max()), name)

    def _column(self, field: str, alike: NDArray[np.intp] | None) -> tuple[Array, Array]:
        """Values of a field and their scale, which is empty where all are zero."""
        key = field, None if alike is None else alike.tobytes()
        if key not in self._columns:
            values = np.asarray(getattr(self.model, field, 0.0), dtype=float)  # some are new in 3.17
            if values.any():
                values = values.reshape(len(values), -1)
                self._columns[key] = values, column_scale(values if alike is None else values[alike])
            else:
                self._columns[key] = values, np.zeros(0)
        return self._columns[key]

    def values(
        self, term: str, values: Array, i: int, j: int, name: str, alike: NDArray[np.intp] | None = None
    ) -> None:
        scale = column_scale(values if alike is None else values[alike])
        self.add(term, float((np.abs(values[i] - values[j]) / scale).max(initial=0.0)), name)


def column_scale(values: Array) -> Array:
    """Largest magnitude in each column, 1 for a column of zeros."""
    if not len(values):
        return np.ones(values.shape[1:])
    scale = np.abs(values).max(axis=0)
    return np.where(scale > 0, scale, 1.0)
