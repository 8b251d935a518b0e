"""The bare networks of the recipe: ordinary, symmetric when training begins, or symmetric by construction.

Ordinary networks learn symmetry, from copies or from a mirror loss. An equivariant one has it, for any
parameters: f(L_g s) = K_g f(s). A relaxed one is equivariant when training begins and may depart from it,
for a price (a residual pathway prior; Finzi et al., 2021), where the robot is not exactly symmetric.
"""

from __future__ import annotations

import torch
from torch import nn
from torchrl.modules import MLP

from torchrl_sym.modules import EquivariantLinear, EquivariantMLP, symmetrize_
from torchrl_sym.recipes.config import PPOConfig
from torchrl_sym.representations import Representation


def make_net(
    config: PPOConfig,
    in_size: int,
    out_size: int,
    inputs: Representation | None = None,
    outputs: Representation | None = None,
) -> nn.Module:
    """An ELU network of the sizes and of the kind that a configuration asks for.

    Args:
        config: ``hidden``, ``network`` and ``initialization``.
        in_size: number of inputs.
        out_size: number of outputs.
        inputs: representation of the inputs, needed for all but ordinary networks of default weights.
        outputs: representation of the outputs.

    Raises:
        ValueError: no representations where they are needed.
    """
    if config.network == "mlp" and config.initialization == "default":
        return MLP(in_size, out_size, num_cells=list(config.hidden), activation_class=nn.ELU)
    if inputs is None or outputs is None:
        raise ValueError(
            "expected representations of what the network reads and writes for "
            f"network={config.network!r}, initialization={config.initialization!r}, got None"
        )

    order = inputs.group.order
    hidden = [-(-size // order) * order for size in config.hidden]
    if config.network == "mlp":
        net = MLP(in_size, out_size, num_cells=hidden, activation_class=nn.ELU)
        return symmetrize_(net, inputs, outputs)
    return EquivariantMLP(inputs, outputs, hidden, nn.ELU, relaxed=config.network == "relaxed")


@torch.no_grad()
def scale_weights(net: nn.Module, factor: float, last: float) -> None:
    """Multiply the parameters of all linear layers by one factor, those of the last by another, too."""
    layers = [layer for layer in net.modules() if isinstance(layer, nn.Linear | EquivariantLinear)]
    for layer in layers:
        for parameter in layer.parameters():
            parameter.mul_(factor * last if layer is layers[-1] else factor)
