"""What a representation is made of: blocks, each of which says where every output entry comes from.

Under an element g, entry i of the image is a sum of a few entries of x, the *terms* of i:

    y[i] = weight[g, i, 0] * x[index[g, i, 0]] + ... + weight[g, i, K - 1] * x[index[g, i, K - 1]]

Almost everything on a robot has one term of weight +1 or -1 (joints change places and some change sign),
which is exact in every precision. Vectors turned by 120 degrees have two, quaternions and rotation matrices
up to nine. No block is ever a d x d matrix, so that a scan of a hundred thousand points costs its own size.

Blocks are immutable. Arithmetic is exact to the data's own precision: weighted sums are taken in float64,
which autocast and TF32 leave alone, and rounded once.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import torch
from torch import Tensor

from torchrl_sym.representations.constants import Constants

_TOLERANCE = 1e-9
_NOISE = 1e-12  # what rounding leaves of a 0 or a 1


class _Block:
    """N matrices of size d, by their terms.

    Attributes:
        index: source positions, ``(N, d)`` or ``(N, d, K)`` int64.
        dim: the size d.
        count: the number of terms K.
    """

    index: Tensor
    dim: int
    count: int

    @property
    def terms(self) -> tuple[Tensor, Tensor]:
        """Source positions and weights, ``(N, d, K)``; entries with fewer terms have weights 0."""
        raise NotImplementedError

    def orbit(self, x: Tensor) -> Tensor:
        return torch.stack([self.element(x, g) for g in range(len(self.index))])

    def element(self, x: Tensor, g: int) -> Tensor:
        """Image of ``(..., d)`` under one element; x itself where nothing changes."""
        raise NotImplementedError

    @property
    def matrices(self) -> Tensor:
        index, weight = self.terms
        return weight.new_zeros(len(index), self.dim, self.dim).scatter_add(-1, index, weight)

    def image_of_box(self, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
        """Bounds ``(N, d)`` of the images of a box ``(d,)``; 0 * inf counts as 0."""
        index, weight = self.terms
        ends = [torch.where(weight == 0, 0.0, weight * bound[index]) for bound in (low, high)]
        return torch.minimum(*ends).sum(-1), torch.maximum(*ends).sum(-1)

    def components(self) -> Tensor:
        """The smallest entry that each entry is exchanged or mixed with, ``(d,)``."""
        index, _ = self.terms
        label, found = torch.arange(self.dim, device="cpu"), None
        while found is None or not torch.equal(label, found):
            found, label = label, label[index].amin(dim=(0, 2))
        return label

    def select(self, elements: Tensor) -> Block:
        index, weight = self.terms
        return block_from_terms(index[elements], weight[elements])


class SignedPermutation(_Block):
    """N signed permutations of d entries: ``y[i] = sign[g, i] * x[index[g, i]]``.

    Args:
        index: source position of every output entry, ``(N, d)`` int64.
        sign: +1 or -1 for every output entry, ``(N, d)``.
    """

    count = 1

    def __init__(self, index: Tensor, sign: Tensor) -> None:
        self._constants = Constants(index.long(), sign.to(torch.int8))
        self.index, self.sign = self._constants.tensors
        self.dim = index.shape[1]
        stays = self.index == torch.arange(self.dim, device="cpu")
        self._moves: list[bool] = (~stays.all(-1)).tolist()
        self._flips: list[bool] = (self.sign < 0).any(-1).tolist()

    @property
    def terms(self) -> tuple[Tensor, Tensor]:
        return self.index[..., None], self.sign[..., None].double()

    @property
    def is_trivial(self) -> bool:
        """Whether every element leaves every entry."""
        return not (any(self._moves) or any(self._flips))

    def element(self, x: Tensor, g: int) -> Tensor:
        index, sign = self._constants.on(x.device)
        if self._moves[g]:
            x = x.index_select(-1, index.select(0, g))
        return x * _like(x, sign.select(0, g)) if self._flips[g] else x

    def rows(self, x: Tensor, g: Tensor) -> Tensor:
        index, sign = self._constants.on(x.device)
        element = g.flatten()  # selecting whole rows is three times as fast as indexing by g
        if any(self._moves):
            x = x.gather(-1, index.index_select(0, element).view(x.shape))
        if any(self._flips):
            x = x * _like(x, sign).index_select(0, element).view(x.shape)
        return x

    def product_residual(self, table: Tensor) -> Tensor:
        """Largest entry of rho(g) rho(h) - rho(gh) for all pairs: ``(N, N)``; 0 or more than 1."""
        wrong = []
        for index, sign, products in zip(self.index, self.sign, table, strict=True):  # rho(g) outermost
            moved = self.index[:, index] != self.index[products]
            flipped = sign * self.sign[:, index] != self.sign[products]
            wrong.append((moved | flipped).any(-1))
        return torch.stack(wrong).double()

    def orthogonality_residual(self) -> Tensor:
        order = torch.arange(self.dim, device="cpu")
        return (self.index.sort(dim=-1).values != order).any(-1).double()

    def absolute(self) -> SignedPermutation:
        return SignedPermutation(self.index, self.sign.abs())


def _like(x: Tensor, sign: Tensor) -> Tensor:
    if not x.dtype.is_signed:
        raise TypeError(f"expected signed numbers, got a {x.dtype} tensor: some entries change sign")
    return sign.to(x.dtype)


class Mixing(_Block):
    """N orthogonal matrices that mix entries, each a sum of up to K terms.

    Args:
        index: source positions, ``(N, d, K)`` int64.
        weight: their weights, ``(N, d, K)`` float64; terms of weight 0 come last.
    """

    is_trivial = False

    def __init__(self, index: Tensor, weight: Tensor) -> None:
        self.dim, self.count = index.shape[1:]
        used = (weight != 0).sum(-1, keepdim=True).clamp(min=1)
        rank = torch.arange(self.count, device="cpu") - used + 1  # 0 at an entry's last own term
        self.index = torch.where(rank > 0, index.gather(-1, used - 1), index)
        self.weight = weight
        # The last own term is shared out over unused ones as 1/2, 1/4, 1/4: their sum is exact, and no
        # infinity of an entry that does not contribute is multiplied by 0.
        share = weight.gather(-1, used - 1) * 0.5 ** torch.minimum(rank + 1, self.count - used)
        shared = torch.where(rank < 0, weight, share)
        by_term = [terms.movedim(-1, 0).contiguous() for terms in (self.index, shared)]  # (K, N, d)
        self._constants = Constants(*by_term)

    @property
    def terms(self) -> tuple[Tensor, Tensor]:
        return self.index, self.weight

    def element(self, x: Tensor, g: int) -> Tensor:
        if g == 0:
            return x
        terms = zip(*(each.select(1, g) for each in self._on(x)), strict=True)
        return _sum([x.index_select(-1, index) * weight for index, weight in terms]).to(x.dtype)

    def rows(self, x: Tensor, g: Tensor) -> Tensor:
        element, terms = g.flatten(), []
        for index, weight in zip(*self._on(x), strict=True):
            source = x.gather(-1, index.index_select(0, element).view(x.shape))
            terms.append(source * weight.index_select(0, element).view(x.shape))
        return torch.where((g == 0).unsqueeze(-1), x, _sum(terms).to(x.dtype))

    def _on(self, x: Tensor) -> tuple[Tensor, ...]:
        if not x.dtype.is_floating_point:
            raise TypeError(f"expected real numbers, got a {x.dtype} tensor: some entries are mixed")
        return self._constants.on(x.device)

    def product_residual(self, table: Tensor) -> Tensor:
        """Largest entry of rho(g) rho(h) - rho(gh) for all pairs: ``(N, N)``."""
        matrices = self.matrices
        differences = [
            (matrix @ matrices - matrices[products]).abs().amax(dim=(-2, -1))
            for matrix, products in zip(matrices, table, strict=True)
        ]
        return torch.stack(differences)

    def orthogonality_residual(self) -> Tensor:
        eye = torch.eye(self.dim, dtype=torch.float64, device="cpu")
        return torch.stack([(matrix @ matrix.mT - eye).abs().amax() for matrix in self.matrices])


def _sum(terms: Sequence[Tensor]) -> Tensor:
    total = terms[0]
    for term in terms[1:]:
        total = total + term
    return total


Block = SignedPermutation | Mixing


def block_from_matrices(matrices: Tensor) -> Block:
    """A signed permutation if every matrix is one (to 1e-9), a mixing block otherwise."""
    matrices = matrices.double().cpu()
    size = matrices.abs()
    is_binary = ((size < _TOLERANCE) | ((size - 1).abs() < _TOLERANCE)).all()
    if is_binary and (size.round().sum(dim=-1) == 1).all():
        index = size.argmax(dim=-1)
        return SignedPermutation(index, matrices.gather(-1, index[..., None])[..., 0].sign())
    whole = matrices.round()
    matrices = torch.where((matrices - whole).abs() < _NOISE, whole, matrices)
    return block_from_terms(torch.arange(matrices.shape[-1], device="cpu").expand_as(matrices), matrices)


def block_from_terms(index: Tensor, weight: Tensor) -> Block:
    """The cheapest block with these terms, ``(N, d, K)``; those of weight 0 are left out."""
    first = (weight == 0).to(torch.int8).sort(dim=-1, stable=True).indices  # terms that count
    count = int((weight != 0).sum(-1).max()) if weight.numel() else 1
    index, weight = (terms.gather(-1, first[..., :count]) for terms in (index, weight))
    if count == 1 and ((weight.abs() - 1).abs() < _TOLERANCE).all():
        return SignedPermutation(index[..., 0], weight[..., 0].sign())
    return Mixing(index, weight)


def join(blocks: Sequence[Block]) -> Block:
    """Direct sum of many, at once: one by one takes the square of the time."""
    if len(blocks) == 1:
        return blocks[0]
    starts = itertools.accumulate((block.dim for block in blocks[:-1]), initial=0)
    if all(isinstance(block, SignedPermutation) for block in blocks):
        index = [block.index + start for block, start in zip(blocks, starts, strict=True)]
        return SignedPermutation(torch.cat(index, 1), torch.cat([block.sign for block in blocks], 1))  # pyright: ignore[reportAttributeAccessIssue]
    index, weight = zip(*(_padded(block, max(b.count for b in blocks)) for block in blocks), strict=True)
    return Mixing(
        torch.cat([i + start for i, start in zip(index, starts, strict=True)], 1), torch.cat(weight, 1)
    )


def _padded(block: Block, count: int) -> list[Tensor]:
    return [torch.nn.functional.pad(terms, (0, count - block.count)) for terms in block.terms]


def merge(blocks: Sequence[Block]) -> list[Block]:
    """Join neighbouring blocks of as many terms, so that a call does as few gathers as possible."""
    return [join(list(run)) for _, run in itertools.groupby(blocks, key=lambda block: block.count)]


def product(outer: Block, inner: Sequence[Block]) -> Block:
    """Tensor product, entries of ``inner`` running fastest: a block per outer entry, or one for all."""
    count = max(block.count for block in inner)
    index, weight = zip(*(_padded(block, count) for block in inner), strict=True)
    inner_index, inner_weight = torch.stack(index, 1), torch.stack(weight, 1)  # (N, n | 1, v, L)
    outer_index, outer_weight = (terms[:, :, None, :, None] for terms in outer.terms)  # (N, n, 1, K, 1)
    size = inner[0].dim
    whole = len(outer.index), outer.dim * size, outer.count * count
    index = (outer_index * size + inner_index[..., None, :]).reshape(whole)
    return block_from_terms(index, (outer_weight * inner_weight[..., None, :]).reshape(whole))
