"""Observations that a manager assembles from terms, as Isaac Lab and mjlab do, and what becomes of them.

An observation manager computes *terms* (base velocity, joint positions, last action, ...) and puts them
together in *groups* (policy, critic), each of which is one tensor, or a dictionary of its terms. A term may
be clipped and scaled, and it may have a history: T frames, the oldest first, either flattened, all frames
of one term before the next term, or as a dimension of their own. Here the representation of every group is
put together in the same way from those of its terms, and what no representation can follow is refused: a
clip or a scale that does not commute with the group, a term that nobody declared, a size that differs.
"""

from __future__ import annotations

import inspect
import itertools
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import NestedKey
from torch import Tensor

from torchrl_sym import checks
from torchrl_sym.entries import Exchanged
from torchrl_sym.representations import Representation, invariant, items
from torchrl_sym.representations.blocks import block_from_terms, join
from torchrl_sym.symmetry import Symmetry

_MAGNITUDES = (1e-2, 1.0, 1e2, 1e4)  # of the values that clips and scales are tried on
_TOLERANCE = 1e-5  # relative; managers keep scales in single precision


@dataclass(frozen=True, eq=False)
class Term:
    """One term of a group of observations.

    Attributes:
        group: name of the group.
        name: of the term.
        shape: event dimensions of what it contributes, its history included.
        cfg: the manager's settings.
    """

    group: str
    name: str
    shape: tuple[int, ...]
    cfg: Any

    @property
    def label(self) -> str:
        """Its name, for messages."""
        return f"{self.group}/{self.name}"

    @property
    def frame(self) -> tuple[int, ...]:
        """Event dimensions without the history; only their product, where that is flattened."""
        frames = self.frames
        if not frames:
            return self.shape
        return (self.shape[0] // frames,) if self.cfg.flatten_history_dim else self.shape[1:]

    @property
    def frames(self) -> int:
        """Length of the history; 0 if there is none."""
        return int(getattr(self.cfg, "history_length", None) or 0)


def observation_manager(env: Any) -> Any:
    """The observation manager of an environment, also of a wrapped one.

    Raises:
        TypeError: it has none.
    """
    for candidate in (env, getattr(env, "unwrapped", None)):
        manager = getattr(candidate, "observation_manager", None)
        if manager is not None:
            return manager
    raise TypeError(
        f"env: expected a manager-based environment, with an observation_manager, got {checks.shown(env)}; "
        "of any other, declare each observation by hand: Symmetry(group, {'policy': ..., 'action': ...})"
    )


def terms_of(manager: Any) -> list[Term]:
    """All terms of an observation manager, in the order in which they are put together."""
    return [
        Term(group, name, tuple(shape), cfg)
        for group, names in manager.active_terms.items()
        for name, shape, cfg in zip(
            names, manager.group_obs_term_dim[group], manager._group_obs_term_cfgs[group], strict=True
        )
    ]


def given_terms(terms: list[Term], given: Mapping[Any, Representation]) -> dict[Term, Representation]:
    """Representations that are given by the name of a term, or by those of its group and itself.

    Raises:
        KeyError: there is no such term.
        TypeError: no mapping, or not to representations.
    """
    checks.mapping("terms", given, "names of terms to representations")
    by_name: dict[Any, list[Term]] = {}
    for term in terms:
        by_name.setdefault(term.name, []).append(term)
        by_name[term.group, term.name] = [term]
    found: dict[Term, Representation] = {}
    for name in sorted(given, key=lambda name: isinstance(name, tuple)):  # the particular ones last
        if name not in by_name:
            raise KeyError(
                f"terms: expected names of terms, or (group, term), got {name!r}; there are "
                f"{[term.label for term in terms]}"
            )
        checks.instance(f"terms[{name!r}]", given[name], Representation)
        found |= dict.fromkeys(by_name[name], given[name])
    return found


def assemble(
    manager: Any,
    representations: Mapping[Term, Representation],
    action: Representation,
    others: Mapping[NestedKey | Exchanged, Representation] | None,
) -> Symmetry:
    """The symmetry of what a manager writes, from the representations of all of its terms.

    Args:
        manager: the observation manager.
        representations: how one frame of every term transforms, in the manager's order.
        action: how the action transforms.
        others: entries that the manager does not write.

    Raises:
        ValueError: a term has another size, or is clipped or scaled such that it does not transform.
    """
    declared: dict[NestedKey | Exchanged, Representation] = {}
    for group, terms in itertools.groupby(representations, key=lambda term: term.group):
        parts = {term.name: _with_history(term, representations[term]) for term in terms}
        if not manager.group_obs_concatenate[group]:
            declared |= {(group, name): part for name, part in parts.items()}
            continue
        dim = getattr(manager, "_group_obs_concatenate_dim", {}).get(group, -1)
        declared[group] = _concatenated(list(parts.values()), dim - 1 if dim > 0 else dim)
    declared["action"] = action

    more = dict(checks.mapping("others", {} if others is None else others, "keys to representations"))
    twice = [key for key in more if key in declared]
    if twice:
        raise ValueError(
            f"others: expected entries that the manager does not write, got {twice}; name their terms"
        )
    return Symmetry(action.group, declared | more)


def _with_history(term: Term, representation: Representation) -> Representation:
    """How all frames of a term transform, if one does so by the representation."""
    flat = term.frames > 0 and term.cfg.flatten_history_dim  # of frames of any number of dimensions
    if (representation.flatten() if flat else representation).event_shape != term.frame:
        raise ValueError(
            f"term {term.label!r}: expected a representation on {term.frame}, the sizes of one frame, got "
            f"{representation}; list every entry of the term in order"
        )
    check_processing(f"term {term.label!r}", representation, _steps(term.cfg))
    if flat:
        return representation.flatten() * term.frames
    if not term.frames:
        return representation
    return items(invariant(representation.group, term.frames), representation)


def _steps(cfg: Any) -> Iterator[tuple[str, Callable[[Tensor], Tensor]]]:
    """What is done to every component of a term, in words and as functions."""
    for modifier in getattr(cfg, "modifiers", None) or ():
        name = getattr(modifier.func, "__name__", type(modifier.func).__name__)
        if inspect.isroutine(modifier.func):
            yield f"modifier {name!r}", lambda x, m=modifier: m.func(x.clone(), **m.params)
        elif not type(modifier.func).__module__.startswith("isaaclab."):  # whose filters are linear
            yield f"modifier {name!r}, which remembers", lambda x: torch.full_like(x, torch.nan)
    if cfg.clip:
        yield f"clip {tuple(cfg.clip)}", lambda x: x.clip(*cfg.clip)
    if cfg.scale is not None:
        scale = torch.as_tensor(cfg.scale, dtype=torch.float64, device="cpu")
        yield f"scale {scale.tolist()}", lambda x: x * scale


def check_processing(
    what: str, representation: Representation, steps: Iterator[tuple[str, Callable[[Tensor], Tensor]]]
) -> None:
    """ValueError unless functions of components commute with a representation: tried, not proven."""
    random = torch.Generator().manual_seed(0)
    values = torch.randn((16, *representation.event_shape), generator=random, dtype=torch.float64)
    for words, step in steps:
        for magnitude in _MAGNITUDES:
            x = magnitude * values
            wrong = (step(representation.orbit(x)) - representation.orbit(step(x))).abs()
            if not (wrong <= _TOLERANCE * magnitude).all():  # NaN fails too
                g = int((~(wrong <= _TOLERANCE * magnitude)).flatten(1).any(1).long().argmax())
                raise ValueError(
                    f"{what}: its {words} does not commute with {representation.group.names[g]!r}: what it "
                    "makes of the image is not the image of what it makes; use the same numbers for "
                    "components that change places, and bounds of equal size for those that change sign"
                )


def _concatenated(parts: list[Representation], dim: int) -> Representation:
    """The representation of tensors that are concatenated along an event dimension."""
    if len(parts) == 1 or all(len(part.event_shape) == 1 for part in parts):
        return sum(parts[1:], start=parts[0])
    starts = itertools.accumulate((part.dim for part in parts), initial=0)
    places = [
        torch.arange(start, start + part.dim, device="cpu").view(part.event_shape)
        for part, start in zip(parts, starts, strict=False)
    ]
    whole = torch.cat(places, dim)
    order = whole.flatten()  # of the components that lie one part after the other
    index, weight = join([join(part.blocks) for part in parts]).terms
    block = block_from_terms(order.argsort()[index[:, order]], weight[:, order])
    return Representation.from_blocks(parts[0].group, [block], event_shape=tuple(whole.shape), check=False)
