"""Keys of a batch: which entries symmetric copies share, and which follow the action or one another.

A :class:`~torchrl_sym.Symmetry` declares what networks read and what the environment takes. The rest of a
batch is written by TorchRL's environments, collectors, value estimators and buffers, under names of their
own. Eq. (sym-aug) keeps log-probability, advantage and return of the original, so copies share them; but
only where they are one number per row. With one number per component of the action (torch's ``Normal``
gives a log-probability for each), or one per agent, they change places as those components do.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass

from tensordict import LazyStackedTensorDict, NestedKey, TensorDictBase, is_tensor_collection
from tensordict.utils import unravel_key

from torchrl_sym import checks

# One number per row, which copies share; or one per component or item of the action, which follow it.
PER_ROW = frozenset(
    [
        *("reward", "done", "terminated", "truncated", "is_init", "step_count", "episode_reward"),
        *("advantage", "value_target", "state_value", "value_error", "returns", "td_error"),
        *("mask", "shifted_valid", "priority_weight", "original_reward", "steps_to_next_obs", "gamma"),
        *("nonterminal", "traj_count", "target_return", "time_step", "time_reset", "time_policy"),
        *("chosen_action_value", "state_action_value"),
    ]
)

# What says where a row comes from, of any shape: nothing of the task.
_BOOKKEEPING = frozenset(
    [
        *("index", "index_generation", "traj_ids", "env_index", "policy_version", "hash"),
        "symmetry_id",
    ]
)

# Names of things on both sides of a plane, and the axis that a reflection must turn to exchange them.
_SIDES = (
    ("left", "right", 1),
    ("l", "r", 1),
    ("front", "back", 0),
    ("front", "rear", 0),
    ("front", "hind", 0),
)


@dataclass(frozen=True, init=False)
class Exchanged:
    """Entries of several keys that change places: the left and the right hand, two cameras.

    As a key of a :class:`~torchrl_sym.Symmetry`, it declares the entries together. Their representation is
    one of ``items`` (one item per key, in this order), or one of the entries concatenated in this order.

    Args:
        keys: two or more keys.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_sym import Exchanged, PointGroup, Symmetry
        >>> from torchrl_sym.representations import signed_permutation
        >>> group = PointGroup.reflection("y")
        >>> hands = signed_permutation(group, ["l", "r"], {"reflect-y": {"l": "-r", "r": "-l"}})
        >>> symmetry = Symmetry(group, {Exchanged("left", "right"): hands})
        >>> td = TensorDict(left=torch.ones(1), right=torch.zeros(1))
        >>> symmetry(td, "reflect-y")["right"]
        tensor([-1.])
    """

    keys: tuple[NestedKey, ...]

    def __init__(self, *keys: NestedKey) -> None:
        spelled = tuple(checks.key("Exchanged", key) for key in keys)
        if len(spelled) < 2 or len(set(spelled)) != len(spelled):
            raise ValueError(f"Exchanged: expected two or more distinct keys, got {list(keys)}")
        object.__setattr__(self, "keys", spelled)

    def __repr__(self) -> str:
        return f"Exchanged({', '.join(map(repr, self.keys))})"


def is_per_row(bare: NestedKey) -> bool:
    """Whether TorchRL writes numbers of a row, or of the components of its action, under this name."""
    leaf = split(bare)[1]
    return leaf in PER_ROW or leaf.endswith("log_prob") or leaf.startswith("_")


def is_bookkeeping(bare: NestedKey) -> bool:
    """Whether an entry says where a row comes from, and nothing of the task."""
    parent, leaf = split(bare)
    return leaf in _BOOKKEEPING or (len(parent) > 0 and parent[0] == "collector")


def without_next(key: NestedKey) -> NestedKey:
    """The entry that one under ``"next"`` follows, in its shortest spelling."""
    key = unravel_key(key)
    if isinstance(key, tuple) and key[0] == "next":
        return unravel_key(key[1:])
    return key


def split(key: NestedKey) -> tuple[tuple[str, ...], str]:
    """Parents and name of an entry."""
    parts = (key,) if isinstance(key, str) else tuple(map(str, key))
    return parts[:-1], parts[-1]


def join(parent: tuple[str, ...], leaf: str) -> NestedKey:
    """An entry from its parents and its name."""
    return unravel_key((*parent, leaf))


def path(key: NestedKey) -> tuple[str, ...]:
    """The names on the way to an entry, its own last."""
    parent, leaf = split(key)
    return (*parent, leaf)


def enclosing(key: NestedKey) -> list[NestedKey]:
    """The groups that an entry is in."""
    parent = split(key)[0]
    return [unravel_key(parent[:depth]) for depth in range(1, len(parent) + 1)]


def uneven_keys(tensordict: TensorDictBase, prefix: tuple[str, ...] = ()) -> list[NestedKey]:
    """Entries that only some rows of a lazy stack have; its own keys are those that all rows have."""
    if isinstance(tensordict, LazyStackedTensorDict):
        rows = [{unravel_key(key) for key in row.keys(True, True)} for row in tensordict.tensordicts]
        found = set().union(*rows).difference(set.intersection(*rows)) if rows else set()
        return sorted((unravel_key((*prefix, key)) for key in found), key=str)
    uneven: list[NestedKey] = []
    for key, value in tensordict.items():
        if is_tensor_collection(value) and isinstance(value, TensorDictBase):
            uneven += uneven_keys(value, (*prefix, key))
    return uneven


def opposites(keys: Iterable[NestedKey]) -> Iterable[tuple[NestedKey, NestedKey, int]]:
    """Pairs of keys that differ in a side, such as left and right, with the axis between the two."""
    keys = list(keys)
    spelled = {tuple(part.lower() for part in path(key)): key for key in keys}
    for parts, key in spelled.items():
        for here, there, axis in _SIDES:
            other = tuple(_swapped(part, here, there) for part in parts)
            if other != parts and other in spelled:
                yield key, spelled[other], axis


def _swapped(name: str, here: str, there: str) -> str:
    return re.sub(rf"(?<![a-z]){here}(?![a-z])", there, name)
