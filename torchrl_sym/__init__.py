"""torchrl_sym: symmetry for robot reinforcement learning, as ordinary TorchRL parts."""

from importlib.metadata import PackageNotFoundError, version

from torchrl_sym.augment import SymmetryAugment
from torchrl_sym.groups import PointGroup
from torchrl_sym.mirror_loss import MirrorLoss
from torchrl_sym.replay import SymmetryOrbit, SymmetryReplayBuffer
from torchrl_sym.representations import Representation
from torchrl_sym.symmetric_ppo import SymmetricClipPPOLoss
from torchrl_sym.symmetry import Symmetry

__all__ = [
    "MirrorLoss",
    "PointGroup",
    "Representation",
    "SymmetricClipPPOLoss",
    "Symmetry",
    "SymmetryAugment",
    "SymmetryOrbit",
    "SymmetryReplayBuffer",
]

try:
    __version__ = version("torchrl_sym")
except PackageNotFoundError:  # a source tree on the path, not installed
    __version__ = "0+unknown"
