"""The processes that share one training, as ``torchrun`` starts them.

Each has its part of the environments. What they have collected is put together, so that every process
estimates advantages, normalises and measures on the rows of all of them, with the same result; the same
permutation splits them into minibatches, of which each process takes its share; and gradients are averaged.
So all that is learned, the learning rate too, is the same everywhere, and what one process with all
environments would compute. Only environments and random numbers are a process's own.

Where there are no others, nothing of this does anything.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from typing import Any, TypeVar, cast

import torch
from tensordict import TensorDictBase
from torch import Tensor, distributed

T = TypeVar("T")


class Ranks:
    """The default process group of ``torch.distributed``, or this process alone.

    Numbers of the host are exchanged too: on ``"cuda"``, start the group with the backend
    ``"cpu:gloo,cuda:nccl"``.

    Attributes:
        count: number of processes.
        index: which of them this is.

    Example:
        >>> ranks = Ranks()
        >>> ranks.count, ranks.index, ranks.share("num_envs", 256), ranks.seed(3)
        (1, 0, 256, 3)
    """

    def __init__(self) -> None:
        shared = distributed.is_available() and distributed.is_initialized()
        self.count = distributed.get_world_size() if shared else 1
        self.index = distributed.get_rank() if shared else 0

    def share(self, name: str, whole: int) -> int:
        """The part of a process of so many.

        Raises:
            ValueError: they cannot be divided evenly.
        """
        if whole % self.count:
            raise ValueError(
                f"{name}: expected a multiple of the {self.count} processes that share them, got {whole}; "
                "change it, or start another number of processes (torchrun --nproc-per-node)"
            )
        return whole // self.count

    def seed(self, seed: int) -> int:
        """The seed of this process's environments and exploration: of the first one, that of the run.

        Those of the others belong to no other run: with ``seed + index``, runs of neighbouring seeds would
        have environments in common.
        """
        return random.Random(f"{seed}/{self.index}").getrandbits(63) if self.index else seed

    def gather(self, data: TensorDictBase) -> TensorDictBase:
        """The batches ``[*B]`` of all processes, ``[count, *B]``; if there are no others, this one's."""
        if self.count == 1:
            return data
        return data.apply(self._stack, batch_size=[self.count, *data.batch_size])  # pyright: ignore[reportReturnType]

    def _stack(self, x: Tensor) -> Tensor:
        own = x.contiguous()
        parts = [torch.empty_like(own) for _ in range(self.count)]
        distributed.all_gather(parts, own)
        return torch.stack(parts)

    def average(self, tensors: Sequence[Tensor]) -> None:
        """Replace tensors of one kind, in place, by their means over the processes, in one exchange."""
        if self.count > 1:
            packed = torch.cat([x.reshape(-1) for x in tensors])
            distributed.all_reduce(packed)
            packed /= self.count
            for x, mean in zip(tensors, packed.split([x.numel() for x in tensors]), strict=True):
                x.copy_(mean.reshape(x.shape))

    def adopt(self, x: Tensor) -> Tensor:
        """A tensor, after what the first process has in it was written there."""
        if self.count > 1:
            distributed.broadcast(x, src=0)
        return x

    def first(self, make: Callable[[], T]) -> T:
        """What the first process makes, in all of them; an error of it is raised in all."""
        if self.count == 1:
            return make()
        found: list[Any] = [None, None]
        if self.index == 0:
            try:
                found = [make(), None]
            except Exception as error:
                found = [None, error]
        distributed.broadcast_object_list(found, src=0)
        if found[1] is not None:
            raise found[1]
        return found[0]

    def every(self, own: T) -> list[T]:
        """What each process has, in order."""
        if self.count == 1:
            return [own]
        found: list[Any] = [None] * self.count
        distributed.all_gather_object(found, own)
        return cast("list[T]", found)

    def mean(self, metrics: dict[str, float]) -> dict[str, float]:
        """Means over the processes that have a number to say."""
        if self.count == 1:
            return metrics
        table = torch.tensor([list(each.values()) for each in self.every(metrics)], dtype=torch.float64)
        return dict(zip(metrics, table.nanmean(0).tolist(), strict=True))
