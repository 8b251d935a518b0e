"""Which representation transforms which entries of a batch, and all that can be wrong with it.

Most entries are declared by their key. Some are declared together, because they change places; some follow
the action, because an actor or an estimator wrote them beside it; and some are the same for all copies.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.utils import unravel_key
from torch import Tensor

from torchrl_sym import checks
from torchrl_sym.entries import (
    Exchanged,
    is_bookkeeping,
    is_per_row,
    join,
    opposites,
    path,
    split,
    uneven_keys,
    without_next,
)
from torchrl_sym.groups import PointGroup
from torchrl_sym.representations import Representation

# What actors write beside an action: a parameter of its distribution, or a value per component.
_SIGNED, _UNSIGNED = ("loc",), ("scale", "logits", "probs", "action_value")


class _Unknown(Exception):
    """Nothing is known about an entry."""


Part = tuple[list[NestedKey], Representation]
"""Entries that are mapped together, mostly a single one, and their representation."""


class Declaration:
    """The entries that a symmetry declares, and what follows from them.

    Args:
        group: the group that acts.
        representations: by key, or by keys that change places.
    """

    def __init__(
        self, group: PointGroup, representations: Mapping[NestedKey | Exchanged, Representation]
    ) -> None:
        self.parts: list[Part] = []
        self.position: dict[NestedKey, int] = {}  # in parts, of the one that a key belongs to
        spelling: dict[NestedKey, NestedKey | Exchanged] = {}
        for declared, representation in representations.items():
            _check_representation(declared, representation, group)
            names = declared.keys if isinstance(declared, Exchanged) else (declared,)
            self.parts.append(([_checked_key(name) for name in names], representation))
            for key in self.parts[-1][0]:
                if key in spelling:
                    raise ValueError(
                        f"expected distinct keys, got {spelling[key]!r} and {declared!r}; declare one of "
                        "them"
                    )
                spelling[key] = declared
                self.position[key] = len(self.parts) - 1
        self._check_sides(group)
        # found here, since nobody can look at how components move while a graph is traced
        self._by_key = [_by_key(*part) for part in self.parts]
        self._places = [
            _places(each, int(len(names) > 1))
            for each, (names, _) in zip(self._by_key, self.parts, strict=True)
        ]
        self._followers: dict[tuple[NestedKey, torch.Size, NestedKey | None], Part | None] = {}

    @property
    def keys(self) -> list[NestedKey]:
        """The declared keys, in their shortest spelling."""
        return list(self.position)

    def part(self, key: NestedKey) -> Part | None:
        """What is mapped together with an entry, now or ``"next"``; None if it is not declared."""
        bare = without_next(key)
        if bare not in self.position:
            return None
        names, representation = self.parts[self.position[bare]]
        return _as_spelled(key, names), representation

    def together(self, key: NestedKey) -> list[NestedKey]:
        """An entry, and those that it changes places with."""
        bare = without_next(key)
        if bare in self.position:
            names = self.parts[self.position[bare]][0]
        else:
            names, _ = self._exchanged(bare) or ([bare], None)
        return [key] if len(names) == 1 else _as_spelled(key, names)

    def mapped(
        self,
        batch: TensorDictBase,
        chosen: Iterable[NestedKey],
        strict: bool,
        followers: Mapping[NestedKey, NestedKey] | None = None,
    ) -> list[Part]:
        """What differs between the copies of a batch, each part once.

        Args:
            batch: what is mapped.
            chosen: entries to look at.
            strict: refuse unknown ones.
            followers: entries that follow an action although their names do not tell.

        Raises:
            KeyError: unknown entries, all of them, if strict; or one without those it changes places with.
            ValueError: an entry of the wrong shape.
        """
        parts: list[Part] = []
        unknown: list[NestedKey] = []
        done: set[NestedKey] = set()
        for key, value in _leaves(batch, chosen):
            part = self.part(key)
            if value is None and part is None and not (is_per_row(key) or is_bookkeeping(key)):
                unknown += [] if key in (followers or {}) else [key]  # misspelt, most likely
                continue
            if value is None or key in done:
                continue
            if part is not None:
                _check_events(batch, *part)
                parts.append(part)
                done |= set(part[0])
                continue
            event = value.shape[batch.batch_dims :] if isinstance(value, Tensor) else None
            try:
                part = self._follower(key, event, (followers or {}).get(key))
            except _Unknown:
                unknown += [key] if strict else []
                continue
            if part is not None:
                names = _as_spelled(key, part[0])
                _check_events(batch, names, part[1])
                parts.append((names, part[1]))
                done |= set(names)
        if unknown:
            raise KeyError(
                f"the batch has {unknown}, which this symmetry does not know (it has {self.keys}); add "
                "their representations, e.g. invariant(group, d) for what no element changes, exclude "
                "them from the batch, or pass strict=False to copy unknown entries unchanged"
            )
        return parts

    def _follower(self, key: NestedKey, event: torch.Size | None, action: NestedKey | None) -> Part | None:
        """What an entry that is not declared is mapped with, and how; None if copies share it."""
        bare = without_next(key)
        if action is None and is_bookkeeping(bare):
            return None
        if event is None:  # no tensor: a text, an object
            raise _Unknown
        if (bare, event, action) not in self._followers:
            self._followers[bare, event, action] = self._find_follower(bare, event, action)
        return self._followers[bare, event, action]

    def _find_follower(self, bare: NestedKey, event: torch.Size, action: NestedKey | None) -> Part | None:
        parent, leaf = split(bare)
        beside = join(parent, "action")
        output = beside in self.position and leaf in (*_SIGNED, *_UNSIGNED)
        if not output and action is None and not is_per_row(bare):
            raise _Unknown

        exchanged = self._exchanged(bare)
        if exchanged is not None:
            names, position = exchanged
            representation = self._by_key[position]
            if output and event != torch.Size(representation.event_shape[1:]):
                raise _Unknown
            signed = output and leaf in _SIGNED
            return names, representation if signed else self._follow(bare, position, event)

        if output:
            position = self.position[beside]
            representation = self.parts[position][1]
            if event != torch.Size(representation.event_shape):
                raise _Unknown
            return [bare], representation if leaf in _SIGNED else self._follow(bare, position, event)
        if event in (torch.Size([]), torch.Size([1])):
            return None  # one number per row
        if action is None and leaf.startswith("_"):
            raise _Unknown  # private numbers of the action's size may well change sign
        named = [join(parent, leaf.removesuffix("_log_prob")), beside, *self._only_action()]
        for candidate in [action] if action is not None else named:
            if candidate in self.position:
                return [bare], self._follow(bare, self.position[candidate], event)
        raise _Unknown

    def _follow(self, bare: NestedKey, position: int, event: torch.Size) -> Representation:
        """How one value for each component or item of an action changes place with it.

        Raises:
            _Unknown: the shape is that of no components or items of the action.
            KeyError: the action mixes its components.
        """
        found = self._places[position].get(event)
        if found is None:
            raise _Unknown
        if isinstance(found, Representation):
            return found
        raise KeyError(
            f"the batch has {bare!r} with one value for each component of the action, {tuple(event)}, but "
            "the action's representation mixes components, which carries no such value to another; use a "
            "distribution with one log-probability per action (IndependentNormal), exclude the entry "
            "from the batch, or declare it with invariant(group, d) if all its components are equal"
        ) from found

    def _exchanged(self, bare: NestedKey) -> tuple[list[NestedKey], int] | None:
        """Entries that change places because those change places that they belong to.

        What belongs to an action by its name, or is in a group that has it: with the left and the right
        hand's action, ``left_log_prob`` or ``("left", "reward")`` become those of the right one.
        """
        own = path(bare)
        together = [position for position, (names, _) in enumerate(self.parts) if len(names) > 1]
        for position in sorted(together, key=lambda p: split(self.parts[p][0][0])[1] != "action"):
            paths = [path(name) for name in self.parts[position][0]]
            scores = [(*parts[:-1], f"{parts[-1]}_log_prob") for parts in paths]
            if own in scores:
                return [unravel_key(other) for other in scores], position
            depth = next(k for k in range(1, 1 + max(map(len, paths))) if _distinct_at(paths, k))
            groups = [parts[:depth] for parts in paths]
            if own[:depth] in groups:
                return [unravel_key((*group, *own[depth:])) for group in groups], position
        return None

    def _only_action(self) -> list[NestedKey]:
        found = [key for key in self.position if split(key)[1] == "action"]
        return found if len(found) == 1 else []

    def _check_sides(self, group: PointGroup) -> None:
        """Refuse entries of two sides that an element must exchange but that are declared one by one."""
        turned = group.matrices.diagonal(dim1=-2, dim2=-1)  # (N, 3), -1 where an axis is reversed
        for here, there, axis in opposites(self.position):
            reversing = (turned[:, axis] < -1 + 1e-9).nonzero().flatten().tolist()
            if reversing and self.position[here] != self.position[there]:
                raise ValueError(
                    f"{here!r} and {there!r} change places under {group.names[reversing[0]]!r}, but each "
                    f"is declared by itself; declare them together: Exchanged({here!r}, {there!r}) with "
                    "items(places, representation), or with the sum of both if they really stay in place"
                )


def _leaves(batch: TensorDictBase, chosen: Iterable[NestedKey]) -> Iterator[tuple[NestedKey, Any]]:
    """Entries by their own keys: a network may read a group of them, as one of several agents does."""
    for key in chosen:
        value = batch.get(key, None)
        if isinstance(value, TensorDictBase):
            yield from ((unravel_key((key, leaf)), each) for leaf, each in value.items(True, True))
        else:
            yield key, value


def require_even(batch: TensorDictBase) -> None:
    """KeyError if only some rows of a lazy stack have an entry: it would be left as it is in copies."""
    uneven = [key for key in uneven_keys(batch) if not is_bookkeeping(without_next(key))]
    if uneven:
        raise KeyError(
            f"only some rows of the batch, a lazy stack, have {uneven}: their copies would not have them "
            "mapped; exclude them, or give them to every row"
        )


def _as_spelled(key: NestedKey, names: list[NestedKey]) -> list[NestedKey]:
    """Names now, or under ``"next"`` as the key is."""
    if unravel_key(key) == without_next(key):
        return names
    return [unravel_key(("next", name)) for name in names]


def _distinct_at(paths: list[tuple[str, ...]], depth: int) -> bool:
    return len({names[:depth] for names in paths}) == len(paths)


def _by_key(names: list[NestedKey], representation: Representation) -> Representation:
    """The representation with an item for each of several keys, if they are declared by their sum."""
    count = len(names)
    if count == 1 or len(representation.event_shape) > 1 or representation.dim % count:
        return representation
    return representation.unflatten((count, representation.dim // count))


def _places(action: Representation, keys: int) -> dict[torch.Size, Representation | ValueError]:
    """How components of an action, or its items, change places: for one value of each, by its shape.

    Args:
        action: representation of the action.
        keys: 1 if the first dimension of the action's events is that of its keys.
    """
    shape = action.event_shape
    found: dict[torch.Size, Representation | ValueError] = {}
    for k in range(1, len(shape) + 1) if len(shape) > keys else ():
        try:
            places = action.leading(k)
        except ValueError as error:
            places = error
        for event in (torch.Size(shape[keys:k]), torch.Size((*shape[keys:k], 1))):
            image = places
            if isinstance(places, Representation):
                image = places.unflatten((*shape[:keys], *event))
            if event not in found or len(event) == k - keys:
                found[event] = image
    return found


def _check_events(batch: TensorDictBase, names: list[NestedKey], representation: Representation) -> None:
    values = [batch.get(name, None) for name in names]
    missing = [name for name, value in zip(names, values, strict=True) if value is None]
    if missing:
        raise KeyError(f"the batch lacks {missing}, which change places with others of {names}; keep them")
    for name, value in zip(names, values, strict=True):
        if not isinstance(value, Tensor):
            raise TypeError(f"entry {name!r}: expected a tensor, got {checks.shown(value)}")
    check_events(names, [value.shape[batch.batch_dims :] for value in values], representation)


def check_events(names: list[NestedKey], events: list[torch.Size], representation: Representation) -> None:
    """ValueError unless entries have the event dimensions of their representation."""
    shape = torch.Size(representation.event_shape)
    if len(names) == 1:
        # one item may lie in dimensions of its own, such as the only layer of a memory
        more = events[0][: max(len(events[0]) - len(shape), 0)]
        fits = events[0] == more + shape and more.numel() == 1
        wanted = f"{tuple(shape)}"
    elif len(shape) > 1:
        fits, wanted = events == [shape[1:]] * shape[0], f"{shape[0]} of {tuple(shape[1:])}"
    elif all(event == () for event in events):  # one number for each key
        fits, wanted = len(events) == shape[0], f"{shape[0]} numbers"
    else:
        fits = (
            all(len(event) == 1 for event in events) and sum(event.numel() for event in events) == shape[0]
        )
        wanted = f"vectors of {shape[0]} components together"
    if not fits:
        raise ValueError(
            f"entry {', '.join(map(repr, names))}: expected event dimensions {wanted}, got "
            f"{', '.join(str(tuple(event)) for event in events)}; list every entry of the tensor in order, "
            "and declare agents, frames and other items with items(places, representation)"
        )


def _check_representation(
    key: NestedKey | Exchanged, representation: Representation, group: PointGroup
) -> None:
    if not isinstance(representation, Representation):
        raise TypeError(
            f"expected a Representation for {key!r}, got {type(representation).__name__}; build one with "
            "torchrl_sym.representations, e.g. invariant(group, d)"
        )
    if representation.group != group:
        raise ValueError(
            f"the representation of {key!r} belongs to {representation.group}, expected {group}; build it "
            "for this group or use representation.restrict(group)"
        )


def _checked_key(spelling: NestedKey) -> NestedKey:
    key = checks.key("representations", spelling)
    if without_next(key) != key or key == "next":
        raise ValueError(
            f"expected keys without 'next', got {spelling!r}; declare the entry itself, whose "
            "representation the one under 'next' follows"
        )
    return key
