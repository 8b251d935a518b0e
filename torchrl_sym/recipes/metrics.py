"""What the recipe measures: returns of finished episodes, and how symmetric the policy is."""

from __future__ import annotations

import math
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor
from torchrl.envs import EnvBase

from torchrl_sym.mirror_loss import mirror_error
from torchrl_sym.outputs import deterministic_action
from torchrl_sym.symmetry import Symmetry

SYMMETRY_METRICS = ("mirror_loss", "log_prob", "log_prob_copies")
_MAX_ROWS = 2048  # rows on which the symmetry metrics are evaluated


class Episodes:
    """Undiscounted returns of finished episodes, across iterations.

    The first episode of every environment is left out: it may have started at a random time.

    Args:
        env: the environment whose batches will be seen; its batch size is the number of episodes
            that run side by side.
        processes: with an environment of its own each, whose batches come as one.
    """

    def __init__(self, env: EnvBase, processes: int = 1) -> None:
        self.running = torch.zeros(processes * env.batch_size.numel())
        self.whole = torch.zeros(len(self.running), dtype=torch.bool)  # past their first episode
        self.latest = math.nan

    def update(self, data: TensorDictBase) -> float:
        """Mean return of the episodes that ended in a batch ``[*env, T]``; if none did, the last mean."""
        return self.add(data["next", "reward"].cpu(), data["next", "done"].cpu())

    def add(self, reward: Tensor, done: Tensor) -> float:
        """The same of rewards and ends ``[*env, T, 1]`` that are on the CPU."""
        rewards, dones = (x.reshape(len(self.running), -1) for x in (reward, done))
        finished = []
        for reward, done in zip(rewards.unbind(1), dones.unbind(1), strict=True):
            self.running = self.running + reward
            finished.append(self.running[done & self.whole])
            self.running = self.running.masked_fill(done, 0.0)
            self.whole = self.whole | done
        returns = torch.cat(finished)
        if len(returns):
            self.latest = float(returns.mean())
        return self.latest

    def state_dict(self) -> dict[str, Any]:
        """Returns so far of the running episodes, which of them are whole, and the last mean."""
        return {"running": self.running.clone(), "whole": self.whole.clone(), "latest": self.latest}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a stored state."""
        self.running, self.whole = state["running"].clone(), state["whole"].clone()
        self.latest = state["latest"]


def symmetry_metrics(
    actor: ProbabilisticTensorDictSequential, symmetry: Symmetry, data: TensorDictBase
) -> dict[str, float]:
    """How symmetric a policy is on states it visits.

    Args:
        actor: the policy pi_k that collected the data.
        symmetry: what transforms how.
        data: a batch with observations and actions, of any batch size; at most 2048 rows are used.

    Returns:
        ``mirror_loss``, sum_g || K_g[pi(s)] - pi(L_g[s]) ||^2 (Eq. symm-loss); ``log_prob``, the mean of
        log pi_k(a | s); ``log_prob_copies``, the mean of log pi_k(K_g[a] | L_g[s]) over the copies, the
        denominator of naive augmentation (the paper's log-probability figure).
    """
    means = symmetry_means(actor, symmetry, data)
    return dict(zip(SYMMETRY_METRICS, means.tolist(), strict=True))


@torch.no_grad()
def symmetry_means(
    actor: ProbabilisticTensorDictSequential, symmetry: Symmetry, data: TensorDictBase
) -> Tensor:
    """Values of :func:`symmetry_metrics` in the order of ``SYMMETRY_METRICS``, where the data are."""
    rows = data.select(*actor.in_keys, "action").reshape(-1)
    rows = rows[:: math.ceil(len(rows) / _MAX_ROWS)]
    orbit = symmetry.orbit(rows)
    dist = actor.get_dist(orbit.select(*actor.in_keys))
    log_prob = dist.log_prob(orbit["action"])  # (N, rows)
    copies = log_prob[1:] if len(log_prob) > 1 else log_prob
    action = deterministic_action(dist)  # pi(L_g[s])
    error = mirror_error(action, action[0], symmetry["action"], range(len(action)))
    return torch.stack([error.sum(0).mean(), log_prob[0].mean(), copies.mean()])
