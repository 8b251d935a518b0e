"""Does an environment agree with the symmetry declared for it?"""

from torchrl_sym.mujoco.verify.remembered import Remembered
from torchrl_sym.mujoco.verify.report import PARTS, VerifyReport
from torchrl_sym.mujoco.verify.verify import verify

__all__ = ["PARTS", "Remembered", "VerifyReport", "verify"]
