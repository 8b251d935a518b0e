"""A network on entries of a tensordict, at the cost of the network.

TorchRL's losses and collectors call networks through modules that name what is read and written. Its own
``TensorDictModule`` takes whatever a function may return (data frames, files, dictionaries) and looks for
each kind, for a data frame in the folders where Python finds packages: in every call and for every entry,
which is a fortieth of an iteration of a small task. The networks of the recipe return tensors.
"""

from __future__ import annotations

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule, dispatch


class KeyedModule(TensorDictModule):
    """A ``TensorDictModule`` whose network returns a tensor, or a tuple of one per key that is written.

    Args:
        module: takes one tensor per key that is read.
        in_keys: what is read.
        out_keys: what is written.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> value = KeyedModule(torch.nn.Linear(3, 1), ["observation"], ["state_value"])
        >>> value(TensorDict(observation=torch.zeros(4, 3), batch_size=[4]))["state_value"].shape
        torch.Size([4, 1])
    """

    @dispatch(auto_batch_size=False)  # pyright: ignore[reportArgumentType]
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write what the network makes of its entries into the batch."""
        out = self.module(*(tensordict.get(key) for key in self.in_keys))
        values = out if isinstance(out, tuple) else (out,)
        for key, value in zip(self.out_keys, values, strict=True):
            tensordict.set(key, value)
        return tensordict
