"""Symmetry of MuJoCo models: derive it, audit it."""

from torchrl_sym.mujoco.audit import audit
from torchrl_sym.mujoco.derive import ModelSymmetry, derive
from torchrl_sym.mujoco.elements import SymmetryError
from torchrl_sym.mujoco.report import AuditReport

__all__ = ["AuditReport", "ModelSymmetry", "SymmetryError", "audit", "derive"]
