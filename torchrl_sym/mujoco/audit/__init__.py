"""How far a model is from a symmetry, term by term."""

from torchrl_sym.mujoco.audit.audit import audit
from torchrl_sym.mujoco.audit.report import AuditReport

__all__ = ["AuditReport", "audit"]
