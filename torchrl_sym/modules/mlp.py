"""Multi-layer perceptrons that commute with a group, or that it leaves alone.

Hidden units are regular representations: a multiple of N units, in which the group moves entries and does
nothing else, so that every pointwise nonlinearity commutes with it. Between two nonlinearities the units
are in isotypic coordinates, in which a layer is N times cheaper than a dense one; a change of basis of
size N leads there and back.
"""

from __future__ import annotations

import copy
import itertools
from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from torchrl_sym import checks
from torchrl_sym.modules.hidden import activation, hidden_layers
from torchrl_sym.modules.linear import (
    EquivariantLinear,
    check_representations,
    flat_rows,
    flatten,
    relaxation,
    unflatten,
)
from torchrl_sym.representations import Representation, invariant


class EquivariantMLP(nn.Module):
    """``f(rho_in(g) x) = rho_out(g) f(x)`` for every element g, exactly, whatever its parameters are.

    Args:
        in_rep: how the input transforms.
        out_rep: how the output does.
        num_cells: sizes of the hidden layers, multiples of the group's order.
        activation_class: the nonlinearity, of single entries.
        relaxed: add to each layer a free one that starts at zero: see :class:`EquivariantLinear`.
        device: where the parameters are made.
        dtype: their type.

    Shape:
        ``(*, *in_rep.event_shape)`` to ``(*, *out_rep.event_shape)``.

    Raises:
        TypeError: an argument of another type.
        ValueError: representations of two groups, a size that is no multiple, or a nonlinearity that looks
            at several entries.

    Example:
        >>> import torch
        >>> from torchrl_sym import PointGroup
        >>> from torchrl_sym.representations import axial, polar
        >>> from torchrl_sym.testing import assert_equivariant
        >>> group = PointGroup.klein_four()
        >>> policy = EquivariantMLP(polar(group) + axial(group), polar(group), num_cells=(64, 64))
        >>> assert_equivariant(policy, policy.in_rep, policy.out_rep)
    """

    def __init__(
        self,
        in_rep: Representation,
        out_rep: Representation,
        num_cells: Sequence[int] = (128, 128),
        activation_class: Callable[[], nn.Module] = nn.ELU,
        *,
        relaxed: bool = False,
        device: torch.device | str | None = None,
        dtype: torch.dtype | None = None,
    ) -> None:
        super().__init__()
        check_representations(in_rep, out_rep)
        hidden = hidden_layers("num_cells", num_cells, in_rep.group)
        reps = [in_rep.flatten(), *hidden, out_rep.flatten()]
        self.in_rep, self.out_rep = in_rep, out_rep
        made = {"device": device, "dtype": dtype}
        self.linears: Sequence[EquivariantLinear] = nn.ModuleList(  # pyright: ignore[reportAttributeAccessIssue]
            EquivariantLinear(source, target, relaxed=relaxed, **made)
            for source, target in itertools.pairwise(reps)
        )
        self.activations = nn.ModuleList(activation(activation_class).to(**made) for _ in hidden)

    def forward(self, x: Tensor) -> Tensor:
        batch, x = flat_rows(x, self.in_rep)
        y = self._relaxed(x) if self.linears[0].free_weight is not None else self._exact(x)
        return y.reshape(*batch, *self.out_rep.event_shape)

    def _exact(self, x: Tensor) -> Tensor:
        """Rows to rows, in isotypic coordinates except where the nonlinearities act."""
        first, *_, last = self.linears
        parts = first.source.split(x.T)
        for linear, act in zip(self.linears, self.activations, strict=False):
            units = act(linear.target.join(linear.between(parts)))
            parts = linear.target.split(units)
        return last.target.join(last.between(parts)).T

    def _relaxed(self, x: Tensor) -> Tensor:
        for linear, act in zip(self.linears, self.activations, strict=False):
            x = act(linear(x))
        return self.linears[-1](x)

    @torch.no_grad()
    def dense(self) -> nn.Sequential:
        """An ordinary network of ``nn.Linear`` and activations with equal outputs, for deployment.

        Example:
            >>> from torchrl_sym import PointGroup
            >>> from torchrl_sym.representations import pseudoscalar
            >>> sign = pseudoscalar(PointGroup.reflection("x"))
            >>> EquivariantMLP(sign * 3, sign, num_cells=(4,)).dense()
            Sequential(
              (0): Linear(in_features=3, out_features=4, bias=True)
              (1): ELU(alpha=1.0)
              (2): Linear(in_features=4, out_features=1, bias=True)
            )
        """
        layers = flatten(self.in_rep)
        for number, linear in enumerate(self.linears):
            layers += [*linear.dense(), *map(copy.deepcopy, self.activations[number : number + 1])]
        return nn.Sequential(*layers, *unflatten(self.out_rep))

    def relaxation(self) -> Tensor:
        """Sum of the squares of the free parts, to be added to a loss with a coefficient; 0 without any."""
        return relaxation(self)


class InvariantMLP(EquivariantMLP):
    """``f(rho_in(g) x) = f(x)`` for every element g: a critic.

    For Q(s, a), ``in_rep`` is the sum of the representations of state and action.

    Args:
        in_rep: how the input transforms.
        out_features: number of outputs.
        num_cells: as of :class:`EquivariantMLP`, like all that follow.
        activation_class: see there.
        relaxed: see there.
        device: see there.
        dtype: see there.

    Example:
        >>> import torch
        >>> from torchrl_sym import PointGroup
        >>> from torchrl_sym.representations import polar
        >>> from torchrl_sym.testing import assert_equivariant
        >>> value = InvariantMLP(polar(PointGroup.rotation(3)) * 2, num_cells=(12, 12))
        >>> assert_equivariant(value, value.in_rep)
    """

    def __init__(
        self,
        in_rep: Representation,
        out_features: int = 1,
        num_cells: Sequence[int] = (128, 128),
        activation_class: Callable[[], nn.Module] = nn.ELU,
        *,
        relaxed: bool = False,
        device: torch.device | str | None = None,
        dtype: torch.dtype | None = None,
    ) -> None:
        out_features = checks.whole("out_features", out_features, 1)
        out_rep = invariant(checks.instance("in_rep", in_rep, Representation).group, out_features)
        made = {"relaxed": relaxed, "device": device, "dtype": dtype}
        super().__init__(in_rep, out_rep, num_cells, activation_class, **made)
