"""A running normaliser as a transform: TorchRL's VecNormV2, with statistics that every L_g leaves.

What it computes, and why that commutes with the group: :mod:`torchrl_sym.normalization`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import dispatch
from torch import nn
from torchrl.envs import VecNormV2

from torchrl_sym import checks
from torchrl_sym.entries import split
from torchrl_sym.normalization import GroupAverage, working_dtype
from torchrl_sym.symmetry import Symmetry, check_symmetry


class SymmetricVecNorm(VecNormV2):
    """A :class:`~torchrl.envs.VecNormV2` that commutes with every L_g: `check_specs` accepts it.

    It is used in its place, and in every way like it: shared by the workers of a ParallelEnv through an
    EnvCreator, frozen, copied, converted to an ObservationNorm, saved with the environment. It differs in
    its statistics, which are those of the data and their images; they are kept as mean and variance in no
    less than float32, free of the start's bias from the first step on. In a replay buffer it normalises
    an entry and the one under ``"next"`` by the same statistics, which entries of samples update unless it
    is frozen.

    Args:
        in_keys: what to normalise: entries that the symmetry declares, and rewards.
        out_keys: where to write it. Defaults to ``in_keys``.
        symmetry: what transforms how.
        lock: guards the statistics when several processes share them.
        decay: how much a step's weight is of that of the next; 1 for equal weights.
        eps: least deviation to divide by, in units of the entry.
        reduce_batch_dims: share the statistics over the rows of a batched environment; without it each
            row has its own.

    Raises:
        KeyError: an entry that is neither declared nor a reward.

    Example:
        >>> import tasks
        >>> from torchrl.envs import TransformedEnv
        >>> env = tasks.make_env("cartpole", num_envs=4, num_threads=1)
        >>> norm = SymmetricVecNorm(["observation"], symmetry=env.symmetry, reduce_batch_dims=True)
        >>> normalised = TransformedEnv(env, norm)
        >>> env.symmetry.check_specs(normalised)
        >>> _ = normalised.rollout(5)
        >>> norm.loc["observation"]  # every entry of CartPole changes sign in the mirror
        tensor([0., 0., 0.])
    """

    is_symmetric = True
    _loc: Any  # tensordicts, once there are data
    _var: Any
    _count: Any

    def __init__(
        self,
        in_keys: Sequence[NestedKey],
        out_keys: Sequence[NestedKey] | None = None,
        *,
        symmetry: Symmetry,
        lock: Any = None,
        decay: float = 0.9999,
        eps: float = 1e-4,
        reduce_batch_dims: bool = False,
    ) -> None:
        check_symmetry(symmetry)
        keys = [checks.key("in_keys", key) for key in checks.sequence("in_keys", in_keys, "keys")]
        names = keys if out_keys is None else checks.sequence("out_keys", out_keys, "keys")
        if len(names) != len(keys):
            raise ValueError(f"out_keys: expected one for each of {keys}, got {names}")
        super().__init__(
            keys,
            [checks.key("out_keys", name) for name in names],
            lock=lock,
            decay=checks.real("decay", decay, above=0, high=1),
            eps=checks.real("eps", eps, above=0),
            reduce_batch_dims=checks.flag("reduce_batch_dims", reduce_batch_dims),
        )
        rewards = [key for key in keys if key not in symmetry and split(key)[1] == "reward"]
        symmetry.require([key for key in keys if key not in rewards], type(self).__name__)
        self.averages = nn.ModuleList(
            GroupAverage(None if key in rewards else symmetry[key]) for key in keys
        )

    @dispatch(source="in_keys", dest="out_keys")
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Update by a batch, as from a replay buffer, and normalise it, with what is under ``"next"``."""
        out = tensordict.copy()  # not in place: a buffer may hand out what it stores
        current = out.select(*self.in_keys, strict=not self.missing_tolerance)
        following = out.get("next", None)
        with self.lock:
            self._maybe_stateful_init(current[(0,) * current.ndim])
            self._stateful_update(current)
            out.update(self._stateful_norm(current))
            if following is not None:
                following.update(self._stateful_norm(following.select(*self.in_keys, strict=False)))
        return out

    def _maybe_stateful_init(self, data: TensorDictBase) -> None:
        fresh = not self.initialized
        super()._maybe_stateful_init(data)
        if fresh:
            self._loc, self._var = (
                stats.apply(lambda x: x.to(working_dtype(x))) for stats in (self._loc, self._var)
            )

    def _stateful_update(self, data: TensorDictBase) -> None:
        if self.frozen:
            return
        for key, average in zip(self.in_keys, self.averages, strict=True):
            value = data.get(key, None)
            if value is None:  # a reset gives no reward
                continue
            loc, var, count = (stats.get(key) for stats in (self._loc, self._var, self._count))
            rows = value.to(loc).reshape(-1, *loc.shape)  # of one row if each has its own statistics
            total = count.add_(len(rows)).double()
            if self.decay < 1:
                log = math.log(self.decay)
                weight = math.expm1(len(rows) * log) / torch.expm1(total * log)
            else:
                weight = len(rows) / total
            average.merge(loc, var, rows, weight.to(loc))  # pyright: ignore[reportCallIssue]

    def _norm(
        self, data: TensorDictBase, loc: TensorDictBase, var: TensorDictBase, count: TensorDictBase
    ) -> TensorDictBase:
        out = data.empty()
        for key, name in zip(self.in_keys, self.out_keys, strict=True):
            value = data.get(key, None)
            if value is not None:
                scale = var.get(key).sqrt().clamp_min(self.eps)
                normal = (value - loc.get(key)) / scale
                out.set(name, normal.to(value.dtype) if value.is_floating_point() else normal)
        return out

    def _get_loc_scale(self, loc_only: bool = False) -> tuple[TensorDictBase, TensorDictBase | None]:
        scale = None if loc_only else self._var.sqrt().clamp_min(self.eps)
        return self._loc.clone(), scale

    def get_extra_state(self) -> dict[str, Any]:
        if self._loc is not None:  # an EnvCreator gives this state to workers, which fork or are spawned
            for stats in (self._loc, self._var, self._count):
                stats.share_memory_()
        return super().get_extra_state()

    def _apply(self, fn: Any, recurse: bool = True) -> SymmetricVecNorm:
        exact = None if self._loc is None else (self._loc, self._var)
        super()._apply(fn, recurse)
        if exact is not None:  # moved, but not rounded
            moved = (self._loc, self._var)
            self._loc, self._var = (
                old.apply(lambda x, new: x.to(new.device), new)
                for old, new in zip(exact, moved, strict=True)
            )
        return self
