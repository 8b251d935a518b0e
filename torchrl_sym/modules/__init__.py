"""Networks that commute with a group, exactly and whatever their parameters are."""

from torchrl_sym.modules.linear import EquivariantLinear
from torchrl_sym.modules.mlp import EquivariantMLP, InvariantMLP
from torchrl_sym.modules.recurrent import EquivariantGRU, EquivariantLSTM
from torchrl_sym.modules.symmetrize import symmetrize_
from torchrl_sym.modules.tied import EquivariantLayerNorm, TiedScale

__all__ = [
    "EquivariantGRU",
    "EquivariantLSTM",
    "EquivariantLayerNorm",
    "EquivariantLinear",
    "EquivariantMLP",
    "InvariantMLP",
    "TiedScale",
    "symmetrize_",
]
