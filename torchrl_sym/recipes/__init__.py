"""Training recipes: PPO with symmetry as one linear loop."""

from torchrl_sym.recipes.config import PPOConfig
from torchrl_sym.recipes.metrics import Episodes, symmetry_metrics
from torchrl_sym.recipes.networks import make_actor, make_critic
from torchrl_sym.recipes.ppo import export_actor, load_actor, train
from torchrl_sym.recipes.storage import RunFolder, read_metrics

__all__ = [
    "Episodes",
    "PPOConfig",
    "RunFolder",
    "export_actor",
    "load_actor",
    "make_actor",
    "make_critic",
    "read_metrics",
    "symmetry_metrics",
    "train",
]
