"""How environments fare in other processes: what a fork loses, and what is sent travels by value.

`os.fork` copies the memory of a process but none of its other threads. A thread pool in the child waits for
ever: in its next step, and even when it is destroyed. So does any pool that another thread was stepping at
that moment, since its lock stays locked. In every forked child, no pool is therefore destroyed, and whoever
has one is told, to put a `LostThreads` in its place, which raises whatever is asked of it. Results are not
concerned: the child's memory is its own.

Sent to a spawned process, an object is pickled. `torch.multiprocessing` does not pickle a tensor but moves
it to shared memory, so that parent and child would write into each other's episodes. What an environment
changes in place is therefore pickled as arrays, which are copied.
"""

from __future__ import annotations

import ctypes
import functools
import os
import weakref
from collections.abc import Mapping
from typing import Any, NoReturn, Protocol

import numpy as np
import torch
from torch import Tensor


class OwnsThreads(Protocol):
    """Whoever holds a pool of threads."""

    def lose_threads(self) -> None:
        """Called in a forked child, where the pool's threads do not exist."""


class LostThreads:
    """Stands where a pool was; every use of it is an error that says what to do.

    Example:
        >>> LostThreads().step()
        Traceback (most recent call last):
        ...
        RuntimeError: expected physics in the process that made it, got a forked copy of an environment...
    """

    def __getattr__(self, name: str) -> NoReturn:
        raise RuntimeError(
            "expected physics in the process that made it, got a forked copy of an environment or "
            "simulation, whose threads do not exist here; make the environment in the process that uses it "
            "(hand over a function that makes it, or use the start method 'spawn'), or go on with "
            "copy.deepcopy(env), which has threads of its own"
        )


_POOLS: weakref.WeakSet[Any] = weakref.WeakSet()
_OWNERS: weakref.WeakSet[Any] = weakref.WeakSet()


def prepare_for_forks(pool: object, owner: OwnsThreads) -> None:
    """In every process forked from this one, keep a pool for ever and call ``owner.lose_threads()``.

    Args:
        pool: what its threads end with. It may outlive its owner, by a view of its memory.
        owner: who uses it.
    """
    _POOLS.add(pool)
    _OWNERS.add(owner)


def _after_fork() -> None:
    for pool in list(_POOLS):  # a reference that nothing holds, so that no tear-down takes it away
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(pool))
    for owner in list(_OWNERS):
        owner.lose_threads()


os.register_at_fork(after_in_child=_after_fork)


@functools.cache
def _first_renderer() -> int:
    return os.getpid()  # kept by forked children


def refuse_forked_rendering() -> None:
    """RuntimeError in a forked child of a process that has rendered: OpenGL would wait for ever there."""
    if _first_renderer() != os.getpid():
        raise RuntimeError(
            "expected rendering in the process that rendered first, got a forked child of it, where OpenGL "
            "would wait for ever; start processes that render by 'spawn', or before anything is rendered"
        )


def by_value(tensors: Mapping[str, Tensor]) -> dict[str, np.ndarray]:
    """Tensors as arrays, which no pickle shares; back by :func:`from_value`."""
    return {name: x.numpy(force=x.device.type != "cpu") for name, x in tensors.items()}


def from_value(arrays: Mapping[str, np.ndarray], device: torch.device | None = None) -> dict[str, Tensor]:
    """The tensors of :func:`by_value`, in memory of their own."""
    return {name: torch.tensor(x, device=device) for name, x in arrays.items()}


class Generator(torch.Generator):
    """A random generator, on any device, that is pickled by value.

    Example:
        >>> import pickle
        >>> generator = Generator().manual_seed(0)
        >>> twin = pickle.loads(pickle.dumps(generator))
        >>> bool(torch.rand((), generator=generator) == torch.rand((), generator=twin))
        True
    """

    def __reduce__(self) -> Any:
        return _generator, (self.get_state().numpy(), str(self.device))


def _generator(state: np.ndarray, device: str) -> Generator:
    generator = Generator(device)
    generator.set_state(torch.tensor(state))
    return generator
