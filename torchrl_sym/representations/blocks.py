"""The two kinds of matrix a representation is made of: signed permutations and small dense blocks.

Almost everything on a robot transforms by a signed permutation (joints change places and some change
sign), which costs one gather and one multiplication and is exact in every precision. Vectors turned by
120 degrees, and quaternions, need a small dense orthogonal block. A block knows its N matrices and how
to apply them; :class:`~torchrl_sym.representations.Representation` strings blocks together.
"""

from __future__ import annotations

import copy
import itertools

import torch
from torch import Tensor, nn

_TOLERANCE = 1e-9
_DENSE_LIMIT = 16  # dense neighbours are merged up to this size: fewer calls, still cheap per row


class SignedPermutation(nn.Module):
    """N signed permutations of d entries: ``y[i] = sign[g, i] * x[index[g, i]]``.

    Args:
        index: source position of every output entry, ``(N, d)`` int64.
        sign: +1 or -1 for every output entry, ``(N, d)``.
    """

    index: Tensor
    sign: Tensor

    def __init__(self, index: Tensor, sign: Tensor) -> None:
        super().__init__()
        self.register_buffer("index", index.long(), persistent=False)
        # int8 keeps its meaning under module.half(); it is cast to the data's dtype on use
        self.register_buffer("sign", sign.to(torch.int8), persistent=False)
        self.dim = index.shape[1]
        self._moves = bool((index != torch.arange(self.dim)).any())
        self._flips = bool((sign < 0).any())

    def element(self, x: Tensor, g: int) -> Tensor:
        if self._moves:
            x = x.index_select(-1, self.index[g])
        return x * self._sign_like(x)[g] if self._flips else x

    def rows(self, x: Tensor, g: Tensor) -> Tensor:
        element = g.flatten()  # selecting whole rows is three times as fast as indexing by g
        if self._moves:
            x = x.gather(-1, self.index.index_select(0, element).view(x.shape))
        if self._flips:
            x = x * self._sign_like(x).index_select(0, element).view(x.shape)
        return x

    def orbit(self, x: Tensor) -> Tensor:
        return torch.stack([self.element(x, g) for g in range(len(self.index))])

    def _sign_like(self, x: Tensor) -> Tensor:
        if not x.dtype.is_signed:
            raise TypeError(f"expected signed numbers, got a {x.dtype} tensor: some entries change sign")
        return self.sign.to(x.dtype)

    def product_residual(self, table: Tensor) -> Tensor:
        """Largest entry of rho(g) rho(h) - rho(gh) for all pairs: ``(N, N)``; 0 or more than 1."""
        n, d = self.index.shape
        index = self.index[:, None].expand(n, n, d)  # rho(g) outermost
        product_index = self.index[None].expand(n, n, d).gather(-1, index)
        product_sign = self.sign[:, None] * self.sign[None].expand(n, n, d).gather(-1, index)
        wrong = (product_index != self.index[table]) | (product_sign != self.sign[table])
        return wrong.any(-1).double()

    def orthogonality_residual(self) -> Tensor:
        return (self.index.sort(dim=-1).values != torch.arange(self.dim)).any(-1).double()

    @property
    def matrices(self) -> Tensor:
        one_hot = nn.functional.one_hot(self.index, self.dim).double()
        return one_hot * self.sign.double()[..., None]

    def select(self, elements: Tensor) -> SignedPermutation:
        return SignedPermutation(self.index[elements], self.sign[elements])

    def absolute(self) -> SignedPermutation:
        return SignedPermutation(self.index, self.sign.abs())

    @staticmethod
    def join(blocks: list[SignedPermutation]) -> SignedPermutation:
        """Direct sum of many, at once: one by one takes the square of the time."""
        starts = itertools.accumulate(block.dim for block in blocks[:-1])
        index = [block.index + start for block, start in zip(blocks, [0, *starts], strict=True)]
        return SignedPermutation(torch.cat(index, dim=1), torch.cat([b.sign for b in blocks], dim=1))


class Dense(nn.Module):
    """N orthogonal matrices, ``(N, d, d)`` float64."""

    dense: Tensor

    def __init__(self, matrices: Tensor) -> None:
        super().__init__()
        self.register_buffer("dense", matrices.double(), persistent=False)
        self.dim = matrices.shape[-1]

    def element(self, x: Tensor, g: int) -> Tensor:
        return x @ _like(x, self.dense[g]).mT

    def rows(self, x: Tensor, g: Tensor) -> Tensor:
        return (_like(x, self.dense)[g] @ x.unsqueeze(-1)).squeeze(-1)

    def orbit(self, x: Tensor) -> Tensor:
        return torch.stack([self.element(x, g) for g in range(len(self.dense))])

    def product_residual(self, table: Tensor) -> Tensor:
        products = torch.einsum("gij,hjk->ghik", self.dense, self.dense)
        return (products - self.dense[table]).abs().amax(dim=(-2, -1))

    def orthogonality_residual(self) -> Tensor:
        eye = torch.eye(self.dim, dtype=torch.float64)
        return (self.dense @ self.dense.mT - eye).abs().amax(dim=(-2, -1))

    @property
    def matrices(self) -> Tensor:
        return self.dense.double()

    def select(self, elements: Tensor) -> Dense:
        return Dense(self.dense[elements])

    @staticmethod
    def join(blocks: list[Dense]) -> Dense:
        """Direct sum."""
        rows = zip(*(block.dense for block in blocks), strict=True)
        return Dense(torch.stack([torch.block_diag(*parts) for parts in rows]))


def _like(x: Tensor, matrices: Tensor) -> Tensor:
    if not x.dtype.is_floating_point:
        raise TypeError(f"expected real numbers, got a {x.dtype} tensor: some entries are mixed")
    return matrices.to(x.dtype)


Block = SignedPermutation | Dense


def block_from_matrices(matrices: Tensor) -> Block:
    """A signed permutation if every matrix is one (to 1e-9), a dense block otherwise."""
    matrices = torch.as_tensor(matrices, dtype=torch.float64)
    size = matrices.abs()
    is_binary = ((size < _TOLERANCE) | ((size - 1).abs() < _TOLERANCE)).all()
    if is_binary and (size.round().sum(dim=-1) == 1).all():
        index = size.argmax(dim=-1)
        return SignedPermutation(index, matrices.gather(-1, index[..., None])[..., 0].sign())
    return Dense(matrices)


def merge(blocks: list[Block]) -> list[Block]:
    """Join neighbouring blocks of one kind, so that a call does as few gathers as possible."""
    runs: list[list[Block]] = []
    size = 0  # of the last run
    for block in blocks:
        fits = isinstance(block, SignedPermutation) or size + block.dim <= _DENSE_LIMIT
        if runs and type(block) is type(runs[-1][0]) and fits:
            runs[-1].append(block)
            size += block.dim
        else:
            runs.append([block])
            size = block.dim
    # copies, so that moving one representation moves no other
    return [copy.deepcopy(run[0]) if len(run) == 1 else type(run[0]).join(run) for run in runs]  # pyright: ignore[reportArgumentType]
