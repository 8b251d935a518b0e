"""torchrl_sym: symmetry for robot reinforcement learning, as ordinary TorchRL parts."""

from importlib.metadata import PackageNotFoundError, version

from torchrl_sym.augment import SymmetryAugment
from torchrl_sym.entries import Exchanged
from torchrl_sym.groups import PointGroup
from torchrl_sym.mirror_loss import MirrorLoss
from torchrl_sym.normalization import SymmetricNorm
from torchrl_sym.replay import SymmetryOrbit, SymmetryReplayBuffer
from torchrl_sym.representations import Representation
from torchrl_sym.symmetric_ppo import SymmetricClipPPOLoss
from torchrl_sym.symmetry import Symmetry
from torchrl_sym.vecnorm import SymmetricVecNorm

__all__ = [
    "Exchanged",
    "MirrorLoss",
    "PointGroup",
    "Representation",
    "SymmetricClipPPOLoss",
    "SymmetricNorm",
    "SymmetricVecNorm",
    "Symmetry",
    "SymmetryAugment",
    "SymmetryOrbit",
    "SymmetryReplayBuffer",
]

try:
    __version__ = version("torchrl_sym")
except PackageNotFoundError:  # a source tree on the path, not installed
    __version__ = "0+unknown"
