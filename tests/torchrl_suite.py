"""TorchRL's own tests, with the classes of this package in the place of those that they stand in for.

A pytest plugin, for a checkout of TorchRL at (or near) the installed version. It runs the tests there of
``ClipPPOLoss`` on :class:`~torchrl_sym.SymmetricClipPPOLoss`, with all elements or drawn ones, and those of
``VecNormV2`` on ``SymmetricVecNorm``, with the trivial group, under which both have the same statistics::

    git clone --depth 1 --branch v0.14.1 https://github.com/pytorch/rl
    TORCHRL_CHECKOUT=rl python -m pytest tests/test_torchrl_suite.py

or, to look closer, in the checkout and with this project on the PYTHONPATH::

    python -m pytest -c pytest.ini -p tests.torchrl_suite --symmetric random test/objectives/test_ppo.py

Each loss gets a reflection of the entries that its networks read and of its actions: every second one
changes sign. TorchRL's networks know nothing of it, so copies differ in all that the tests look at.
"""

from __future__ import annotations

import inspect
import sys

import pytest
import torch
import torchrl.envs
import torchrl.objectives
from tensordict import NestedKey
from torch import nn

from torchrl_sym import PointGroup, SymmetricClipPPOLoss, Symmetry
from torchrl_sym.normalization import GroupAverage
from torchrl_sym.representations import Representation, invariant
from torchrl_sym.vecnorm import SymmetricVecNorm

FILES = (
    "objectives/test_ppo.py",
    "objectives/test_loss_module.py",
    "objectives/test_vla.py",
    "transforms/test_normalization.py",
)

# A test, the elements it cannot pass with, and the property of the method that forbids it.
EXCLUDED = {
    "test_ppo_reduction[True-none-": ("all", "counts rows: an unreduced loss has the copies too"),
    "test_ppo_reduction[False-none-": (
        "all",
        "counts rows: an unreduced loss has the copies too",
    ),
    "test_ppo_composite_dists": ("all", "counts rows: its policy writes four, whatever it is given"),
    "test_ppo_marl_aggregate": ("all", "counts rows: its policy writes three, whatever it is given"),
    "test_ppo_shared_seq": ("random", "compares two losses, which draw different elements"),
    "test_ppo_ess_preserves_feature_shape": ("any", "its actor is no TensorDictModule, which we ask for"),
    "test_stateful_and_stateless_specs[False]": (
        "any",
        "statistics in the data, which ours does not offer",
    ),
    "test_stateful_vs_stateless": ("any", "statistics in the data, which ours does not offer"),
    "test_vecnorm_stack[False]": ("any", "statistics in the data, which ours does not offer"),
    "test_denorm[False]": ("any", "statistics in the data, which ours does not offer"),
    "VecNormV2::test_state_dict_vecnorm": (
        "any",
        "reading the state shares it, with workers; a clone's is its own",
    ),
    "TestTokenPPO": ("any", "its actor reads a text, for which nothing can be declared"),
}

GROUP = PointGroup.reflection("y")
RENAMED = ("test1", "action_test", "action2", ("action", "action1"))  # what tests rename actions to


def reflection(*shape: int) -> Representation:
    """Of events of this shape; every second entry changes sign."""
    size = torch.Size(shape).numel()
    sign = torch.tensor([1.0, -1.0]).repeat(size)[:size]
    return Representation(GROUP, torch.stack([torch.eye(size), sign.diag()])).unflatten(shape)


def unsigned(*shape: int) -> Representation:
    """Of events that may not change sign, such as samples of a Gamma distribution."""
    return invariant(GROUP, torch.Size(shape).numel()).unflatten(shape)


# Entries of tests whose networks have no layers that would tell sizes.
SHAPES: dict[NestedKey, Representation] = {
    ("agents", "observation"): reflection(4, 5),
    ("agents", "dirich"): unsigned(4, 10, 2),
    ("agents", "categ"): unsigned(4),
    ("agent0", "action", "action1", "sub_action1"): unsigned(),
    ("agent0", "action", "action1", "sub_action2"): unsigned(),
    ("agent0", "action", "action2"): unsigned(),
    ("agent1", "action"): unsigned(2),
    "agent2": reflection(),
    "state": reflection(),
    ("params", "agents", "dirich", "concentration"): unsigned(4, 10, 2),
    ("params", "agents", "categ", "logits"): unsigned(4, 7),
}


def declared(actor: nn.Module, critic: nn.Module | None) -> Symmetry:
    """The reflection of all that the networks of a test read, and of its actions."""
    layers = [module for module in actor.modules() if isinstance(module, nn.Linear)]
    read = {key for network in (actor, critic) if network is not None for key in network.in_keys}
    found = {key: SHAPES[key] for key in (*read, *actor.dist_sample_keys) if key in SHAPES}
    if "params" in read and not layers:  # a function that fills them does not say what
        found |= {key: rep for key, rep in SHAPES.items() if key[0] == "params"}
    if layers:
        found |= dict.fromkeys(read - found.keys(), reflection(layers[0].in_features))
        actions = {*actor.dist_sample_keys, *RENAMED} - found.keys()
        found |= dict.fromkeys(actions, reflection(layers[-1].out_features // 2))
    return Symmetry(GROUP, found)


class StandIn(SymmetricClipPPOLoss):
    """A SymmetricClipPPOLoss that is made as a ClipPPOLoss is."""

    symmetric_elements = "all"

    def __init__(self, actor_network=None, critic_network=None, **settings):
        symmetry = declared(actor_network, critic_network)
        settings |= {"symmetry": symmetry, "elements": self.symmetric_elements}
        super().__init__(actor_network, critic_network, **settings)


class NormStandIn(SymmetricVecNorm):
    """A SymmetricVecNorm that is made as a VecNormV2 is, of entries that no element changes."""

    def __init__(self, in_keys, out_keys=None, *, stateful=True, **settings):
        assert stateful
        trivial = PointGroup.trivial()
        entries = {key: invariant(trivial, 1) for key in ("observation", *in_keys)}
        super().__init__(in_keys, out_keys, symmetry=Symmetry(trivial, entries), **settings)
        # whatever their sizes, which nobody tells
        self.averages = nn.ModuleList(GroupAverage(None) for _ in in_keys)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--symmetric", choices=("all", "random"), default="all", help="elements of the copies")


def pytest_configure(config: pytest.Config) -> None:
    StandIn.symmetric_elements = config.getoption("--symmetric")
    torchrl.objectives.ClipPPOLoss = StandIn
    torchrl.envs.VecNormV2 = NormStandIn


def pytest_pycollect_makemodule(module_path, parent) -> None:
    """Tests of PPO are marked to need transformers, of which they make no use."""
    if module_path.name == "test_ppo.py":
        sys.path.insert(0, str(module_path.parent))
        __import__("_objectives_common")._has_transformers = True


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Keep the tests that make what we stand in for and that the method can pass."""
    elements = config.getoption("--symmetric")
    excluded = [name for name, (which, _) in EXCLUDED.items() if which in (elements, "any")]
    kept = [i for i in items if _makes_ours(i) and not any(name in i.nodeid for name in excluded)]
    config.hook.pytest_deselected(items=[item for item in items if item not in kept])
    items[:] = kept


def _makes_ours(item: pytest.Item) -> bool:
    parameters = item.callspec.params if hasattr(item, "callspec") else {}
    if "loss_class" in parameters:
        return parameters["loss_class"] is StandIn
    source = inspect.getsource(item.function)
    return "ClipPPOLoss" in source or any(name in item.nodeid for name in ("TestVecNormV2", "TokenPPO"))
