"""What a network puts out, as a representation maps it.

Outputs can be compared where one is the image of the other: actions as vectors, probabilities of one-hot
actions, one value for each discrete action, and values, which no element changes. An index, an arg-max and
a sample cannot: they have no gradient, or no image.
"""

from __future__ import annotations

from typing import Protocol

from tensordict import NestedKey
from tensordict.nn import CompositeDistribution, TensorDictModule
from torch import Tensor, distributions
from torchrl.modules import (
    DistributionalQValueModule,
    MaskedOneHotCategorical,
    OneHotCategorical,
    QValueModule,
)

from torchrl_sym.entries import split
from torchrl_sym.representations import Representation
from torchrl_sym.symmetry import Symmetry

# Their mode has no gradient; a permutation maps the probabilities alike.
_ONE_HOT = (
    OneHotCategorical,
    MaskedOneHotCategorical,
    distributions.OneHotCategorical,
    distributions.RelaxedOneHotCategorical,
)


class OutputKeys(Protocol):
    """Names of what networks write, the first of which that a network has is compared."""

    action: NestedKey
    action_value: NestedKey
    state_action_value: NestedKey
    value: NestedKey


def output_key(network: TensorDictModule, keys: OutputKeys) -> NestedKey | None:
    """What is compared of what a network writes; None if it has to be named first."""
    if hasattr(network, "get_dist"):
        return keys.action
    known = (keys.action_value, keys.action, keys.state_action_value, keys.value)
    return next((key for key in known if key in network.out_keys), None)


def own_keys(network: TensorDictModule, symmetry: Symmetry, keys: OutputKeys) -> dict[str, NestedKey]:
    """Names that a network has for its action and action values, where they can be told.

    Raises:
        ValueError: several actions.
        TypeError: a distribution of returns for each action.
    """
    if hasattr(network, "dist_sample_keys"):
        return {"action": single_action(network)}
    chooser = next((part for part in network.modules() if isinstance(part, QValueModule)), None)
    if isinstance(chooser, DistributionalQValueModule):
        raise TypeError(
            "expected one value for each action, got a distribution of returns, for which no distance is "
            "defined; augment the batch instead, with SymmetryAugment"
        )
    if chooser is not None:
        return {"action": chooser.out_keys[0], "action_value": chooser.action_value_key}
    declared = set(symmetry.keys()) & set(network.out_keys) - set(network.in_keys)
    return {"action": declared.pop()} if not output_key(network, keys) and len(declared) == 1 else {}


def compared(
    network: TensorDictModule, symmetry: Symmetry, keys: OutputKeys
) -> tuple[NestedKey, Representation | None]:
    """What is compared, and how it transforms: K_g, or None for a value, which no element changes.

    Raises:
        KeyError: an unknown output, or an action that is not declared.
        ValueError: action values of an action that is not permuted.
    """
    key = output_key(network, keys)
    if key is None:
        raise KeyError(
            f"the network writes {network.out_keys}, neither the action {keys.action!r} nor the value "
            f"{keys.value!r}; name its output with set_keys(action=...) or set_keys(value=...)"
        )
    act = symmetry[keys.action] if key in (keys.action, keys.action_value) else None
    if act is not None and key == keys.action_value and (act.matrices < 0).any():
        raise ValueError(
            f"expected a permutation for {keys.action!r}, since the network writes one value for each "
            f"action, got {act}; declare how discrete actions change places"
        )
    return key, act


def is_q_function(network: TensorDictModule, keys: OutputKeys) -> bool:
    """Whether the output is of actions that are given, or of all actions without choosing one."""
    key = output_key(network, keys)
    if key == keys.action_value:
        return keys.action not in network.out_keys
    reads = any(name == keys.action or split(name)[1] == "action" for name in network.in_keys)
    return key in (keys.state_action_value, keys.value) and reads


def single_action(actor: TensorDictModule) -> NestedKey:
    """Key of the action that a probabilistic actor samples.

    Raises:
        ValueError: the actor has several action heads, for which no distance is defined.
    """
    keys = actor.dist_sample_keys
    if len(keys) != 1:
        raise ValueError(f"the mirror loss compares one action, got an actor with {keys}; join its heads")
    return keys[0]


def deterministic_action(dist: distributions.Distribution) -> Tensor:
    """The action pi(s) of a distribution: its deterministic sample, or its mean."""
    if isinstance(dist, CompositeDistribution):
        (dist,) = dist.dists.values()
    if isinstance(dist, _ONE_HOT):
        return dist.probs
    if isinstance(dist, distributions.Categorical):
        raise TypeError(
            "expected an action that a representation can map, got an integer from a Categorical; use "
            "one-hot actions (OneHotCategorical) with a permutation"
        )
    sample = getattr(dist, "deterministic_sample", None)
    return dist.mean if sample is None else sample
