"""A linear layer that commutes with a group.

W from rho_in to rho_out is equivariant if ``rho_out(g) W = W rho_in(g)`` for every g. In isotypic
coordinates such a W is one matrix for each irreducible representation, from the copies in the input to
those in the output (see :mod:`~torchrl_sym.modules.coordinates`). These matrices are the parameters: every
one of them is free, together they are all equivariant maps, and of two regular representations they are N
times fewer than a dense layer's, with N times fewer multiplications.
"""

from __future__ import annotations

import copy
import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from torchrl_sym import checks
from torchrl_sym.modules.coordinates import Coordinates
from torchrl_sym.representations import Representation
from torchrl_sym.representations.constants import Constants


class EquivariantLinear(nn.Module):
    """``y = W x + b`` with ``rho_out(g) y = W rho_in(g) x + b`` for every element g.

    The parameters are the numbers that are free. ``weight`` holds one matrix per irreducible representation
    that both sides have, ``bias`` one number per direction of the output that the group leaves alone. They
    are drawn from the bounds of ``nn.Linear``, ``1 / sqrt(in_rep.dim)``, and in units in which outputs have
    at initialisation the variance of its outputs, and an optimizer's step the size of its steps.

    Args:
        in_rep: how the input transforms.
        out_rep: how the output does.
        bias: whether to learn an additive bias.
        relaxed: add a free dense layer that starts at zero, for a task that is not exactly symmetric
            (residual pathway prior, Finzi et al. 2021). :meth:`relaxation` keeps it small.
        device: where the parameters are made.
        dtype: their type.

    Shape:
        ``(*, *in_rep.event_shape)`` to ``(*, *out_rep.event_shape)``.

    Raises:
        TypeError: an argument of another type.
        ValueError: representations of two groups, or none of whose maps but zero commutes with the group.

    Example:
        >>> import torch
        >>> from torchrl_sym import PointGroup
        >>> from torchrl_sym.representations import polar, regular
        >>> from torchrl_sym.testing import assert_equivariant
        >>> group = PointGroup.dihedral(3)
        >>> layer = EquivariantLinear(polar(group) * 2, regular(group, 4))
        >>> assert_equivariant(layer, layer.in_rep, layer.out_rep)
        >>> layer.weight.numel(), layer.in_rep.dim * layer.out_rep.dim
        (24, 144)
    """

    def __init__(
        self,
        in_rep: Representation,
        out_rep: Representation,
        bias: bool = True,
        *,
        relaxed: bool = False,
        device: torch.device | str | None = None,
        dtype: torch.dtype | None = None,
    ) -> None:
        super().__init__()
        check_representations(in_rep, out_rep)
        self.in_rep, self.out_rep = in_rep, out_rep
        self.source, self.target = Coordinates(in_rep), Coordinates(out_rep)
        self._bias_units = Constants(1 / self.target.invariant_directions().abs().amax(0))
        self._shapes = self._matrix_shapes()
        count = sum(math.prod(shape) for shapes in self._shapes for shape in shapes)
        if count == 0:
            raise ValueError(
                f"expected representations that share an irreducible one, got {in_rep} and {out_rep}: only "
                "zero commutes with the group; put a regular representation between them, as "
                "EquivariantMLP does"
            )

        made = {"device": device, "dtype": dtype}
        self.weight = nn.Parameter(torch.empty(count, **made))
        free = torch.empty(self.target.multiplicity[0], **made) if checks.flag("bias", bias) else None
        self.bias = None if free is None else nn.Parameter(free)
        self.free_weight = self.free_bias = None
        if checks.flag("relaxed", relaxed):
            self.free_weight = nn.Parameter(torch.empty(out_rep.dim, in_rep.dim, **made))
            self.free_bias = None if free is None else nn.Parameter(torch.empty(out_rep.dim, **made))
        self.reset_parameters()

    def _matrix_shapes(self) -> list[list[tuple[int, int, int]]]:
        """Of the matrix of each irreducible representation, by kind: real and imaginary, rows, columns."""
        return [
            [
                (1 + kind.is_complex, self.target.multiplicity[i], self.source.multiplicity[i])
                for i in kind.members
            ]
            for kind in self.source.kinds
        ]

    @torch.no_grad()
    def reset_parameters(self) -> None:
        """Draw the parameters anew; those of the free part become zero."""
        bound = 1.0 / math.sqrt(self.in_rep.dim)
        self.weight.uniform_(-bound, bound)
        if self.bias is not None:
            self.bias.uniform_(-bound, bound)
        for free in (self.free_weight, self.free_bias):
            if free is not None:
                free.zero_()

    def forward(self, x: Tensor) -> Tensor:
        batch, x = flat_rows(x, self.in_rep)
        if self.free_weight is None:
            y = self.target.join(self.between(self.source.split(x.T))).T
        else:
            y = functional.linear(x, *self.dense_parameters())
        return y.reshape(*batch, *self.out_rep.event_shape)

    def between(self, parts: list[Tensor], bias: bool = True) -> list[Tensor]:
        """The exact part of the layer from isotypic coordinates to isotypic coordinates.

        Args:
            parts: as :meth:`~torchrl_sym.modules.coordinates.Coordinates.split` gives them.
            bias: whether to add the bias.
        """
        values = self._invariant() if bias else None
        shift = None if values is None else self.target.identity_part(values).squeeze(1)
        found = []
        every = zip(self.source.kinds, parts, self._matrices(), self.target.copies, strict=True)
        for kind, part, weight, rows in every:
            members, dim, copies, batch = part.shape
            if kind.is_complex:
                part, dim = part.reshape(members, 1, dim * copies, batch), 1
            weight = weight[:, None].expand(-1, dim, -1, -1).flatten(0, 1)
            part = part.flatten(0, 1)
            if shift is not None and not found:  # the identity's is in the first kind
                mapped = torch.baddbmm(shift, weight, part)
            else:
                mapped = weight @ part
            found.append(mapped.reshape(members, kind.dim, rows, batch))
        return found

    def _matrices(self) -> list[Tensor]:
        """Per kind, one matrix for each member, ``(members, rows, columns)``; what fills up counts 0."""
        sizes = [sum(math.prod(shape) for shape in shapes) for shapes in self._shapes]
        flat = [self.weight] if len(sizes) == 1 else self.weight.split(sizes)
        every = zip(flat, self._shapes, self.target.copies, self.source.copies, strict=True)
        return [self._matrices_of(*each) for each in every]

    def _matrices_of(
        self, flat: Tensor, shapes: list[tuple[int, int, int]], rows: int, columns: int
    ) -> Tensor:
        numbers = shapes[0][0]
        if all(shape == (numbers, rows, columns) for shape in shapes):
            matrices = flat.reshape(len(shapes) * numbers, rows, columns) * self._unit(shapes[0])
        else:
            parts = flat.split([math.prod(shape) for shape in shapes])
            filled = [
                functional.pad(
                    part.reshape(shape) * self._unit(shape), (0, columns - shape[2], 0, rows - shape[1])
                )
                for part, shape in zip(parts, shapes, strict=True)
            ]
            matrices = torch.cat(filled)
        if numbers == 1:
            return matrices
        a, b = matrices.reshape(len(shapes), 2, rows, columns).unbind(1)  # a + b J, which commutes with J
        return torch.cat([torch.cat([a, -b], 2), torch.cat([b, a], 2)], 1)

    def _unit(self, shape: tuple[int, int, int]) -> float:
        """What a parameter of a matrix counts: with that of nn.Linear, outputs vary as its outputs do."""
        return math.sqrt(self.in_rep.dim / max(shape[0] * shape[2], 1))

    def _invariant(self) -> Tensor | None:
        """The bias in coordinates, ``(multiplicity[0], 1)``."""
        if self.bias is None:
            return None
        (units,) = self._bias_units.on(self.bias.device)
        return (self.bias * units.to(self.bias.dtype))[:, None]

    def dense_parameters(self) -> tuple[Tensor, Tensor | None]:
        """Weight and bias of the dense layer with the same outputs, as functions of the parameters."""
        eye = torch.eye(self.in_rep.dim, dtype=self.weight.dtype, device=self.weight.device)
        weight = self.target.join(self.between(self.source.split(eye), bias=False))
        values = self._invariant()
        bias = None if values is None else self.target.invariant(values)[:, 0]
        if self.free_weight is not None:
            weight = weight + self.free_weight
            bias = None if bias is None or self.free_bias is None else bias + self.free_bias
        return weight, bias

    @torch.no_grad()
    def dense(self) -> nn.Sequential:
        """An ordinary network with equal outputs, for where this package is not installed.

        Its weights are computed in float64 and rounded once.

        Example:
            >>> import torch
            >>> from torchrl_sym import PointGroup
            >>> from torchrl_sym.representations import polar
            >>> vector = polar(PointGroup.rotation(3))
            >>> EquivariantLinear(vector, vector).dense()
            Sequential(
              (0): Linear(in_features=3, out_features=3, bias=True)
            )
        """
        weight, bias = copy.deepcopy(self).double().dense_parameters()
        made = {"device": self.weight.device, "dtype": self.weight.dtype}
        layer = nn.Linear(self.in_rep.dim, self.out_rep.dim, bias is not None, **made)
        layer.weight.copy_(weight)
        if bias is not None:
            layer.bias.copy_(bias)
        return nn.Sequential(*flatten(self.in_rep), layer, *unflatten(self.out_rep))

    def relaxation(self) -> Tensor:
        """Sum of the squares of the free part, to be added to a loss with a coefficient; 0 without one."""
        return relaxation(self)

    def extra_repr(self) -> str:
        relaxed = ", relaxed" if self.free_weight is not None else ""
        return f"{self.in_rep.dim} to {self.out_rep.dim}, {self.weight.numel()} free numbers{relaxed}"


