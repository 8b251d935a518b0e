"""Networks that commute with a group, exactly and whatever their parameters are."""

from torchrl_sym.modules.linear import EquivariantLinear
from torchrl_sym.modules.mlp import EquivariantMLP, InvariantMLP
from torchrl_sym.modules.symmetrize import symmetrize_

__all__ = [
    "EquivariantLinear",
    "EquivariantMLP",
    "InvariantMLP",
    "symmetrize_",
]
