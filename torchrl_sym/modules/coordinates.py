"""Isotypic coordinates: a basis of a representation in which maps that commute with the group are small.

An orthogonal matrix sorts the entries of an event by irreducible representation, so that under g

    z[i, :, a]  ->  D_i(g) z[i, :, a]        for each copy a of the i-th one

and a linear map that commutes with the group is, for each i, one matrix from copies to copies. The change
of basis is sparse. Entries that no element exchanges or mixes, such as joints of different kinds, stay
apart, and those that are exchanged or mixed in one way share one small matrix: of an entry for each leg,
the Hadamard matrix where the group is C2 x C2. So the change of basis is a gather and a product with each
of a few small matrices.

Vectors are columns here, ``(dim, B)`` for a batch of B: then copies of whatever irreducible representation
are adjacent rows, and no product has to move them first.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

from torchrl_sym.groups import PointGroup
from torchrl_sym.modules.irreps import Irrep, irreps
from torchrl_sym.representations import Representation
from torchrl_sym.representations.blocks import join
from torchrl_sym.representations.constants import Constants


@dataclass(frozen=True)
class Kind:
    """The irreducible representations of a group that have one size and one type.

    Attributes:
        dim: their size d.
        is_complex: their type.
        members: their positions among all.
    """

    dim: int
    is_complex: bool
    members: tuple[int, ...]


def kinds(group: PointGroup) -> list[Kind]:
    """All kinds, by size; the identity's irreducible representation is the first member of the first."""
    found: dict[tuple[int, bool], list[int]] = {}
    for i, irrep in enumerate(irreps(group)):
        found.setdefault((irrep.dim, irrep.is_complex), []).append(i)
    return [Kind(*key, tuple(members)) for key, members in found.items()]


class Coordinates:
    """The change of basis of one representation, there and back.

    Args:
        representation: of any group and event shape; its entries are taken flat.

    Attributes:
        multiplicity: number of copies of each irreducible representation.
        copies: for each kind the largest of these, to which its members are filled up.

    Example:
        >>> from torchrl_sym.representations import polar
        >>> coordinates = Coordinates(polar(PointGroup.reflection("y")))
        >>> coordinates.multiplicity  # x and z stay, y changes its sign
        [2, 1]
        >>> coordinates.split(torch.tensor([[1.0], [2.0], [3.0]]))[0].flatten(1)  # the last one fills up
        tensor([[1., 3.],
                [2., 1.]])
    """

    def __init__(self, representation: Representation) -> None:
        self.dim = representation.dim
        all_irreps, self.kinds = irreps(representation.group), kinds(representation.group)
        self._sizes: list[tuple[int, int]] = []  # of entries, and of components, by their way of mixing
        gather, matrices, labels = [], [], []
        for entries, local in _components(representation):
            size, count = entries.shape
            matrix, label = _local_basis(local, all_irreps)
            gather.append(entries.flatten())
            matrices.append(matrix)
            labels += [(*each, component) for each in label for component in range(count)]
            self._sizes.append((size, count))
        order = self._order(labels, len(all_irreps))
        entries = torch.cat(gather)
        back = order.argsort()[-self.dim :]  # behind the rows that only fill up, which are -1
        indices = entries, order.clamp(min=0), back, entries.argsort()
        stays = torch.arange(self.dim, device="cpu")
        self._in_place = torch.equal(entries, stays), torch.equal(order, stays)
        self._constants = Constants(*indices, *matrices)

    def _order(self, labels: Sequence[tuple[int, ...]], count: int) -> Tensor:
        """Where each row of the stacked kinds comes from; -1 for those that only fill up."""
        rows: list[dict[int, list[int]]] = [{} for _ in range(count)]
        for row, (i, k, *_) in enumerate(labels):
            rows[i].setdefault(k, []).append(row)
        self.multiplicity = [len(copies.get(0, ())) for copies in rows]
        self.copies = [max(self.multiplicity[i] for i in kind.members) for kind in self.kinds]
        order: list[int] = []
        for kind, most in zip(self.kinds, self.copies, strict=True):
            for i in kind.members:
                for k in range(kind.dim):
                    own = rows[i].get(k, [])
                    order += [*own, *[-1] * (most - len(own))]
        return torch.tensor(order, device="cpu")

    def split(self, x: Tensor) -> list[Tensor]:
        """Coordinates of columns ``(dim, B)``: per kind, ``(members, d, copies, B)``.

        Members that have fewer copies than others are filled up with copies of other rows.
        """
        gather, order, _, _, *matrices = self._constants.on(x.device)
        x = x if self._in_place[0] else x.contiguous().index_select(0, gather)  # of whole rows
        x = self._mixed(x, [matrix.to(x.dtype) for matrix in matrices])
        x = x if self._in_place[1] else x.index_select(0, order)
        shapes = [(len(k.members), k.dim, m) for k, m in zip(self.kinds, self.copies, strict=True)]
        parts = _split(x, [math.prod(shape) for shape in shapes])
        return [part.unflatten(0, shape) for part, shape in zip(parts, shapes, strict=True)]

    def join(self, parts: Sequence[Tensor]) -> Tensor:
        """The columns with these coordinates."""
        _, _, order, scatter, *matrices = self._constants.on(parts[0].device)
        flat = [part.flatten(0, 2) for part in parts]
        x = _cat(flat)
        x = x if self._in_place[1] else x.index_select(0, order)
        x = self._mixed(x, [matrix.to(x.dtype).T for matrix in matrices])
        return x if self._in_place[0] else x.index_select(0, scatter)

    def identity_part(self, values: Tensor) -> Tensor:
        """Coordinates of the first kind of what no element changes: ``(members, 1, copies, B)``.

        Args:
            values: of the copies of the identity's irreducible representation, ``(multiplicity[0], B)``.
        """
        members, copies = len(self.kinds[0].members), self.copies[0]
        return functional.pad(values[None], (0, 0, 0, copies - len(values), 0, members - 1))[:, None]

    def invariant(self, values: Tensor) -> Tensor:
        """The columns with these coordinates alone, see :meth:`identity_part`."""
        others = [*zip(self.kinds, self.copies, strict=True)][1:]
        zeros = [values.new_zeros(len(k.members), k.dim, m, values.shape[1]) for k, m in others]
        return self.join([self.identity_part(values), *zeros])

    def invariant_directions(self) -> Tensor:
        """Orthonormal vectors that no element changes, as columns, ``(dim, multiplicity[0])`` float64."""
        return self.invariant(torch.eye(self.multiplicity[0], dtype=torch.float64, device="cpu"))

    def _mixed(self, x: Tensor, matrices: Sequence[Tensor]) -> Tensor:
        """Entries of components that mix in one way, ``[size, component]``, times their matrix."""
        parts = _split(x, [size * count for size, count in self._sizes])
        mixed = [
            part if size == 1 else (matrix @ part.reshape(size, -1)).reshape(part.shape)
            for part, (size, _), matrix in zip(parts, self._sizes, matrices, strict=True)
        ]
        return _cat(mixed)


