"""Irreducible representations: the smallest parts that a representation falls into.

Every real representation of a finite group is a direct sum of a few irreducible ones. A linear map that
commutes with the group takes each of them to copies of itself only, and on those it is a number (Schur):
a real one where nothing else commutes with the irreducible representation, a complex one where a quarter
turn J of the plane does, as with the turns by 120 degrees. So a map between m and m' copies has m m'
numbers, or 2 m m', however large the representation is.

A third type, the quaternionic, does not occur: finite groups of isometries of space are cyclic, dihedral or
symmetries of a regular solid, or one of these and a central inversion, and of none is an irreducible
representation quaternionic. Those of complex type are planes that are turned.
"""

from __future__ import annotations

import functools
import itertools
from dataclasses import dataclass

import torch
from torch import Tensor

from torchrl_sym.groups import PointGroup

_SAME = 1e-8  # numbers that differ by less are one eigenvalue, or one character
_LARGE = 0.37  # of the longest candidate: the first one above it is taken, which rounding does not change


@dataclass(frozen=True, eq=False)
class Irrep:
    """An irreducible representation.

    Attributes:
        matrices: orthogonal, ``(N, d, d)`` float64.
        is_complex: whether the quarter turn ``[[0, -1], [1, 0]]`` commutes with all of them; then d = 2.
    """

    matrices: Tensor
    is_complex: bool

    @property
    def dim(self) -> int:
        """Size d of the matrices."""
        return self.matrices.shape[-1]

    @property
    def numbers(self) -> int:
        """Real numbers of a map from one copy to another: 1 or 2."""
        return 2 if self.is_complex else 1

    def multiplicity(self, character: Tensor) -> int:
        """How many copies a representation with this character, ``(N,)``, has."""
        own = self.matrices.diagonal(dim1=-2, dim2=-1).sum(-1)
        return round((own * character).mean().item() / self.numbers)

    def copies(self, matrices: Tensor) -> Tensor:
        """Orthonormal vectors of the copies in a representation.

        Args:
            matrices: of the representation, ``(N, s, s)`` float64.

        Returns:
            ``(d, m, s)``: under g, those of one copy turn into sums of each other by the irreducible
            representation's matrix of g.
        """
        mean = torch.einsum("gk,gij->kij", self.matrices[:, :, 0], matrices) * (self.dim / len(matrices))
        count = self.multiplicity(matrices.diagonal(dim1=-2, dim2=-1).sum(-1))
        found = matrices.new_zeros(self.dim, 0, matrices.shape[-1])
        for _ in range(count):
            vector = _first_long(_without(mean[0].T, found.flatten(0, 1)))
            vector = _without(mean[0] @ vector / vector.norm(), found.flatten(0, 1))  # rounding once more
            found = torch.cat([found, (mean @ (vector / vector.norm()))[:, None]], 1)
        return found


def _without(rows: Tensor, others: Tensor) -> Tensor:
    """Rows less what lies in the span of others, which are orthonormal."""
    return rows - (rows @ others.T) @ others


def _first_long(rows: Tensor) -> Tensor:
    length = rows.norm(dim=-1)
    return rows[int((length > _LARGE * length.max()).long().argmax())]


@functools.cache
def irreps(group: PointGroup) -> tuple[Irrep, ...]:
    """All irreducible representations over the real numbers, by size, that of the identity first.

    They are parts of the regular representation. A symmetric matrix that commutes with it, and is otherwise
    in general position, has one of them for each of its eigenspaces. Which, and in which basis, is settled
    by the product table alone: parameters in these coordinates mean the same on every machine.

    Example:
        >>> [(irrep.dim, irrep.is_complex) for irrep in irreps(PointGroup.rotation(3))]
        [(1, False), (2, True)]
    """
    n, table = group.order, group.table
    one = torch.eye(n, dtype=torch.float64, device="cpu")
    left = torch.stack([one[table[group.inverse[g]]] for g in range(n)])  # [g] sends h to g h
    numbers = torch.arange(n, dtype=torch.float64, device="cpu").add(1).sqrt().frac()
    numbers = numbers + numbers[group.inverse]
    values, vectors = torch.linalg.eigh(numbers[table[group.inverse]])  # [g, h] is that of g^-1 h

    found: dict[tuple[float, ...], Irrep] = {}
    starts = [0, *((values.diff() > _SAME).nonzero().flatten() + 1).tolist(), n]
    for start, stop in itertools.pairwise(starts):
        space = vectors[:, start:stop]
        matrices = _canonical(space @ space.T, stop - start, left)
        character = matrices.diagonal(dim1=-2, dim2=-1).sum(-1)
        key = (stop - start, *(-character).round(decimals=6).tolist())
        found.setdefault(key, Irrep(matrices, bool((character.square().mean() - 1).abs() > 0.5)))
    return tuple(irrep for _, irrep in sorted(found.items(), key=lambda item: item[0]))


def _canonical(projection: Tensor, dim: int, left: Tensor) -> Tensor:
    """Matrices of the regular representation on a subspace, in a basis that its projection determines."""
    basis = projection[:0]
    for _ in range(dim):
        row = _without(_first_long(_without(projection, basis)), basis)
        basis = torch.cat([basis, row[None] / row.norm()])
    matrices = basis @ left @ basis.T
    whole = matrices.round()
    return torch.where((matrices - whole).abs() < 1e-12, whole, matrices)
