"""Training recipes: PPO with symmetry as one linear loop."""

from torchrl_sym.extras import require

require("torchrl_sym.recipes", "train", {"tqdm": ""})

from torchrl_sym.recipes.config import PPOConfig
from torchrl_sym.recipes.export import export_policy
from torchrl_sym.recipes.metrics import Episodes, symmetry_metrics
from torchrl_sym.recipes.networks import make_actor, make_critic
from torchrl_sym.recipes.runs import export_actor, load_actor
from torchrl_sym.recipes.stages import Stage, train_stages
from torchrl_sym.recipes.storage import RunFolder
from torchrl_sym.recipes.table import read_metrics
from torchrl_sym.recipes.training import Training, train

__all__ = [
    "Episodes",
    "PPOConfig",
    "RunFolder",
    "Stage",
    "Training",
    "export_actor",
    "export_policy",
    "load_actor",
    "make_actor",
    "make_critic",
    "read_metrics",
    "symmetry_metrics",
    "train",
    "train_stages",
]
