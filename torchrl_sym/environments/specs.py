"""Whether an environment's sizes and boxes fit a representation."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey
from torchrl.data import Bounded, TensorSpec
from torchrl.data.tensor_specs import ContinuousBox
from torchrl.envs import EnvBase, InitTracker, RewardSum, StepCounter, Timer, TrajCounter

from torchrl_sym.declaration import check_events
from torchrl_sym.entries import split
from torchrl_sym.environments.inside import transforms_of
from torchrl_sym.representations import Representation


def check_part(
    names: list[NestedKey],
    specs: dict[NestedKey, TensorSpec],
    batch_size: torch.Size,
    representation: Representation,
    bounded: bool,
) -> None:
    """Check entries of an environment that are declared together, mostly a single one.

    Args:
        names: the declared entries.
        specs: those that the environment has.
        batch_size: of the environment.
        representation: theirs.
        bounded: whether their box must be mapped onto itself, also if elements mix its entries.

    Raises:
        KeyError: one is missing.
        ValueError: a size differs, or a box is not symmetric.
    """
    missing = [name for name in names if name not in specs]
    if missing:
        raise KeyError(f"the environment lacks {missing}, which change places with others of {names}")
    found = [specs[name] for name in names]
    check_events(names, [spec.shape[len(batch_size) :] for spec in found], representation)
    if (bounded or representation.is_signed_permutation) and any(map(_has_box, found)):
        key = names[0] if len(names) == 1 else tuple(map(str, names))
        check_box(key, found[0] if len(found) == 1 else _joined(found, representation), representation)


def counter_names(env: EnvBase) -> set[str]:
    """Names under which TorchRL's own counters write observations: copies share them."""
    names: set[str] = set()
    for transform in transforms_of(env):
        if isinstance(transform, StepCounter):
            names.add(transform.step_count_key)
        elif isinstance(transform, InitTracker):
            names.add(transform.init_key)
        elif isinstance(transform, RewardSum | Timer | TrajCounter):
            names |= {split(key)[1] for key in transform.out_keys}
    return names


def _has_box(spec: TensorSpec) -> bool:
    return isinstance(spec, Bounded) and isinstance(spec.space, ContinuousBox)


def _joined(specs: Sequence[TensorSpec], representation: Representation) -> Bounded:
    """The box of entries that change places, as one."""
    bounds = []
    for side, unbounded in (("low", -torch.inf), ("high", torch.inf)):
        ends = [
            getattr(spec.space, side).double().expand(spec.shape)
            if _has_box(spec)
            else torch.full(spec.shape, unbounded, dtype=torch.float64)
            for spec in specs
        ]
        dims = len(representation.event_shape)
        bounds.append(torch.stack(ends, -dims) if dims > 1 else torch.cat(ends, -1))
    return Bounded(*bounds, shape=bounds[0].shape, dtype=torch.float64)


def check_box(key: NestedKey, spec: TensorSpec, representation: Representation) -> None:
    """ValueError unless every element maps the box of a bounded spec onto itself."""
    if not isinstance(spec, Bounded) or not isinstance(spec.space, ContinuousBox):
        return
    vector = representation.flatten()
    bounds = [
        bound.double().cpu().expand(spec.shape).reshape(-1, vector.dim)
        for bound in (spec.space.low, spec.space.high)
    ]
    for row in torch.cat(bounds, dim=-1).unique(dim=0):  # environments of a batch share their box
        if row.isnan().any():
            raise ValueError(f"{key!r}: expected a box of numbers, got NaN in its bounds")
        row_low, row_high = row.chunk(2)
        image_low, image_high = vector.image_of_box(row_low, row_high)  # (N, d)
        wrong = ~(
            torch.isclose(image_low, row_low, atol=1e-6) & torch.isclose(image_high, row_high, atol=1e-6)
        )
        if wrong.any():
            g, i = wrong.nonzero()[0].tolist()
            raise ValueError(
                f"{key!r}: the box of entry {i}, [{row_low[i]:g}, {row_high[i]:g}], is not mapped onto "
                f"itself by {representation.group.names[g]!r}, whose image there is "
                f"[{image_low[g, i]:g}, {image_high[g, i]:g}]; make the box symmetric (actions relative "
                "to a symmetric default pose, equal limits on both sides)"
            )
