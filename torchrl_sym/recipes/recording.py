"""CUDA graphs: all kernels of a function in one launch.

An update of small networks is some hundred kernels, each of which takes the card less time than the host
needs to ask for it. A graph is asked for once. TorchRL's ``CudaGraphModule`` waits for the card before each
replay; here nobody does.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import TypeVar

import torch
from tensordict import TensorDictBase
from torch import Tensor

T = TypeVar("T")

_WARMUP = 4  # calls until compilers, the optimizer's state and lazily placed tables are settled
_SYNC = "called a synchronizing"  # how torch's warning of an operation that waits begins


class Recorded:
    """A function of batches of one shape, which is recorded after some calls and then replayed.

    Nothing of it may depend on numbers of Python's that change, and it must not wait for the host: the last
    call before the recording is watched, and a function that waits is called as it is, with a warning.

    Args:
        function: takes a batch and returns a tensor; what else it changes, it changes in place.

    Raises:
        RuntimeError: when called, the recording failed, of which a process does not recover.
    """

    def __init__(self, function: Callable[[TensorDictBase], Tensor]) -> None:
        self._function = function
        self._calls = 0
        self._graph: torch.cuda.CUDAGraph | None = None
        self._waits = False

    def __call__(self, batch: TensorDictBase) -> Tensor:
        """What the function returns."""
        if self._waits:
            return self._function(batch)
        if self._graph is None:
            self._calls += 1
            if self._calls <= _WARMUP:
                return self._warm_up(batch)
            self._graph = self._record(batch)
        self._batch.update_(batch)
        self._graph.replay()
        return self._out.clone()  # the next replay writes into it

    def _warm_up(self, batch: TensorDictBase) -> Tensor:
        """Call it beside the default stream, where nothing is left that a graph could depend on."""
        stream, current = torch.cuda.Stream(), torch.cuda.current_stream()
        stream.wait_stream(current)
        with torch.cuda.stream(stream):
            out = self._watch(batch) if self._calls == _WARMUP else self._function(batch)
        current.wait_stream(stream)
        return out

    def _watch(self, batch: TensorDictBase) -> Tensor:
        """Call it, and find out whether it waits for the host."""
        out, waits = host_waits(lambda: self._function(batch))
        if waits:
            self._waits = True
            warnings.warn(
                "compile: training goes on without a CUDA graph, since an update waits for the host "
                f"({waits[0].splitlines()[0]})",
                RuntimeWarning,
                stacklevel=2,
            )
        return out

    def _record(self, batch: TensorDictBase) -> torch.cuda.CUDAGraph:
        self._batch = batch.clone()
        graph = torch.cuda.CUDAGraph()
        try:
            with torch.cuda.graph(graph):
                self._out = self._function(self._batch)
        except RuntimeError as error:
            raise RuntimeError(
                "expected an update that can be recorded into a CUDA graph, got an error after which this "
                f"process cannot go on ({str(error).strip().splitlines()[0]}); start again with "
                "compile=False, it goes on from the last checkpoint"
            ) from error
        return graph


def host_waits(work: Callable[[], T]) -> tuple[T, list[str]]:
    """What some work on CUDA returns, and in torch's words the operations for which the host waits."""
    with warnings.catch_warnings(record=True) as found:
        warnings.simplefilter("always")
        torch.cuda.set_sync_debug_mode("warn")
        try:
            out = work()
        finally:
            torch.cuda.set_sync_debug_mode("default")
    for each in found:
        if _SYNC not in str(each.message) and "debug mode" not in str(each.message):
            warnings.warn_explicit(each.message, each.category, each.filename, each.lineno)
    return out, [str(each.message) for each in found if _SYNC in str(each.message)]
