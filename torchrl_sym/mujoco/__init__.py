"""Symmetry of MuJoCo models: derive it, audit it, symmetrize it, verify it."""

from torchrl_sym.extras import require

require("torchrl_sym.mujoco", "mujoco", {"mujoco": "3.11", "scipy": ""})

from torchrl_sym.mujoco.audit import AuditReport, audit
from torchrl_sym.mujoco.derive import ModelSymmetry, SymmetryError, derive
from torchrl_sym.mujoco.symmetrize import SymmetrizeReport, symmetrize, symmetrize_with_report
from torchrl_sym.mujoco.verify import Remembered, VerifyReport, verify

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
