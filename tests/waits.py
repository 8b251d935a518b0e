"""Waits of the host for an accelerator, found on the CPU; and an environment that has none.

Where a number of a tensor becomes one of Python's, and where the shape of a result depends on numbers, the
host stops until the accelerator has them. On the CPU a dispatch mode sees most of these operations; what it
does not see (`tolist()`, `cpu()`) fails on the device "meta", which has no numbers.
"""

import torch
from tensordict import TensorDict
from torch.utils._python_dispatch import TorchDispatchMode
from torchrl.data import Binary, Composite, Unbounded
from torchrl.envs import EnvBase

WAITS = {
    f"aten::{name}"
    for name in (
        *("_local_scalar_dense", "is_nonzero", "equal", "nonzero", "masked_select"),
        *("unique_dim", "_unique", "_unique2", "repeat_interleave"),
    )
}
INDEXING = {"aten::index", "aten::index_put", "aten::index_put_", "aten::_index_put_impl_"}


class Waits(TorchDispatchMode):
    """Lists the operations that an accelerator would be waited for."""

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = func.name().split(".")[0]
        masks = args[1] if name in INDEXING else ()
        if name in WAITS or any(mask is not None and mask.dtype == torch.bool for mask in masks):
            self.found.append(name)
        return func(*args, **(kwargs or {}))


class Answers(TorchDispatchMode):
    """Answers whoever asks "meta" for a number, while what is looked at only once is prepared."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        if func.name() == "aten::_local_scalar_dense" and args[0].device.type == "meta":
            return 1.0
        return func(*args, **(kwargs or {}))


class Resident(EnvBase):
    """CartPole's specs, on any device; it steps and begins episodes anew without a look at a number."""

    def __init__(self, num_envs: int, device: str = "cpu") -> None:
        super().__init__(device=device, batch_size=[num_envs])
        rows = (num_envs,)
        self.observation_spec = Composite(observation=Unbounded((*rows, 3), device), shape=rows)
        self.action_spec = Unbounded((*rows, 1), device)
        self.reward_spec = Unbounded((*rows, 1), device)
        flags = ("done", "terminated", "truncated")
        kinds = {flag: Binary(1, (*rows, 1), device, torch.bool) for flag in flags}
        self.done_spec = Composite(**kinds, shape=rows)

    def _set_seed(self, seed):
        self.generator = torch.Generator().manual_seed(seed)

    def _state(self, **more):
        noise = torch.rand(*self.batch_size, 3, generator=self.generator).to(self.device)
        over = (noise[:, :1] > 0.8, noise[:, :1] > 2.0, noise[:, :1] > 0.8)
        flags = dict(zip(("done", "terminated", "truncated"), over, strict=True))
        return TensorDict(observation=noise - 0.5, **flags, **more, batch_size=self.batch_size)

    def _reset(self, tensordict=None, **kwargs):
        return self.reset()

    def reset(self, tensordict=None, **kwargs):
        start = self._state()
        return start.update({flag: torch.zeros_like(start[flag]) for flag in self.done_keys})

    def _step(self, tensordict):
        return self._state(reward=-tensordict["action"].square())

    def step_and_maybe_reset(self, tensordict):
        tensordict = self.step(tensordict)
        after = self._step_mdp(tensordict)
        return tensordict, after.update({flag: torch.zeros_like(after[flag]) for flag in self.done_keys})

    def metrics(self):
        return {"success": torch.full((), 0.25, device=self.device), "seconds": 1.0}
