"""Symmetry of a task: which representation transforms which entry of a tensordict.

For each element g the paper writes L_g for its action on states and K_g for its action on actions. A
:class:`Symmetry` holds both as one mapping from keys to representations and applies them to whole
tensordicts. It is strict: an entry it does not know is an error, because an observation that is silently
left un-mirrored is the most common bug of this field.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Literal

import torch
from tensordict import NestedKey, TensorDictBase, is_tensor_collection
from tensordict.utils import unravel_key
from torch import Tensor, nn
from torchrl.envs import EnvBase

from torchrl_sym import checks
from torchrl_sym.groups import PointGroup, check_group
from torchrl_sym.probing import check_transforms
from torchrl_sym.representations import Representation
from torchrl_sym.specs import check_box, check_size
from torchrl_sym.trial import Declared

Elements = Literal["all", "random"] | Sequence[str]

# Entries that TorchRL's environments, collectors, value estimators and buffers add to a batch and that
# a symmetric copy shares with its original (Eq. sym-aug keeps log-probability, advantage and return).
_INVARIANT = frozenset(
    [
        *("reward", "done", "terminated", "truncated", "is_init", "step_count", "episode_reward"),
        *("advantage", "value_target", "state_value", "value_error", "returns", "td_error"),
        *("index", "index_generation", "priority_weight", "mask", "shifted_valid", "traj_ids"),
        *("sample_log_prob", "symmetry_id", "original_reward", "steps_to_next_obs", "gamma", "nonterminal"),
        *("traj_count", "target_return", "time_step", "time_reset", "time_policy"),
    ]
)


class Symmetry(nn.Module):
    """Action of a point group on the entries of a tensordict.

    Args:
        group: the group, shared by all representations.
        representations: how each entry's last dimension transforms, by (nested) key. ``("next", key)``
            follows ``key``. If an action is declared, the ``loc`` and ``scale`` that a probabilistic
            actor writes beside it follow it too (``scale`` without signs).
        strict: raise on entries that are neither declared nor of a kind that symmetric copies share
            (reward, done, log-probability, advantage, ... and anything under ``"collector"`` or
            starting with ``_``). With ``False`` they are copied unchanged.

    Raises:
        TypeError: a value is not a representation, or a key is none.
        ValueError: a representation belongs to another group, a key is that of a ``"next"`` entry, or two
            keys are spellings of one.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_sym import PointGroup, Symmetry
        >>> from torchrl_sym.representations import pseudoscalar
        >>> group = PointGroup.reflection("x")
        >>> sign = pseudoscalar(group)
        >>> symmetry = Symmetry(group, {"observation": sign * 3, "action": sign})
        >>> td = TensorDict(observation=torch.ones(4, 3), action=torch.ones(4, 1), batch_size=[4])
        >>> symmetry(td, "reflect-x")["observation"][0]
        tensor([-1., -1., -1.])
        >>> symmetry.orbit(td).batch_size
        torch.Size([2, 4])
    """

    def __init__(
        self,
        group: PointGroup,
        representations: Mapping[NestedKey, Representation],
        *,
        strict: bool = True,
    ) -> None:
        super().__init__()
        check_group(group)
        if not checks.mapping("representations", representations, "keys to representations"):
            raise ValueError("expected at least one key with its representation, got none")
        for key, value in representations.items():
            if not isinstance(value, Representation):
                raise TypeError(
                    f"expected a Representation for {key!r}, got {type(value).__name__}; build one with "
                    "torchrl_sym.representations, e.g. invariant(group, d)"
                )
            if value.group != group:
                raise ValueError(
                    f"the representation of {key!r} belongs to {value.group}, expected {group}; build "
                    "it for this group or use representation.restrict(group)"
                )
        self.group = group
        self.strict = checks.flag("strict", strict)
        self._keys = _distinct_keys(representations)
        self.representations = nn.ModuleList(representations.values())
        self._table: dict[NestedKey, Representation] = dict(
            zip(self._keys, representations.values(), strict=True)
        )
        # what actors write beside an action; entries of batches only, never observations
        self._written: dict[NestedKey, Representation | None] = {}
        for key, action in self._table.items():
            parent, leaf = _split(key)
            if leaf == "action":
                scale = action.absolute() if action.is_signed_permutation else None
                if scale is not None:
                    self.representations.append(scale)  # registered, so that it follows to(device)
                self._written |= {_join(parent, "loc"): action, _join(parent, "scale"): scale}

    def keys(self) -> list[NestedKey]:
        """The declared keys."""
        return list(self._keys)

    def __contains__(self, key: NestedKey) -> bool:
        return _without_next(unravel_key(key)) in self._table

    def __getitem__(self, key: NestedKey) -> Representation:
        """Representation of a key.

        Raises:
            KeyError: the key is not declared; the message lists those that are.
        """
        if checks.key("key", key) not in self:
            raise KeyError(
                f"no representation for {key!r}; this symmetry has {self._keys}. Add it to the "
                "dictionary passed to Symmetry, e.g. invariant(group, d) if no element changes it"
            )
        return self._table[_without_next(unravel_key(key))]

    def require(self, keys: Iterable[NestedKey], reader: str) -> None:
        """Raise KeyError unless every key is declared, or of a kind that copies share."""
        keys = [checks.key("keys", key) for key in checks.sequence("keys", keys)]
        missing = [key for key in keys if key not in self and not _is_shared(key)]
        if any("recurrent_state" in _split(key)[1] for key in missing):
            raise KeyError(
                f"{reader} reads the memory {missing}: the memory after a mirrored history is not a linear "
                "image of the stored one; start copies from a zero memory (declare it invariant and sample "
                "slices that begin where is_init is set), or use a policy without memory"
            )
        if missing:
            raise KeyError(
                f"{reader} reads {missing}, which this symmetry does not transform (it has "
                f"{self._keys}); add them, e.g. invariant(group, d) if no element changes them"
            )

    def elements(self, elements: Elements) -> list[int]:
        """Indices of ``"all"`` elements, or of the identity and the named ones, originals first."""
        if isinstance(elements, str) and elements in ("all", "random"):
            return list(range(self.group.order))
        if isinstance(elements, str):
            raise ValueError(
                f"expected 'all', 'random' or a sequence of names from {list(self.group.names)}, got "
                f"{elements!r}"
            )
        elements = checks.sequence("elements", elements)
        named = [self.group.index(e) for e in elements]
        if not named or len(set(named)) != len(named):
            raise ValueError(f"expected distinct element names, at least one, got {elements}")
        return [0, *(g for g in named if g != 0)]

    def draw(self, batch: TensorDictBase, *, per_sequence: bool = False) -> Tensor:
        """Random elements, one for each row of a batch ``[*B]``, on the device of its data.

        Args:
            batch: what will be mapped.
            per_sequence: one for each sequence ``[*B[:-1]]`` instead, the same at all of its times: a
                recurrent network must see one image of a history.
        """
        shape = check_batch(batch).batch_size
        drawn = shape[:-1] if per_sequence else shape
        device = next((value.device for value in batch.values(True, True)), batch.device)
        element = torch.randint(self.group.order, drawn, device=device)
        return element.unsqueeze(-1).expand(shape) if per_sequence else element

    def forward(
        self,
        tensordict: TensorDictBase,
        g: int | str | Tensor,
        *,
        keys: Iterable[NestedKey] | None = None,
    ) -> TensorDictBase:
        """Symmetric copy of a tensordict under one element, or one element per row.

        Args:
            tensordict: any batch; it is not modified.
            g: element index or name, or indices of shape ``tensordict.batch_size``.
            keys: what to map; every other entry is shared. Defaults to all that is declared.

        Raises:
            KeyError: an entry that the symmetry should know but does not (strict, or named by ``keys``).
            ValueError: a tensor's last dimension differs from its representation's.
            TypeError: no tensordict.
        """
        out = check_batch(tensordict).copy()
        for key, representation, value in self._mapped(tensordict, keys):
            out.set(key, representation(value, g))
        return out

    def orbit(
        self,
        tensordict: TensorDictBase,
        elements: Sequence[int] | None = None,
        *,
        keys: Iterable[NestedKey] | None = None,
    ) -> TensorDictBase:
        """All symmetric copies: batch ``[*B]`` to ``[N, *B]``, the originals first.

        Entries that copies share are expanded, not copied.

        Args:
            tensordict: any batch; it is not modified.
            elements: indices of the elements to apply. Defaults to all of the group.
            keys: what to map; every other entry is shared. Defaults to all that is declared.
        """
        if elements is not None:
            elements = checks.sequence("elements", elements, of="indices")
        count = self.group.order if elements is None else len(elements)
        if count == 0:
            raise ValueError("elements: expected at least one element, got none")
        out = check_batch(tensordict).expand(count, *tensordict.batch_size).copy()
        for key, representation, value in self._mapped(tensordict, keys):
            if elements is None:
                images = representation.orbit(value)
            else:
                images = torch.stack([representation(value, g) for g in elements])
            out.set(key, images)
        return out

    def _mapped(self, tensordict: TensorDictBase, keys: Iterable[NestedKey] | None):
        strict = self.strict or keys is not None  # what is asked for by name must be known
        if keys is None:
            chosen = tensordict.keys(include_nested=True, leaves_only=True)
        else:
            chosen = [checks.key("keys", key) for key in checks.sequence("keys", keys, of="keys")]
        for key in chosen:
            representation = self._resolve(key, strict)
            if representation is not None:
                value = tensordict.get(key, None)
                if isinstance(value, Tensor):
                    if value.ndim <= tensordict.batch_dims or value.shape[-1] != representation.dim:
                        raise ValueError(
                            f"entry {key!r}: expected a last dimension of {representation.dim}, got "
                            f"shape {tuple(value.shape)} with batch size "
                            f"{tuple(tensordict.batch_size)}; list every entry of the tensor in order"
                        )
                    yield key, representation, value

    def _resolve(self, key: NestedKey, strict: bool) -> Representation | None:
        """Representation of a batch entry, None if copies share it, KeyError if it is unknown."""
        bare = _without_next(unravel_key(key))
        if bare in self._table:
            return self._table[bare]
        if bare in self._written:
            if self._written[bare] is None:
                raise KeyError(
                    f"the batch has {key!r}, but the action's representation mixes entries, which carries "
                    "no diagonal scale to another; drop it with select=..., or declare it with "
                    "invariant(group, d) if all its entries are equal"
                )
            return self._written[bare]
        if strict and not _is_shared(bare):
            raise KeyError(
                f"the batch has {key!r}, which this symmetry does not know (it has {self._keys}); add "
                "its representation, e.g. invariant(group, d) if no element changes it, drop it with "
                "select=..., or pass strict=False to copy unknown entries unchanged"
            )
        return None

    def check_specs(self, env: EnvBase) -> None:
        """Check sizes and boxes of an environment's observations and actions.

        Every element must map each bounded box onto itself. Otherwise a mirrored action leaves the
        box: a tanh-squashed policy then assigns it a log-probability that is off by hundreds of nats.
        Boxes of observations that turn by less than a right angle are not checked: no box is mapped
        onto itself then, and nothing depends on it.

        Raises:
            KeyError: an observation or action of the environment is not declared (strict).
            ValueError: a size differs, a box is not symmetric, or a transform, such as a normaliser, does
                not commute with L_g or K_g.
        """
        checks.instance("env", env, EnvBase)
        for specs, is_action in ((env.observation_spec, False), (env.full_action_spec, True)):
            for key, spec in specs.items(include_nested=True, leaves_only=True):
                if key in self:
                    check_size(key, spec, self[key])
                    if is_action or self[key].is_signed_permutation:
                        check_box(key, spec, self[key])
                elif self.strict and not _is_shared(key):
                    raise KeyError(
                        f"the environment has {key!r}, which this symmetry does not know (it has "
                        f"{self._keys}); add its representation, e.g. invariant(group, d) if no element "
                        "changes it"
                    )
        check_transforms(env, Declared(self.keys(), self, self.group.names))

    def extra_repr(self) -> str:
        return f"{self.group!r}, keys={self._keys}"


def check_batch(tensordict: TensorDictBase) -> TensorDictBase:
    """TypeError unless it is a tensordict (or a tensorclass)."""
    if not is_tensor_collection(type(tensordict)):
        raise TypeError(f"expected a tensordict, got {checks.shown(tensordict)}")
    return tensordict


def check_symmetry(symmetry: Symmetry) -> Symmetry:
    """TypeError unless it is a symmetry."""
    return checks.instance("symmetry", symmetry, Symmetry, "build Symmetry(group, {key: representation})")


def _distinct_keys(keys: Iterable[NestedKey]) -> list[NestedKey]:
    """The keys of a symmetry in their shortest spelling."""
    found: dict[NestedKey, NestedKey] = {}
    for spelling in keys:
        key = checks.key("representations", spelling)
        bare = _without_next(key)
        if bare != key or key == "next":
            raise ValueError(
                f"expected keys without 'next', got {spelling!r}; declare the entry itself, whose "
                "representation the one under 'next' follows"
            )
        if key in found:
            raise ValueError(
                f"expected distinct keys, got {found[key]!r} and {spelling!r}; declare one of them"
            )
        found[key] = spelling
    return list(found)


def _is_shared(key: NestedKey) -> bool:
    """Whether symmetric copies share an entry with their original, judging by its key."""
    parent, leaf = _split(_without_next(unravel_key(key)))
    return (
        leaf in _INVARIANT
        or leaf.endswith("log_prob")
        or leaf.startswith("_")
        or (len(parent) > 0 and parent[0] == "collector")
    )


def _without_next(key: NestedKey) -> NestedKey:
    if isinstance(key, tuple) and key[0] == "next":
        return unravel_key(key[1:])
    return key


def _split(key: NestedKey) -> tuple[tuple[str, ...], str]:
    parts = (key,) if isinstance(key, str) else tuple(map(str, key))
    return parts[:-1], parts[-1]


def _join(parent: tuple[str, ...], leaf: str) -> NestedKey:
    return unravel_key((*parent, leaf))
