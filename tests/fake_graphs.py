"""CUDA graphs on the CPU: operations are written down while they are recorded, and repeated in a replay.

As on a card, recording changes nothing, a replay knows no Python (a number that Python computed is that of
the recording for ever), and it reads and writes the very tensors that it was recorded with.
"""

import contextlib
import types
import warnings

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves


def tensors(tree):
    return [x for x in tree_leaves(tree) if isinstance(x, torch.Tensor)]


class FakeGraph(TorchDispatchMode):
    """What records is also what replays."""

    def __init__(self) -> None:
        super().__init__()
        self.operations, self.before = [], {}

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        written = [
            value
            for argument, value in zip(func._schema.arguments, args, strict=False)
            if argument.alias_info is not None and argument.alias_info.is_write
        ]
        for x in tensors(written):
            self.before.setdefault(x.data_ptr(), (x, x.detach().clone()))
        out = func(*args, **kwargs)
        self.operations.append((func, args, kwargs, out))
        return out

    @torch.no_grad()
    def forget(self) -> None:
        """Undo what was done while it recorded, the first change last."""
        for x, before in reversed(self.before.values()):
            x.copy_(before)

    @torch.no_grad()
    def replay(self) -> None:
        for func, args, kwargs, recorded in self.operations:
            for x, new in zip(tensors(recorded), tensors(func(*args, **kwargs)), strict=True):
                if x.data_ptr() != new.data_ptr():
                    x.copy_(new)


@contextlib.contextmanager
def recording(graph: FakeGraph):
    with graph:
        yield
    graph.forget()


class FakeCuda:
    """The part of `torch.cuda` that recording needs; in the mode "warn", `wait()` is what warns there."""

    CUDAGraph = FakeGraph
    graph = staticmethod(recording)
    stream = staticmethod(lambda stream: contextlib.nullcontext())
    mode = "default"

    @staticmethod
    def Stream():
        return types.SimpleNamespace(wait_stream=lambda other: None)

    current_stream = Stream

    @classmethod
    def set_sync_debug_mode(cls, mode):
        cls.mode = mode

    @classmethod
    def wait(cls):
        if cls.mode == "warn":
            warnings.warn("called a synchronizing CUDA operation", UserWarning, stacklevel=2)

    @classmethod
    def install(cls, monkeypatch):
        for name in ("CUDAGraph", "graph", "stream", "Stream", "current_stream", "set_sync_debug_mode"):
            monkeypatch.setattr(torch.cuda, name, getattr(cls, name))
        return cls
