"""A network on entries of a tensordict, at the cost of the network.

TorchRL's losses and collectors call networks through modules that name what is read and written. Its own
``TensorDictModule`` takes whatever a function may return (data frames, files, dictionaries) and looks for
each kind, for a data frame in the folders where Python finds packages: in every call and for every entry,
which is a fortieth of an iteration of a small task. The networks of the recipe return tensors.
"""

from __future__ import annotations

from collections.abc import Sequence

from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase, dispatch
from torch import nn


class KeyedModule(TensorDictModuleBase):
    """A network that reads some entries and writes others.

    Args:
        module: takes one tensor per key that is read; returns a tensor, or a tuple of one per key written.
        in_keys: what is read.
        out_keys: what is written.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> value = KeyedModule(nn.Linear(3, 1), ["observation"], ["state_value"])
        >>> value(TensorDict(observation=torch.zeros(4, 3), batch_size=[4]))["state_value"].shape
        torch.Size([4, 1])
    """

    def __init__(
        self, module: nn.Module, in_keys: Sequence[NestedKey], out_keys: Sequence[NestedKey]
    ) -> None:
        super().__init__()
        self.module = module
        self.in_keys, self.out_keys = list(in_keys), list(out_keys)

    @dispatch(auto_batch_size=False)
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write what the network makes of its entries into the batch."""
        out = self.module(*(tensordict.get(key) for key in self.in_keys))
        values = out if isinstance(out, tuple) else (out,)
        for key, value in zip(self.out_keys, values, strict=True):
            tensordict.set(key, value)
        return tensordict
