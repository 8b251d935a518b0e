"""Numbers that symmetric entries share: scales, gains and a layer norm.

A diagonal matrix commutes with a group if entries that elements exchange or mix have equal numbers in it.
These sets of entries are the *components* of a representation; one number for each is all the freedom
there is for a standard deviation, or for the gains of a normalisation.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from torchrl_sym import checks
from torchrl_sym.modules.linear import flat_rows
from torchrl_sym.representations import Representation
from torchrl_sym.representations.blocks import join
from torchrl_sym.representations.constants import Constants


class TiedScale(nn.Module):
    """A standard deviation that does not depend on the state: one number for all that change places or mix.

    In the place of TorchRL's ``AddStateIndependentNormalScale``. For one that does depend on the state, let
    the network write it with the representation of a scale, ``EquivariantMLP(in_rep, out_rep +
    out_rep.absolute())``, before a ``NormalParamExtractor``.

    Args:
        rep: how the mean transforms.
        initial: the scale to begin with.
        device: where the parameters are made.
        dtype: their type.

    Shape:
        ``(*, *rep.event_shape)`` to itself and the scale, of the same shape.

    Example:
        >>> import torch
        >>> from torchrl_sym import PointGroup
        >>> from torchrl_sym.representations import polar
        >>> scale = TiedScale(polar(PointGroup.rotation(3)), initial=0.5)
        >>> scale.log_scale.shape  # of x and y, which turns mix, and of z
        torch.Size([2])
        >>> scale(torch.zeros(3))[1]
        tensor([0.5000, 0.5000, 0.5000], grad_fn=<...>)
    """

    def __init__(
        self,
        rep: Representation,
        initial: float = 1.0,
        *,
        device: torch.device | str | None = None,
        dtype: torch.dtype | None = None,
    ) -> None:
        super().__init__()
        self.rep = checks.instance("rep", rep, Representation)
        self._components = Constants(rep.components)
        start = math.log(checks.real("initial", initial, above=0.0))
        count = int(rep.components.max()) + 1
        self.log_scale = nn.Parameter(torch.full((count,), start, device=device, dtype=dtype))

    def forward(self, loc: Tensor) -> tuple[Tensor, Tensor]:
        (components,) = self._components.on(self.log_scale.device)
        scale = self.log_scale.exp()[components].reshape(self.rep.event_shape)
        return loc, scale.expand_as(loc)


class EquivariantLayerNorm(nn.Module):
    """Layer normalisation that commutes with a group; of a permutation, PyTorch's with tied gains.

    The mean is that of the entries that elements only exchange, and is subtracted from these: of those that
    change sign or mix, no mean is the same for all images. Then all are divided by their root mean square.
    Gains are one per component, shifts one per component whose entries are only exchanged.

    Args:
        rep: how input and output transform.
        eps: added to the mean square.
        device: where the parameters are made.
        dtype: their type.

    Shape:
        ``(*, *rep.event_shape)`` to the same.

    Example:
        >>> import torch
        >>> from torchrl_sym import PointGroup
        >>> from torchrl_sym.representations import polar, regular
        >>> from torchrl_sym.testing import assert_equivariant
        >>> rep = polar(PointGroup.rotation(3)) + regular(PointGroup.rotation(3))
        >>> assert_equivariant(EquivariantLayerNorm(rep), rep, rep)
    """

    def __init__(
        self,
        rep: Representation,
        eps: float = 1e-5,
        *,
        device: torch.device | str | None = None,
        dtype: torch.dtype | None = None,
    ) -> None:
        super().__init__()
        self.rep = checks.instance("rep", rep, Representation)
        self.eps = checks.real("eps", eps, 0.0)
        moved = _only_moved(rep)
        own, shift = rep.components[moved].unique(return_inverse=True)
        shifts = torch.full((rep.dim,), len(own), device="cpu")  # the last one is zero
        shifts[moved] = shift
        self._constants = Constants(rep.components, shifts, moved.double())
        made = {"device": device, "dtype": dtype}
        self.weight = nn.Parameter(torch.ones(int(rep.components.max()) + 1, **made))
        self.bias = nn.Parameter(torch.zeros(len(own), **made))

    def forward(self, x: Tensor) -> Tensor:
        batch, x = flat_rows(x, self.rep)
        components, shifts, moved = self._constants.on(x.device)
        moved = moved.to(x.dtype)
        x = x - (x @ moved / moved.sum().clamp(min=1)).unsqueeze(-1) * moved
        x = x * (x.square().mean(-1, keepdim=True) + self.eps).rsqrt()
        bias = functional.pad(self.bias, (0, 1))[shifts]
        return (x * self.weight[components] + bias).reshape(*batch, *self.rep.event_shape)


def _only_moved(rep: Representation) -> Tensor:
    """Entries of components in which elements exchange entries and do nothing else, ``(dim,)`` bool."""
    _, weight = join(rep.blocks).terms
    kept = ((weight == 1) & ((weight != 0).sum(-1, keepdim=True) == 1)).any(-1).all(0)
    changed = rep.components[~kept]
    return ~torch.isin(rep.components, changed)
