"""Which representation transforms which entries of a batch, and all that can be wrong with it.

Most entries are declared by their key. Some are declared together, because they change places; some follow
the action, because an actor or an estimator wrote them beside it; and some are the same for all copies.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping

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
        self._followers: dict[tuple[NestedKey, torch.Size], Representation | None] = {}

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
        if unravel_key(key) != bare:
            names = [join(("next", *split(name)[0]), split(name)[1]) for name in names]
        return names, representation

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
        for key in _leaves(batch, chosen):
            value = batch.get(key, None)
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
                follower = self._follower(key, event, (followers or {}).get(key))
            except _Unknown:
                unknown += [key] if strict else []
                continue
            if follower is not None:
                parts.append(([key], follower))
        if unknown:
            raise KeyError(
                f"the batch has {unknown}, which this symmetry does not know (it has {self.keys}); add "
                "their representations, e.g. invariant(group, d) for what no element changes, exclude "
                "them from the batch, or pass strict=False to copy unknown entries unchanged"
            )
        return parts

    def _follower(
        self, key: NestedKey, event: torch.Size | None, action: NestedKey | None
    ) -> Representation | None:
        """Representation of an entry that is not declared; None if copies share it."""
        bare = without_next(key)
        if action is None and is_bookkeeping(bare):
            return None
        if event is None:  # no tensor: a text, an object
            raise _Unknown
        if (bare, event) not in self._followers:
            self._followers[bare, event] = self._find_follower(bare, event, action)
        return self._followers[bare, event]

    def _find_follower(
        self, bare: NestedKey, event: torch.Size, action: NestedKey | None
    ) -> Representation | None:
        parent, leaf = split(bare)
        beside = join(parent, "action")
        if beside in self.position and leaf in (*_SIGNED, *_UNSIGNED):
            representation = self.parts[self.position[beside]][1]
            if event != torch.Size(representation.event_shape):
                raise _Unknown
            return representation if leaf in _SIGNED else _places(bare, representation, event)

        if action is None and not is_per_row(bare):
            raise _Unknown
        if event in (torch.Size([]), torch.Size([1])):
            return None  # one number per row
        named = [join(parent, leaf.removesuffix("_log_prob")), beside, *self._only_action()]
        for candidate in [action] if action is not None else named:
            if candidate in self.position:
                return _places(bare, self.parts[self.position[candidate]][1], event)
        raise _Unknown

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


def _leaves(batch: TensorDictBase, chosen: Iterable[NestedKey]) -> Iterator[NestedKey]:
    """Entries by their own keys: a network may read a group of them, as one of several agents does."""
    for key in chosen:
        value = batch.get(key, None)
        if isinstance(value, TensorDictBase):
            yield from (unravel_key((key, leaf)) for leaf in value.keys(True, True))
        else:
            yield key


def require_even(batch: TensorDictBase) -> None:
    """KeyError if only some rows of a lazy stack have an entry: it would be left as it is in copies."""
    uneven = [key for key in uneven_keys(batch) if not is_bookkeeping(without_next(key))]
    if uneven:
        raise KeyError(
            f"only some rows of the batch, a lazy stack, have {uneven}: their copies would not have them "
            "mapped; exclude them, or give them to every row"
        )


def _places(bare: NestedKey, action: Representation, event: torch.Size) -> Representation:
    """How the components of an action, or its items, change places: for one value of each.

    Raises:
        _Unknown: the shape is that of no components or items of the action.
        KeyError: the action mixes its components.
    """
    shape = torch.Size(action.event_shape)
    items = event if event == shape[: len(event)] else event[:-1]
    if not items or items != shape[: len(items)] or event[len(items) :] not in ((), (1,)):
        raise _Unknown
    try:
        return action.leading(len(items)).unflatten(event)
    except ValueError as error:
        raise KeyError(
            f"the batch has {bare!r} with one value for each component of the action, {tuple(event)}, but "
            "the action's representation mixes components, which carries no such value to another; use a "
            "distribution with one log-probability per action (IndependentNormal), exclude the entry "
            "from the batch, or declare it with invariant(group, d) if all its components are equal"
        ) from error


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
