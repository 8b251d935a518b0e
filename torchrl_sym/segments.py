"""A representation cut into the pieces that a person would have added up, each with its builder's name.

Pieces are found by trying builders on consecutive entries: vectors, quaternions, joints that change
places, items. Several sums may describe one representation, so the pieces are a reading, not the only one;
what they say of every entry is exact.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torchrl_sym.groups import PointGroup
from torchrl_sym.representations import (
    Representation,
    axial,
    heading,
    planar,
    polar,
    pseudoscalar,
    quaternion,
    rotation_matrix,
    scalar,
)
from torchrl_sym.representations.blocks import join

_CLOSE = 1e-9
_ITEMS = 12  # entries from which on items are looked for: fewer are read more easily one by one


@dataclass(frozen=True)
class Segment:
    """Consecutive entries that transform among themselves.

    Attributes:
        start: the first entry.
        matrices: ``(N, size, size)``.
        builder: name of what makes it: a builder of one call, ``"invariant"``, ``"signed_permutation"``,
            ``"items"`` or ``"Representation"``.
        arguments: what follows the group in that call.
        value: of items, the size of one.
    """

    start: int
    matrices: Tensor
    builder: str
    arguments: str = ""
    value: int = 0

    @property
    def size(self) -> int:
        """Number of entries."""
        return self.matrices.shape[-1]


_Named = tuple[str, str, Callable[[PointGroup], Representation]]
_VECTORS: tuple[_Named, ...] = (
    ("polar", "", polar),
    ("axial", "", axial),
    ("quaternion", '"conjugate"', lambda group: quaternion(group, "conjugate")),
    ("quaternion", "", quaternion),
    ("planar", "", planar),
    ("heading", "", heading),
    ("rotation_matrix", "", lambda group: rotation_matrix(group).flatten()),
)
_NUMBERS: tuple[_Named, ...] = (("scalar", "", scalar), ("pseudoscalar", "", pseudoscalar))


def segments(representation: Representation, labels: Sequence[str] = ()) -> list[Segment]:
    """The pieces of a representation, in order.

    Args:
        representation: of any event; its entries are taken in order.
        labels: what the entries are, if known: entries of their own name, such as joints, are not read as
            parts of a vector.

    Example:
        >>> group = PointGroup.klein_four()
        >>> [piece.builder for piece in segments(polar(group) + axial(group) + scalar(group))]
        ['polar', 'axial', 'scalar']
    """
    reader = _Reader(representation, labels)
    found, start = [], 0
    while start < representation.dim:
        found.append(reader.at(start))
        start += found[-1].size
    return found


class _Reader:
    def __init__(self, representation: Representation, labels: Sequence[str]) -> None:
        self.group = representation.group
        self.labels = list(labels) or [""] * representation.dim
        self.index, self.weight = join(representation.blocks).terms  # (N, d, K)
        used = torch.where(self.weight != 0, self.index, torch.arange(representation.dim)[:, None])
        furthest = used.amax(dim=(0, 2)).cummax(0).values
        self.ends = [i + 1 for i, last in enumerate(furthest.tolist()) if last == i]
        self.vectors, self.numbers = (self._made(each) for each in (_VECTORS, _NUMBERS))

    def _made(self, builders: Sequence[_Named]) -> list[tuple[str, str, Tensor]]:
        made = []
        for name, arguments, build in builders:
            try:
                made.append((name, arguments, build(self.group).matrices))
            except ValueError:  # no such representation of this group
                continue
        return made

    def matrices(self, start: int, stop: int) -> Tensor:
        """Of the entries from start to stop, which must be closed."""
        index, weight = (x[:, start:stop] for x in (self.index, self.weight))
        index = torch.where(weight != 0, index - start, 0)
        size = stop - start
        return weight.new_zeros(len(index), size, size).scatter_add(-1, index, weight)

    def at(self, start: int) -> Segment:
        """The longest piece that begins here."""
        vector = self.vector(start)
        if vector is not None:
            return vector
        stop = next(end for end in self.ends if end > start)
        if stop - start == 1:
            return self.run(start)
        matrices = self.matrices(start, stop)
        if not _is_signed_permutation(matrices):
            return Segment(start, matrices, "Representation")
        items = self.items(start, matrices)
        return items or Segment(start, matrices, "signed_permutation")

    def vector(self, start: int) -> Segment | None:
        """A vector, quaternion, ... that begins here: one of all that is of one thing, or the first."""
        whole = self.extent(start)
        exact = [v for v in self.vectors if v[2].shape[-1] == whole]
        for name, arguments, wanted in (*exact, *self.vectors):
            stop = start + wanted.shape[-1]
            if stop not in self.ends or (whole is not None and stop > start + whole):
                continue
            if name == "rotation_matrix" and not exact:
                continue
            found = self.matrices(start, stop)
            if (found - wanted).abs().max() < _CLOSE:
                return Segment(start, found, name, arguments)
        return None

    def extent(self, start: int) -> int | None:
        """How many entries from here are of one thing, ``root[0]``, ``root[1]``; None if unknown."""
        stems = [_stem(name) for name in self.labels[start:]]
        if not self.labels[start]:
            named = next((i for i, name in enumerate(self.labels[start:]) if name), None)
            return named  # what has a name is something else
        return (
            next((i for i, stem in enumerate(stems) if stem is None or stem != stems[0]), len(stems)) or 1
        )

    def run(self, start: int) -> Segment:
        """As many single entries as go together: scalars, or signs, up to the next vector."""
        stop, kinds = start, []
        while stop + 1 in self.ends and (stop == start or self.vector(stop) is None):
            kind = next(
                (n for n, _, w in self.numbers if torch.equal(w, self.matrices(stop, stop + 1))), ""
            )
            if (kinds and (kind != "") != (kinds[0] != "")) or (kind and kinds and kind != kinds[0]):
                break
            kinds.append(kind)
            stop += 1
        matrices = self.matrices(start, stop)
        if kinds[0] == "scalar" and len(kinds) > 1:
            return Segment(start, matrices, "invariant", str(len(kinds)))
        if kinds[0] == "pseudoscalar" and len(kinds) > 1:
            return Segment(start, self.matrices(start, start + 1), "pseudoscalar")
        return Segment(start, matrices, kinds[0] or "signed_permutation")

    def items(self, start: int, matrices: Tensor) -> Segment | None:
        """Items that change places, each a sum of vectors."""
        size = matrices.shape[-1]
        if all(name and _stem(name) is None for name in self.labels[start : start + size]):
            return None  # each has a name of its own
        for value in (k for k in range(9, 1, -1) if size >= _ITEMS and size % k == 0):
            places, each = factors(matrices, value)
            whole = torch.stack([torch.kron(p, v) for p, v in zip(places, each, strict=True)])
            if (whole - matrices).abs().max() < _CLOSE:
                return Segment(start, matrices, "items", "", value)
        return None


def factors(matrices: Tensor, value: int) -> tuple[Tensor, Tensor]:
    """Places ``(N, n, n)`` and values ``(N, value, value)``, if matrices are their tensor products."""
    blocks = matrices.unflatten(1, (-1, value)).unflatten(3, (-1, value)).transpose(2, 3)  # (N, n, n, v, v)
    places = (blocks.abs().amax(dim=(-2, -1)) > _CLOSE).double()
    source = places[:, 0].argmax(-1)
    each = torch.stack([block[0, j] for block, j in zip(blocks, source.tolist(), strict=True)])
    return places, each


def _stem(label: str) -> str | None:
    """The thing that ``root[2]`` is a part of; None of what has no parts."""
    name, bracket, _ = label.removeprefix("-").rpartition("[")
    return name if bracket else None


def _is_signed_permutation(matrices: Tensor) -> bool:
    return bool(((matrices == 0) | (matrices.abs() == 1)).all())
