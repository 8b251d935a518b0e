"""Symmetry of MuJoCo models: derive it."""

from torchrl_sym.mujoco.derive import ModelSymmetry, derive
from torchrl_sym.mujoco.elements import SymmetryError

__all__ = ["ModelSymmetry", "SymmetryError", "derive"]
