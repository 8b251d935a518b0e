"""Representations: how each group element acts on the last dimension of a tensor.

A representation assigns to every element g an orthogonal matrix rho(g) such that rho(g) rho(h) =
rho(g h). It is the L_g of an observation and the K_g of an action in the paper. A robot's observation
is a direct sum of small ones, written in the order of its entries:

    polar(group) + axial(group) + joints * 3     # linear velocity, angular velocity, 3 frames of joints
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from torchrl_sym import checks
from torchrl_sym.groups import PointGroup, check_group
from torchrl_sym.representations.blocks import (
    Block,
    SignedPermutation,
    block_from_matrices,
    merge,
)

_TOLERANCE = 1e-9
MAX_DIM = 1_000_000  # far above any observation; more is a slip that would fill the memory


class Representation(nn.Module):
    """Orthogonal action of a :class:`~torchrl_sym.PointGroup` on vectors of size ``dim``.

    Representations are immutable: ``+`` (direct sum), ``*`` (repetition, as for stacked frames),
    :meth:`restrict` and :meth:`absolute` return new ones.

    Args:
        group: the group that acts.
        matrices: one orthogonal matrix per element in the group's order, ``(N, d, d)``. Stored as index
            and sign when all of them are signed permutations.

    Raises:
        ValueError: wrong shape, a matrix that is not orthogonal, or a product that does not match the
            group's table; the message names the elements at fault.
        TypeError: no group, or no numbers.

    Example:
        >>> import torch
        >>> from torchrl_sym import PointGroup
        >>> from torchrl_sym.representations import axial, polar
        >>> velocity = polar(PointGroup.reflection("y")) + axial(PointGroup.reflection("y"))
        >>> velocity(torch.tensor([1.0, 2, 3, 4, 5, 6]), "reflect-y")
        tensor([ 1., -2.,  3., -4.,  5., -6.])
        >>> velocity.orbit(torch.ones(8, 6)).shape
        torch.Size([2, 8, 6])
    """

    def __init__(self, group: PointGroup, matrices: Tensor) -> None:
        n = check_group(group).order
        matrices = checks.array("matrices", matrices, finite=False)
        if matrices.ndim != 3 or matrices.shape[0] != n or matrices.shape[1] != matrices.shape[2]:
            raise ValueError(
                f"expected one square matrix per element, ({n}, d, d), got {tuple(matrices.shape)}"
            )
        self._initialize(group, [block_from_matrices(matrices)])
        self._check()

    def _initialize(self, group: PointGroup, blocks: list[Block]) -> None:
        super().__init__()
        self.group = group
        merged = merge(blocks)
        self._blocks = nn.ModuleList(merged)  # registered, so that they follow to(device)
        self._sizes = [block.dim for block in merged]
        self.dim: int = sum(self._sizes)

    @classmethod
    def from_blocks(
        cls, group: PointGroup, blocks: Sequence[Block], *, check: bool = True
    ) -> Representation:
        """Direct sum of ready blocks; ``check=False`` only for blocks that were checked before."""
        self = cls.__new__(cls)
        self._initialize(group, list(blocks))
        if check:
            self._check()
        return self

    def _check(self) -> None:
        for block in self.blocks:
            residual = block.orthogonality_residual()
            if not (residual <= _TOLERANCE).all():  # NaN fails too
                name = self.group.names[int(residual.argmax())]
                raise ValueError(
                    f"expected an orthogonal matrix for {name!r}, got a residual of "
                    f"{residual.max():.2g}; scale and bias belong outside the representation"
                )
            residual = block.product_residual(self.group.table)
            if not (residual <= _TOLERANCE).all():
                g, h = divmod(int(residual.argmax()), self.group.order)
                names = self.group.names
                raise ValueError(
                    f"not a representation: rho({names[g]}) rho({names[h]}) differs from "
                    f"rho({names[int(self.group.table[g, h])]}) by {residual.max():.2g}; "
                    "check the permutation and signs of these elements"
                )

    def forward(self, x: Tensor, g: int | str | Tensor) -> Tensor:
        """Apply one element, or one element per row.

        Args:
            x: ``(..., d)``.
            g: an element by index or name, or a tensor of indices whose shape is that of the leading
                dimensions of ``x``.

        Returns:
            ``rho(g) x``, of the shape and dtype of ``x``.
        """
        self._check_size(x)
        if isinstance(g, Tensor):
            self._check_elements(g, x)
            g = g.reshape(g.shape + (1,) * (x.ndim - 1 - g.ndim)).expand(x.shape[:-1])
            return self._over_blocks(x, lambda block, part: block.rows(part, g))
        g = self.group.index(g)
        return self._over_blocks(x, lambda block, part: block.element(part, g))

    def orbit(self, x: Tensor) -> Tensor:
        """All images of ``x``: ``(..., d)`` to ``(N, ..., d)``, the original first."""
        self._check_size(x)
        return self._over_blocks(x, lambda block, part: block.orbit(part))

    def _over_blocks(self, x: Tensor, act) -> Tensor:
        if len(self.blocks) == 1:
            return act(self.blocks[0], x)
        parts = x.split(self._sizes, dim=-1)
        return torch.cat([act(b, p) for b, p in zip(self.blocks, parts, strict=True)], dim=-1)

    def _check_size(self, x: Tensor) -> None:
        if not isinstance(x, Tensor):
            raise TypeError(f"expected a tensor, got {checks.shown(x)}; use torch.as_tensor")
        if x.ndim == 0 or x.shape[-1] != self.dim:
            raise ValueError(
                f"expected a last dimension of {self.dim}, got a tensor of shape {tuple(x.shape)}; "
                "the representation must list every entry of the tensor in order"
            )

    def _check_elements(self, g: Tensor, x: Tensor) -> None:
        if (
            g.is_floating_point()
            or g.dtype == torch.bool
            or g.shape != x.shape[: g.ndim]
            or g.ndim >= x.ndim
        ):
            raise ValueError(
                f"expected indices of elements of a shape that {tuple(x.shape)} begins with, got {g.dtype} "
                f"of shape {tuple(g.shape)}"
            )
        if not torch.compiler.is_compiling() and g.numel():
            low, high = g.aminmax()
            if low < 0 or high >= self.group.order:
                raise KeyError(
                    f"expected element indices in [0, {self.group.order}), got {int(low)} to {int(high)}"
                )

    def __add__(self, other: Representation) -> Representation:
        if not isinstance(other, Representation):
            return NotImplemented
        if other.group != self.group:
            raise ValueError(
                f"expected representations of one group, got {self.group} and {other.group}; "
                "use restrict() to bring both to a common subgroup"
            )
        blocks = [*self.blocks, *other.blocks]
        return Representation.from_blocks(self.group, blocks, check=False)

    def __mul__(self, times: int) -> Representation:
        times = checks.whole("number of repetitions", times, 1, MAX_DIM // max(self.dim, 1))
        blocks = self.blocks * times
        return Representation.from_blocks(self.group, blocks, check=False)

    __rmul__ = __mul__

    @property
    def blocks(self) -> list[Block]:
        """The blocks of the direct sum, signed permutations merged with their neighbours."""
        return list(self._blocks)  # pyright: ignore[reportReturnType]

    @property
    def matrices(self) -> Tensor:
        """The matrices rho(g), ``(N, d, d)`` float64."""
        per_block = [block.matrices for block in self.blocks]
        rows = [torch.block_diag(*parts) for parts in zip(*per_block, strict=True)]
        return torch.stack(rows)

    @property
    def is_signed_permutation(self) -> bool:
        """Whether every element only moves entries and flips signs."""
        return all(isinstance(block, SignedPermutation) for block in self.blocks)

    def restrict(self, subgroup: PointGroup) -> Representation:
        """The same action, of a subgroup only.

        Raises:
            ValueError: ``subgroup`` has an element that the group lacks.
        """
        check_group(subgroup)
        distance = (subgroup.matrices[:, None] - self.group.matrices).abs().amax(dim=(-2, -1))
        residual, elements = distance.min(dim=1)
        if (residual > _TOLERANCE).any():
            missing = subgroup.names[int(residual.argmax())]
            raise ValueError(
                f"expected a subgroup of {self.group}, but {missing!r} is not one of its elements"
            )
        blocks = [block.select(elements) for block in self.blocks]
        return Representation.from_blocks(subgroup, blocks, check=False)

    def absolute(self) -> Representation:
        """Permutation without signs: how standard deviations, gains and limits transform.

        Raises:
            ValueError: a dense block mixes entries, so that no diagonal scale is carried to another.
        """
        blocks = []
        for block in self.blocks:
            if not isinstance(block, SignedPermutation):
                raise ValueError(
                    f"expected a signed permutation, got a dense block of size {block.dim}, which "
                    "mixes its entries; use one shared scale for them, invariant(group, d)"
                )
            blocks.append(block.absolute())
        return Representation.from_blocks(self.group, blocks, check=False)

    def __repr__(self) -> str:
        kind = "signed permutation" if self.is_signed_permutation else "orthogonal"
        return f"Representation(dim={self.dim}, {kind}, {self.group!r})"
