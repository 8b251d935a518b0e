"""Where everything in a model goes under each element of a group, and with which sign."""

from torchrl_sym.mujoco.derive.derive import derive
from torchrl_sym.mujoco.derive.images import Image, SymmetryError
from torchrl_sym.mujoco.derive.symmetry import ModelSymmetry

__all__ = ["Image", "ModelSymmetry", "SymmetryError", "derive"]
