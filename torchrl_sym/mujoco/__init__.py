"""Symmetry of MuJoCo models: find, derive, audit, symmetrize and verify it, infer that of observations."""

from torchrl_sym.extras import require

require("torchrl_sym.mujoco", "mujoco", {"mujoco": "3.11", "scipy": ""})

from torchrl_sym.mujoco.audit import AuditReport, audit
from torchrl_sym.mujoco.derive import ModelSymmetry, SymmetryError, derive
from torchrl_sym.mujoco.infer import InferenceError, infer
from torchrl_sym.mujoco.symmetries import SymmetriesReport, symmetries
from torchrl_sym.mujoco.symmetrize import SymmetrizeReport, symmetrize, symmetrize_with_report
from torchrl_sym.mujoco.verify import Remembered, VerifyReport, verify

__all__ = [
    "AuditReport",
    "InferenceError",
    "ModelSymmetry",
    "Remembered",
    "SymmetriesReport",
    "SymmetrizeReport",
    "SymmetryError",
    "VerifyReport",
    "audit",
    "derive",
    "infer",
    "symmetries",
    "symmetrize",
    "symmetrize_with_report",
    "verify",
]
