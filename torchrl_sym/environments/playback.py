"""Transforms tried out apart from their environment: copies, around one that plays back a script.

What transforms do to an environment's observations and actions is then a function, from given observations
and actions to what comes out: :func:`play`. Its entries are handled as one vector, by a :class:`Layout`.
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.utils import unravel_key
from torch import Tensor
from torch.nn.parameter import is_lazy
from torchrl.data import Composite, NonTensor, TensorSpec
from torchrl.data.tensor_specs import ContinuousBox
from torchrl.envs import Compose, EnvBase, Transform, TransformedEnv, step_mdp

from torchrl_sym.environments.inside import bare


class Layout:
    """Entries of a batch side by side, as one vector for each row.

    Args:
        specs: of the entries; those that are no numbers are left out.
        batch: batch size of the specs.
    """

    def __init__(self, specs: Composite, batch: torch.Size) -> None:
        leaves = {unravel_key(key): spec for key, spec in specs.items(True, True)}
        self.specs = {key: spec for key, spec in leaves.items() if not isinstance(spec, NonTensor)}
        self.events = {key: spec.shape[len(batch) :] for key, spec in self.specs.items()}
        self.sizes = [event.numel() for event in self.events.values()]
        self.dim = sum(self.sizes)
        self.batch = batch

    def draw(self, steps: int, size: float) -> Tensor:
        """Values ``(steps, *batch, dim)`` in the specs' boxes, or of a size where there is none."""
        values = [
            torch.stack([_draw(spec, size) for _ in range(steps)]).reshape(steps, *self.batch, -1)
            for spec in self.specs.values()
        ]
        return torch.cat([torch.zeros(steps, *self.batch, 0, dtype=torch.float64), *values], -1)

    def opposite(self, rows: Tensor) -> Tensor:
        """Values ``(*B, dim)`` that all differ: the other side of the box, or of zero; the other flag."""
        parts = zip(self.specs.values(), rows.split(self.sizes, -1), self.events.values(), strict=True)
        batch = rows.shape[:-1]
        values = [
            _opposite(spec, part.reshape(*batch, *event)).reshape(*batch, -1) for spec, part, event in parts
        ]
        return torch.cat([rows[..., :0], *values], -1)

    def flatten(self, td: TensorDictBase) -> Tensor:
        """Entries ``(*B, *event)`` as ``(*B, dim)``; NaN for missing ones."""
        rows = [torch.zeros(*td.batch_size, 0, dtype=torch.float64)]
        for key, event in self.events.items():
            value = td.get(key, None)
            shape = (*td.batch_size, event.numel())
            fits = isinstance(value, Tensor) and value.shape == (*td.batch_size, *event)
            rows.append(value.double().cpu().reshape(shape) if fits else torch.full(shape, torch.nan))  # pyright: ignore[reportOptionalMemberAccess]
        return torch.cat(rows, -1)

    def split(self, rows: Tensor, keys: Sequence[NestedKey] | None = None) -> TensorDict:
        """``(*B, dim)`` as entries in double precision."""
        batch = rows.shape[:-1]
        parts = zip(self.events.items(), rows.split(self.sizes, -1), strict=True)
        entries = {key: part.reshape((*batch, *event)) for (key, event), part in parts}
        return TensorDict({k: v for k, v in entries.items() if keys is None or k in keys}, batch)

    def cast(self, rows: Tensor) -> TensorDict:
        """``(*B, dim)`` as entries of the specs' dtypes and device."""
        td = self.split(rows)
        for key, spec in self.specs.items():
            value = td.get(key)
            if spec.dtype == torch.bool:
                value = value > 0.5
            elif not spec.dtype.is_floating_point:
                value = value.round()
            td.set(key, value.to(spec.dtype).to(spec.device))
        return td

    def replace(self, rows: Tensor, td: TensorDictBase) -> Tensor:
        """The vector ``(*B, dim)`` with other values for the entries that ``td`` has."""
        new = self.flatten(td)
        return torch.where(self.mask([key for key in self.events if key in td.keys(True, True)]), new, rows)

    def mask(self, keys: Sequence[NestedKey]) -> Tensor:
        """Which of the vector's entries belong to some keys, ``(dim,)``."""
        parts = [torch.full((size,), key in keys) for key, size in zip(self.specs, self.sizes, strict=True)]
        return torch.cat([torch.zeros(0, dtype=torch.bool), *parts])

    def locate(self, index: int) -> tuple[NestedKey, int]:
        """Key, and place in it, of one of the vector's entries."""
        for key, size in zip(self.specs, self.sizes, strict=True):
            if index < size:
                return key, index
            index -= size
        raise IndexError(index)