def relaxation(module: nn.Module) -> Tensor:
    """Sum of the squares of the free parts of all layers inside; 0 without any."""
    free = [
        parameter.square().sum()
        for name, parameter in module.named_parameters()
        if name.rpartition(".")[2] in ("free_weight", "free_bias")
    ]
    return torch.stack(free).sum() if free else next(module.parameters()).new_zeros(())


def check_representations(in_rep: Representation, out_rep: Representation) -> None:
    """TypeError unless both are representations, ValueError unless of one group."""
    checks.instance("in_rep", in_rep, Representation)
    if checks.instance("out_rep", out_rep, Representation).group != in_rep.group:
        raise ValueError(
            f"expected representations of one group, got {in_rep.group} and {out_rep.group}; use "
            "restrict() to bring both to a common subgroup"
        )


def flat_rows(x: Tensor, representation: Representation) -> tuple[torch.Size, Tensor]:
    """The shape of the batch, and its events as rows ``(B, dim)``."""
    if not isinstance(x, Tensor):
        raise TypeError(f"expected a tensor, got {checks.shown(x)}; use torch.as_tensor")
    if not representation.fits(x.shape):
        raise ValueError(f"expected {representation.wanted}, got a tensor of shape {tuple(x.shape)}")
    batch = x.shape[: x.ndim - len(representation.event_shape)]
    return batch, x.reshape(-1, representation.dim)


def flatten(representation: Representation) -> list[nn.Module]:
    """What makes vectors of events; nothing if they are."""
    dims = len(representation.event_shape)
    return [] if dims == 1 else [nn.Flatten(-dims, -1)]


def unflatten(representation: Representation) -> list[nn.Module]:
    """What makes events of vectors; nothing if they are."""
    shape = representation.event_shape
    return [] if len(shape) == 1 else [nn.Unflatten(-1, shape)]
