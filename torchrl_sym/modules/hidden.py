"""Hidden units: their number, and what may be done to them.

A regular representation has N entries a copy, which the group exchanges. What treats all entries alike and
one at a time commutes with that. A nonlinearity that looks at several entries, as a softmax does, or has a
parameter for each of them, does not.
"""

from __future__ import annotations

import contextlib
import copy
from collections.abc import Callable, Sequence

import torch
from torch import nn

from torchrl_sym import checks
from torchrl_sym.groups import PointGroup
from torchrl_sym.representations import Representation, regular


def hidden_units(name: str, size: int, group: PointGroup) -> Representation:
    """The regular representation with so many entries.

    Raises:
        TypeError: no whole number.
        ValueError: the group's order does not divide the size; the message has the next multiple.
    """
    size = checks.whole(name, size, 1)
    if size % group.order:
        larger = size + group.order - size % group.order
        raise ValueError(
            f"{name}: expected multiples of {group.order}, the order of {group}, got {size}; the next one "
            f"is {larger}"
        )
    return regular(group, size // group.order)


def hidden_layers(name: str, sizes: Sequence[int], group: PointGroup) -> list[Representation]:
    """One for each size."""
    return [hidden_units(name, size, group) for size in checks.sequence(name, sizes, "sizes")]


def activation(activation_class: Callable[[], nn.Module]) -> nn.Module:
    """A new nonlinearity.

    Raises:
        TypeError: no class of modules.
        ValueError: it is not pointwise.
    """
    module = None
    if not isinstance(activation_class, nn.Module):
        with contextlib.suppress(TypeError):  # a function of tensors
            module = checks.function("activation_class", activation_class)()
    if not isinstance(module, nn.Module):
        raise TypeError(
            "activation_class: expected a class of modules that needs no arguments, such as nn.ELU, got "
            f"{checks.shown(activation_class)}"
        )
    require_pointwise("activation_class", module)
    return module


@torch.no_grad()
def require_pointwise(name: str, module: nn.Module) -> None:
    """ValueError unless a module does, in evaluation, the same to every entry, and to each by itself."""
    judged = copy.deepcopy(module).to("cpu", torch.float64).eval()
    x = torch.randn(3, 4, generator=torch.Generator().manual_seed(0), dtype=torch.float64, device="cpu")
    try:
        single = torch.stack([judged(entry.reshape(1, 1)) for entry in x.flatten()]).reshape(x.shape)
        same = torch.allclose(judged(x), single, rtol=0, atol=1e-12)
    except (RuntimeError, ValueError, TypeError, IndexError):
        same = False
    if not same:
        raise ValueError(
            f"{name}: expected a nonlinearity of single entries, such as nn.ELU, got "
            f"{type(module).__name__}, which does not commute with exchanging entries"
        )