def _draw(spec: TensorSpec, size: float) -> Tensor:
    if not spec.dtype.is_floating_point:
        return spec.rand().double().cpu()
    free = torch.randn(spec.shape, dtype=torch.float64) * size
    if not isinstance(spec.space, ContinuousBox):
        return free
    low, high, wide = _box(spec.space, spec.shape)
    within = low + torch.rand(spec.shape, dtype=torch.float64) * (high - low)
    return torch.where(wide, free.maximum(low).minimum(high), within)


def _opposite(spec: TensorSpec, value: Tensor) -> Tensor:
    if not spec.dtype.is_floating_point:
        return (value == 0).double()
    if not isinstance(spec.space, ContinuousBox):
        return -value
    low, high, wide = _box(spec.space, spec.shape)
    return torch.where(wide, (-value).maximum(low).minimum(high), low + high - value)


def _box(space: ContinuousBox, shape: torch.Size) -> tuple[Tensor, Tensor, Tensor]:
    """Bounds, and where they are so wide that they say nothing."""
    low, high = (bound.double().cpu().expand(shape) for bound in (space.low, space.high))
    return low, high, (high - low > 1e6) | ~(high - low).isfinite()


class Played(EnvBase):
    """Plays back observations in place of an environment, and keeps the actions it is sent.

    Args:
        env: the environment whose place it takes.
        script: observations, one after the other; the last one stays.
    """

    def __init__(self, env: EnvBase, script: Sequence[TensorDictBase]) -> None:
        super().__init__(device=env.device, batch_size=env.batch_size)
        self.observation_spec = env.full_observation_spec.clone()
        self.full_action_spec = env.full_action_spec.clone()
        self.full_reward_spec = env.full_reward_spec.clone()
        self.full_done_spec = env.full_done_spec.clone()
        self.script, self.time = script, 0
        self.received = TensorDict({}, env.batch_size)

    def _reset(self, tensordict: TensorDictBase | None = None, **kwargs: object) -> TensorDictBase:
        self.time = 0
        return self._now().update(self.full_done_spec.zero())

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        self.received = tensordict.select(*self.action_keys, strict=False)
        self.time += 1
        return self._now().update(self.full_done_spec.zero()).update(self.full_reward_spec.zero())

    def _now(self) -> TensorDictBase:
        return self.script[min(self.time, len(self.script) - 1)].clone()

    def _set_seed(self, seed: int | None) -> None:
        pass


def copies(transforms: Sequence[Transform], env: EnvBase) -> list[Transform]:
    """Copies that share nothing with the transforms of an environment, and belong to none."""
    parts = [m for t in transforms for m in t.modules() if isinstance(m, Transform)]
    owners = [owner for t in parts for owner in (t.container, t.__dict__.get("_parent"))]
    known: dict[int, Any] = {id(owner): None for owner in (*owners, env, bare(env)) if owner is not None}
    for tensor in (x for t in transforms for x in (*t.buffers(), *t.parameters())):
        if is_lazy(tensor):  # not yet of any size, which deepcopy refuses
            kind: Any = type(tensor)
            known[id(tensor)] = kind(device=tensor.device, dtype=tensor.dtype)
    copied = [copy.deepcopy(t, dict(known)) for t in transforms]
    for part in (m for t in copied for m in t.modules() if isinstance(m, Transform)):
        part.reset_parent()
    return copied


def play(
    transforms: Sequence[Transform],
    env: EnvBase,
    observations: Sequence[TensorDictBase],
    actions: Sequence[TensorDictBase],
) -> tuple[TensorDictBase, TensorDictBase]:
    """What transforms make of the last observation, after a reset and some steps, and of the last action.

    Args:
        transforms: the innermost first. They are used, not copied.
        env: the environment inside, of which only the specs are used.
        observations: what it observes, beginning with the reset.
        actions: what is sent to the transforms, one for each further observation.
    """
    played = Played(env, observations)
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore")  # they were given when the environment was made
        around = TransformedEnv(played, Compose(*transforms))  # pyright: ignore[reportArgumentType]
        td = after = around.reset()
        for action in actions:
            stepped = around.step(td.update(action))
            after, td = stepped["next"], step_mdp(stepped)
    for transform in transforms:
        transform.reset_parent()
    return after, played.received
