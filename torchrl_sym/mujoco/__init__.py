"""Symmetry of MuJoCo models: derive it, audit it, symmetrize it, verify it."""

from torchrl_sym.mujoco.audit import audit
from torchrl_sym.mujoco.averages import SymmetrizeReport
from torchrl_sym.mujoco.derive import ModelSymmetry, derive
from torchrl_sym.mujoco.elements import SymmetryError
from torchrl_sym.mujoco.remembered import Remembered
from torchrl_sym.mujoco.report import AuditReport
from torchrl_sym.mujoco.symmetrize import symmetrize, symmetrize_with_report
from torchrl_sym.mujoco.verify import verify
from torchrl_sym.mujoco.verify_report import VerifyReport

__all__ = [
    "AuditReport",
    "ModelSymmetry",
    "Remembered",
    "SymmetrizeReport",
    "SymmetryError",
    "VerifyReport",
    "audit",
    "derive",
    "symmetrize",
    "symmetrize_with_report",
    "verify",
]
