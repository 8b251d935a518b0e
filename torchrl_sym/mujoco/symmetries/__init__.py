"""Which symmetries a model has."""

from torchrl_sym.mujoco.symmetries.report import Candidate, SymmetriesReport
from torchrl_sym.mujoco.symmetries.symmetries import symmetries

__all__ = ["Candidate", "SymmetriesReport", "symmetries"]
