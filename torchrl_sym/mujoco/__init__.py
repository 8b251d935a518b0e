"""Symmetry of MuJoCo models: find it, derive it, audit it, symmetrize it, verify it."""

from torchrl_sym.mujoco.audit import AuditReport, audit
from torchrl_sym.mujoco.derive import ModelSymmetry, SymmetryError, derive
from torchrl_sym.mujoco.symmetries import SymmetriesReport, symmetries
from torchrl_sym.mujoco.symmetrize import SymmetrizeReport, symmetrize, symmetrize_with_report
from torchrl_sym.mujoco.verify import Remembered, VerifyReport, verify

__all__ = [
    "AuditReport",
    "ModelSymmetry",
    "Remembered",
    "SymmetriesReport",
    "SymmetrizeReport",
    "SymmetryError",
    "VerifyReport",
    "audit",
    "derive",
    "symmetries",
    "symmetrize",
    "symmetrize_with_report",
    "verify",
]
