"""Running normalisation in the recipe: of what the networks read, and of the reward.

What the networks read is counted once per iteration, after the update: the networks that collect the data
of an iteration are then those that learn from it, and the probability ratios of its first step are one.

Of the reward only the scale is changed, by the standard deviation of the running discounted return (as in
gymnasium and rsl_rl): the better reward stays the better one, and a symmetric task stays symmetric.
"""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from torchrl_sym.normalization import GroupAverage, SymmetricNorm

_LEAST_STD = 1e-8  # of a return: a task that has paid nothing yet


def observe(network: TensorDictModuleBase, data: TensorDictBase) -> None:
    """Add what a network reads of a batch to the statistics of its normaliser, if it has one."""
    for module in network.modules():
        if isinstance(module, SymmetricNorm):
            module.update(*(data[key] for key in network.in_keys))


class RewardScale(nn.Module):
    """Rewards in units of the standard deviation of the discounted return so far.

    The return of every environment is followed through time and across batches,
    ``R_t = gamma R_{t-1} + r_t``, from zero in every episode.

    Args:
        num_envs: number of environments.
        gamma: discount.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> reward, done = torch.tensor([[[2.0], [-2.0]]]), torch.tensor([[[True], [True]]])
        >>> data = TensorDict(
        ...     next=TensorDict(reward=reward, done=done, batch_size=[1, 2]), batch_size=[1, 2]
        ... )
        >>> RewardScale(num_envs=1, gamma=0.9)(data)["next", "reward"].flatten()
        tensor([ 1., -1.])
    """

    running: Tensor
    mean: Tensor
    var: Tensor
    count: Tensor

    def __init__(self, num_envs: int, gamma: float) -> None:
        super().__init__()
        self.gamma = gamma
        self.average = GroupAverage(None)  # no element changes a return
        self.register_buffer("running", torch.zeros(num_envs, dtype=torch.float64))
        self.register_buffer("mean", torch.zeros((), dtype=torch.float64))
        self.register_buffer("var", torch.zeros((), dtype=torch.float64))
        self.register_buffer("count", torch.zeros((), dtype=torch.int64))

    @torch.no_grad()
    def forward(self, data: TensorDictBase) -> TensorDictBase:
        """Follow the returns of a batch ``[*env, T]``; returns a shallow copy with scaled rewards."""
        reward = data["next", "reward"]
        rewards, dones = (data["next", key].reshape(len(self.running), -1) for key in ("reward", "done"))
        returns = []
        for step, done in zip(rewards.to(self.running).unbind(1), dones.unbind(1), strict=True):
            returns.append(self.gamma * self.running + step)
            self.running.copy_(returns[-1].masked_fill(done, 0.0))
        self._add(torch.stack(returns))

        scaled = data.copy()  # with another "next", of the same tensors
        scaled["next", "reward"] = reward / self.var.sqrt().clamp(min=_LEAST_STD).to(reward)
        return scaled

    def _add(self, returns: Tensor) -> None:
        self.count += returns.numel()
        weight = returns.numel() / self.count.double()
        self.average.merge(self.mean, self.var, returns.flatten(), weight)
