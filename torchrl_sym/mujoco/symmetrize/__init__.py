"""A nearly symmetric model, made exactly symmetric by averaging."""

from torchrl_sym.mujoco.symmetrize.report import SymmetrizeReport
from torchrl_sym.mujoco.symmetrize.symmetrize import symmetrize, symmetrize_with_report

__all__ = ["SymmetrizeReport", "symmetrize", "symmetrize_with_report"]