def _split(x: Tensor, sizes: list[int]) -> Sequence[Tensor]:
    return [x] if len(sizes) == 1 else x.split(sizes)


def _cat(parts: Sequence[Tensor]) -> Tensor:
    return parts[0] if len(parts) == 1 else torch.cat(list(parts))


def _components(representation: Representation) -> Iterator[tuple[Tensor, Tensor]]:
    """Sets of entries that are exchanged or mixed, those of one way at once.

    Yields:
        Entries ``(size, count)``, in the order in which all of these sets are mixed alike, and how:
        matrices ``(N, size, size)``.
    """
    labels = representation.components
    index, weight = join(representation.blocks).terms
    by_label = labels.argsort(stable=True)
    sizes = labels.bincount()
    starts = sizes.cumsum(0) - sizes
    rank = torch.empty_like(labels)
    rank[by_label] = torch.arange(len(labels)) - starts[labels[by_label]]

    for size in sizes.unique().tolist():
        chosen = (sizes == size).nonzero().flatten()
        entries = by_label[starts[chosen, None] + torch.arange(size)]  # (components, size)
        local, scale = (terms[:, entries].movedim(1, 0) for terms in (rank[index], weight))
        ways = torch.cat([local.double().flatten(1), scale.flatten(1)], 1).round(decimals=12)
        _, way = ways.unique(dim=0, return_inverse=True)
        for first in dict.fromkeys(way.tolist()):
            alike = (way == first).nonzero().flatten()
            shape = (index.shape[0], size, size)
            terms = local[alike[0]], scale[alike[0]]
            yield entries[alike].T, weight.new_zeros(shape).scatter_add(-1, *terms)


def _local_basis(matrices: Tensor, all_irreps: Sequence[Irrep]) -> tuple[Tensor, list[tuple[int, ...]]]:
    """Orthogonal ``(s, s)``, and for each of its rows the irreducible representation, its row, the copy."""
    rows, labels = [], []
    for i, irrep in enumerate(all_irreps):
        vectors = irrep.copies(matrices)
        rows.append(vectors.flatten(0, 1))
        labels += [(i, k, a) for k in range(vectors.shape[0]) for a in range(vectors.shape[1])]
    return torch.cat(rows), labels
