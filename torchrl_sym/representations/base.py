"""Representations: how each group element acts on the last dimensions of a tensor, one *event*.

A representation assigns to every element g an orthogonal matrix rho(g) such that rho(g) rho(h) =
rho(g h). It is the L_g of an observation and the K_g of an action in the paper. A robot's observation
is a direct sum of small ones, written in the order of its entries:

    polar(group) + axial(group) + joints * 3     # linear velocity, angular velocity, 3 frames of joints

Such an event has one dimension. Agents, tokens, images and forces on many bodies have several, in which
whole items change places; :func:`~torchrl_sym.representations.items` builds them.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence

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
    """Orthogonal action of a :class:`~torchrl_sym.PointGroup` on events of shape ``event_shape``.

    Representations are immutable: ``+`` (direct sum), ``*`` (repetition, as for stacked frames),
    :meth:`restrict`, :meth:`absolute`, :meth:`flatten` and the like return new ones. They have neither
    parameters nor buffers: they work on the device and in the dtype of what they are given, exactly,
    whatever the module that they are part of is cast to.

    Args:
        group: the group that acts.
        matrices: one orthogonal matrix per element in the group's order, ``(N, d, d)``; events are vectors
            of size d.

    Attributes:
        event_shape: sizes of the last dimensions of a tensor that it acts on.
        dim: number of entries of an event, the product of ``event_shape``.

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
        block = block_from_matrices(matrices)
        _check(group, block)
        self._initialize(group, [block])

    def _initialize(
        self, group: PointGroup, blocks: Sequence[Block], event_shape: tuple[int, ...] | None = None
    ) -> None:
        super().__init__()
        self.group = group
        self._blocks = merge(blocks)
        self._sizes = [block.dim for block in self._blocks]
        self.dim: int = sum(self._sizes)
        self.event_shape: tuple[int, ...] = (self.dim,) if event_shape is None else event_shape

    @classmethod
    def from_blocks(
        cls,
        group: PointGroup,
        blocks: Sequence[Block],
        *,
        event_shape: tuple[int, ...] | None = None,
        check: bool = True,
    ) -> Representation:
        """Direct sum of ready blocks; ``check=False`` only for blocks that were checked before."""
        for block in blocks if check else ():
            _check(group, block)
        self = cls.__new__(cls)
        self._initialize(group, blocks, event_shape)
        return self

    def forward(self, x: Tensor, g: int | str | Tensor) -> Tensor:
        """Apply one element, or one element per row. The identity gives a copy, bit for bit.

        Args:
            x: ``(..., *event_shape)``.
            g: an element by index or name, or a tensor of indices whose shape is that of the leading
                dimensions of ``x``.

        Returns:
            ``rho(g) x``, of the shape and dtype of ``x``.
        """
        self._check_size(x)
        if isinstance(g, Tensor):
            self._check_elements(g, x)
            return self.per_row(x, g)
        g = self.group.index(g)
        return self._over_blocks(x, lambda block, part: block.element(part, g))

    def per_row(self, x: Tensor, g: Tensor) -> Tensor:
        """:meth:`forward` with a tensor of indices, unchecked: for those who drew them."""
        g = g.reshape(g.shape + (1,) * (x.ndim - len(self.event_shape) - g.ndim))
        g = g.expand(x.shape[: x.ndim - len(self.event_shape)])
        return self._over_blocks(x, lambda block, part: block.rows(part, g))

    def orbit(self, x: Tensor) -> Tensor:
        """All images, the original first: ``(..., *event_shape)`` to ``(N, ..., *event_shape)``."""
        self._check_size(x)
        return self._over_blocks(x, lambda block, part: block.orbit(part))

    def _over_blocks(self, x: Tensor, act: Callable[[Block, Tensor], Tensor]) -> Tensor:
        flat = x
        if len(self.event_shape) != 1:
            flat = x.reshape(*x.shape[: x.ndim - len(self.event_shape)], self.dim)

        if len(self._blocks) == 1:
            out = act(self._blocks[0], flat)
            out = out.clone() if out is flat else out  # always a new tensor
        else:
            parts = flat.split(self._sizes, dim=-1)
            out = torch.cat([act(b, p) for b, p in zip(self._blocks, parts, strict=True)], dim=-1)

        return out if flat is x else out.reshape(*out.shape[:-1], *self.event_shape)

    def fits(self, shape: Sequence[int]) -> bool:
        """Whether the last dimensions of a shape are those of an event."""
        dims = len(self.event_shape)
        return len(shape) >= dims and tuple(shape[len(shape) - dims :]) == self.event_shape

    @property
    def wanted(self) -> str:
        """What tensors must have, for messages: "a last dimension of 3"."""
        if len(self.event_shape) == 1:
            return f"a last dimension of {self.dim}"
        return f"last dimensions of {self.event_shape}"

    def _check_size(self, x: Tensor) -> None:
        if not isinstance(x, Tensor):
            raise TypeError(f"expected a tensor, got {checks.shown(x)}; use torch.as_tensor")
        if not self.fits(x.shape):
            raise ValueError(
                f"expected {self.wanted}, got a tensor of shape {tuple(x.shape)}; "
                "the representation must list every entry of the tensor in order"
            )

    def _check_elements(self, g: Tensor, x: Tensor) -> None:
        if (
            g.is_floating_point()
            or g.is_complex()
            or g.dtype == torch.bool
            or g.shape != x.shape[: g.ndim]
            or g.ndim > x.ndim - len(self.event_shape)
        ):
            raise ValueError(
                f"expected indices of elements of a shape that {tuple(x.shape)} begins with, got {g.dtype} "
                f"of shape {tuple(g.shape)}"
            )
        # values are looked at where that costs nothing: not on a GPU, nor in a graph that is being traced
        if type(g) is Tensor and g.device.type == "cpu" and not torch.compiler.is_compiling() and g.numel():
            try:
                low, high = (int(end) for end in g.aminmax())
            except RuntimeError:  # nor under vmap
                return
            if low < 0 or high >= self.group.order:
                raise KeyError(f"expected element indices in [0, {self.group.order}), got {low} to {high}")

    def __add__(self, other: Representation) -> Representation:
        if not isinstance(other, Representation):
            return NotImplemented
        if other.group != self.group:
            raise ValueError(
                f"expected representations of one group, got {self.group} and {other.group}; "
                "use restrict() to bring both to a common subgroup"
            )
        blocks = [*self._vector("+"), *other._vector("+")]
        return Representation.from_blocks(self.group, blocks, check=False)

    def __mul__(self, times: int) -> Representation:
        times = checks.whole("number of repetitions", times, 1, MAX_DIM // max(self.dim, 1))
        return Representation.from_blocks(self.group, self._vector("*") * times, check=False)

    __rmul__ = __mul__

    def _vector(self, operator: str) -> list[Block]:
        """The blocks, if events are vectors."""
        if len(self.event_shape) != 1:
            raise ValueError(
                f"expected events of one dimension for {operator!r}, got {self.event_shape}; use flatten()"
            )
        return self._blocks

    @property
    def blocks(self) -> list[Block]:
        """The blocks of the direct sum, merged with their neighbours where they are alike."""
        return list(self._blocks)

    @property
    def matrices(self) -> Tensor:
        """The matrices rho(g) on the flattened event, ``(N, dim, dim)`` float64; for small events."""
        per_block = [block.matrices for block in self._blocks]
        rows = [torch.block_diag(*parts) for parts in zip(*per_block, strict=True)]
        return torch.stack(rows)

    @property
    def is_signed_permutation(self) -> bool:
        """Whether every element only moves entries and flips signs."""
        return all(isinstance(block, SignedPermutation) for block in self._blocks)

    @property
    def is_trivial(self) -> bool:
        """Whether every element leaves every entry as it is."""
        return all(block.is_trivial for block in self._blocks)

    @property
    def components(self) -> Tensor:
        """A label per entry of the flattened event, ``(dim,)`` int64 on the CPU.

        Entries that some element exchanges or mixes share one; labels are counted by first entries.
        """
        starts = self._starts()
        label = torch.cat([b.components() + start for b, start in zip(self._blocks, starts, strict=True)])
        return label.unique(return_inverse=True)[1]

    def image_of_box(self, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
        """Bounds of the images of a box under every element; 0 * inf counts as 0.

        Args:
            low: lower bounds, ``event_shape``, on the CPU.
            high: upper bounds.

        Returns:
            Lower and upper bounds, ``(N, *event_shape)`` float64.
        """
        ends = [bound.double().reshape(-1).split(self._sizes) for bound in (low, high)]
        images = [block.image_of_box(*box) for block, *box in zip(self._blocks, *ends, strict=True)]
        lows, highs = (torch.cat(parts, -1) for parts in zip(*images, strict=True))
        shape = (self.group.order, *self.event_shape)
        return lows.reshape(shape), highs.reshape(shape)

    def flatten(self) -> Representation:
        """The same action on the flattened event, ``(dim,)``."""
        return Representation.from_blocks(self.group, self._blocks, check=False)

    def unflatten(self, shape: Sequence[int]) -> Representation:
        """The same action on events of another shape with as many entries.

        Raises:
            ValueError: the sizes do not multiply to ``dim``.

        Example:
            >>> from torchrl_sym import PointGroup
            >>> from torchrl_sym.representations import polar
            >>> (polar(PointGroup.reflection("y")) * 4).unflatten((4, 3)).event_shape
            (4, 3)
        """
        sizes = tuple(checks.whole("shape", size, 0) for size in checks.sequence("shape", shape, "sizes"))
        if math.prod(sizes) != self.dim:
            raise ValueError(f"shape: expected sizes that multiply to {self.dim}, got {sizes}")
        return Representation.from_blocks(self.group, self._blocks, event_shape=sizes, check=False)

    def leading(self, k: int) -> Representation:
        """How the items of the first ``k`` event dimensions change places, without signs.

        Raises:
            ValueError: an element takes items apart, so that what belongs to one, such as its
                log-probability, has no place to go.

        Example:
            >>> from torchrl_sym import PointGroup
            >>> from torchrl_sym.representations import items, permutation, polar
            >>> group = PointGroup.reflection("y")
            >>> hands = permutation(group, ["l", "r"], {"reflect-y": {"l": "r", "r": "l"}})
            >>> items(hands, polar(group)).leading(1)(torch.tensor([1, 2]), "reflect-y")
            tensor([2, 1])
        """
        k = checks.whole("k", k, 1, len(self.event_shape))
        if k == len(self.event_shape):
            return self.absolute()

        shape, size = self.event_shape[:k], math.prod(self.event_shape[k:])
        ends = [torch.cat(parts, 1) for parts in zip(*self._sources(), strict=True)]  # first, last source
        first, last = (end.div(size, rounding_mode="floor").unflatten(1, (-1, size)) for end in ends)
        torn = (first.amin(-1) != last.amax(-1)).nonzero()
        if len(torn):
            name = self.group.names[int(torn[0, 0])]
            raise ValueError(
                f"expected whole items of the first {k} of the event dimensions {self.event_shape}, but "
                f"{name!r} takes item {int(torn[0, 1])} from several"
            )
        index = first[..., 0]
        block = SignedPermutation(index, torch.ones_like(index))
        return Representation.from_blocks(self.group, [block], event_shape=shape, check=False)

    def _sources(self) -> list[tuple[Tensor, Tensor]]:
        """First and last entry that each entry's image is made of, per block: ``(N, size)``."""
        indices = [
            block.terms[0] + start for block, start in zip(self._blocks, self._starts(), strict=True)
        ]
        return [(index.amin(-1), index.amax(-1)) for index in indices]

    def _starts(self) -> list[int]:
        return [0, *itertools.accumulate(self._sizes[:-1])]

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
        blocks = [block.select(elements) for block in self._blocks]
        return Representation.from_blocks(subgroup, blocks, event_shape=self.event_shape, check=False)

    def absolute(self) -> Representation:
        """Permutation without signs: how standard deviations, gains and limits transform.

        Raises:
            ValueError: a dense block mixes entries, so that no diagonal scale is carried to another.
        """
        blocks = []
        for block in self._blocks:
            if not isinstance(block, SignedPermutation):
                raise ValueError(
                    f"expected a signed permutation, got a dense block of size {block.dim}, which "
                    "mixes its entries; use one shared scale for them, invariant(group, d)"
                )
            blocks.append(block.absolute())
        return Representation.from_blocks(self.group, blocks, event_shape=self.event_shape, check=False)

    def __repr__(self) -> str:
        kind = "signed permutation" if self.is_signed_permutation else "orthogonal"
        shape = "" if len(self.event_shape) == 1 else f"event_shape={self.event_shape}, "
        return f"Representation(dim={self.dim}, {shape}{kind}, {self.group!r})"


def _check(group: PointGroup, block: Block) -> None:
    residual = block.orthogonality_residual()
    if not (residual <= _TOLERANCE).all():  # NaN fails too
        name = group.names[int(residual.argmax())]
        raise ValueError(
            f"expected an orthogonal matrix for {name!r}, got a residual of "
            f"{residual.max():.2g}; scale and bias belong outside the representation"
        )
    residual = block.product_residual(group.table)
    if not (residual <= _TOLERANCE).all():
        g, h = divmod(int(residual.argmax()), group.order)
        names = group.names
        raise ValueError(
            f"not a representation: rho({names[g]}) rho({names[h]}) differs from "
            f"rho({names[int(group.table[g, h])]}) by {residual.max():.2g}; "
            "check the permutation and signs of these elements"
        )
