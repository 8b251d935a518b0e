"""A symmetric initialisation: an ordinary network that is equivariant until it is trained.

The mean of ``rho_out(g) W rho_in(g)^-1`` over the group is the equivariant map that is nearest to W. Done
once to every layer, with hidden units taken as regular representations, it makes a network exactly
equivariant that is an ordinary one in every other way. Gradients of asymmetric data make it asymmetric
again, where those of augmented data do not.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TypeVar

import torch
from torch import Tensor, nn
from torchrl.modules import MLP

from torchrl_sym import checks
from torchrl_sym.modules.hidden import hidden_units, require_pointwise
from torchrl_sym.modules.linear import check_representations
from torchrl_sym.representations import Representation

M = TypeVar("M", bound=nn.Module)
_NOTHING = 1e-6  # of the norm: what rounding leaves of a projection that is zero


@torch.no_grad()
def symmetrize_(module: M, in_rep: Representation, out_rep: Representation) -> M:
    """Make an ordinary network equivariant once, in place.

    Each weight and bias is projected on those that commute with the group, and then scaled to the norm it
    had, unless nothing is left of it (a bias of outputs that change sign).

    Args:
        module: an ``nn.Linear``, or an ``nn.Sequential`` (as TorchRL's ``MLP`` is) of them and pointwise
            nonlinearities. Sizes of hidden layers are multiples of the group's order.
        in_rep: how its input transforms.
        out_rep: how its output does.

    Returns:
        The module.

    Raises:
        TypeError: other modules, or an argument of another type.
        ValueError: sizes that do not fit, layers that are no sequence or not made yet, or a layer of which
            nothing would be left.

    Example:
        >>> from torch import nn
        >>> from torchrl_sym import PointGroup
        >>> from torchrl_sym.representations import polar
        >>> from torchrl_sym.testing import assert_equivariant
        >>> vector = polar(PointGroup.dihedral(3))
        >>> network = nn.Sequential(nn.Linear(3, 12), nn.Tanh(), nn.Linear(12, 3))
        >>> assert_equivariant(symmetrize_(network, vector, vector), vector, vector)
    """
    check_representations(in_rep, out_rep)
    linears = [*_linears(checks.instance("module", module, nn.Module))]
    if not linears or len({id(linear.weight) for linear in linears}) < len(linears):
        raise ValueError(
            f"module: expected nn.Linear layers, each with a weight of its own, got {len(linears)} of them "
            f"in {type(module).__name__}"
        )
    group = in_rep.group
    hidden = [hidden_units("module's hidden layers", each.out_features, group) for each in linears[:-1]]
    reps = [in_rep.flatten(), *hidden, out_rep.flatten()]
    sizes = [linears[0].in_features, *(linear.out_features for linear in linears)]
    wanted = [rep.dim for rep in reps]
    if sizes != wanted or sizes[:-1] != [linear.in_features for linear in linears]:
        raise ValueError(
            f"module: expected layers of the sizes {wanted}, first and last as of the representations, got "
            f"{linears}"
        )

    found = [_projected(*each) for each in zip(linears, reps[:-1], reps[1:], strict=True)]
    for linear, (weight, bias) in zip(linears, found, strict=True):  # all of them, or none
        linear.weight.copy_(weight)
        if bias is not None:
            linear.bias.copy_(bias)
    return module


def _linears(module: nn.Module) -> Iterator[nn.Linear]:
    """The linear layers of a sequence, first to last.

    Raises:
        TypeError: a layer of another class, or one whose weight is computed from other parameters.
        ValueError: a lazy layer, or a nonlinearity that is not pointwise.
    """
    if isinstance(module, nn.Sequential) and type(module).forward in (nn.Sequential.forward, MLP.forward):
        for part in module:
            yield from _linears(part)
    elif isinstance(module, nn.LazyLinear):
        raise ValueError("module: expected layers of known sizes, got a lazy one; call the network first")
    elif type(module) is nn.Linear and isinstance(module.weight, nn.Parameter):
        yield module
    elif isinstance(module, nn.Linear) or any(True for _ in module.children()):
        raise TypeError(
            "module: expected an nn.Linear, or an nn.Sequential of them and pointwise nonlinearities, got "
            f"{type(module).__name__}; pass the part that is one, or build the network with EquivariantMLP"
        )
    elif not isinstance(module, nn.Flatten | nn.Unflatten):  # around them all, or sizes would not follow
        require_pointwise("module", module)


def _projected(
    linear: nn.Linear, source: Representation, target: Representation
) -> tuple[Tensor, Tensor | None]:
    """Weight and bias that commute with the group, of the norms that they had, in float64."""
    elements = range(source.group.order)
    weight = linear.weight.double()
    images = [target(source(weight, g).T, g).T for g in elements]
    projected = _with_norm_of(weight, torch.stack(images).mean(0))
    if projected is None:
        raise ValueError(
            f"module: expected layers between representations that share an irreducible one, got {source} "
            f"and {target}: only zero commutes with the group; put a hidden layer between them"
        )
    if linear.bias is None:
        return projected, None
    bias = linear.bias.double()
    mean = target.orbit(bias).mean(0)
    kept = _with_norm_of(bias, mean)
    return projected, torch.zeros_like(mean) if kept is None else kept


def _with_norm_of(original: Tensor, projected: Tensor) -> Tensor | None:
    """A projection scaled to the norm of what was projected; None if nothing is left of it."""
    norm, left = original.norm(), projected.norm()
    return projected * (norm / left) if left > _NOTHING * norm else None
