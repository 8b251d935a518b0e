"""How does an environment's observation transform? Found from the simulator."""

from torchrl_sym.mujoco.infer.errors import InferenceError, Unexplained
from torchrl_sym.mujoco.infer.infer import infer
from torchrl_sym.mujoco.infer.inferred import InferredSymmetry

__all__ = ["InferenceError", "InferredSymmetry", "Unexplained", "infer"]
