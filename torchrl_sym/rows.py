"""The rows a symmetric loss works on, and which of them are the originals.

A loss that sees symmetric copies must tell them apart from the samples of the rollout policy: KL, entropy
and effective sample size describe the policy's change only on the originals. With all elements, rows are
group-major and the first block is the originals; with drawn elements, they are the rows that drew the
identity, scattered over the batch.
"""

from __future__ import annotations

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from torchrl_sym.memory import Memory
from torchrl_sym.symmetry import Symmetry


class OrbitRows:
    """All copies of a batch, group-major, the originals first.

    Args:
        symmetry: what transforms how.
        elements: indices of the elements to apply, the identity first.
        td: the original rows, ``[B, ...]``.
        mapped_keys: what differs between copies; they share every other entry.

    Attributes:
        td: the original rows.
        expanded: the rows to evaluate, ``[N * B, ...]``.
        count: number of elements N.
    """

    def __init__(
        self,
        symmetry: Symmetry,
        elements: list[int],
        td: TensorDictBase,
        mapped_keys: list[NestedKey],
        memory: Memory,
    ) -> None:
        self.td = td
        self.count = len(elements)
        orbit = symmetry.orbit(td, elements, keys=mapped_keys)
        self.expanded = memory.rebuild(orbit).reshape(-1, *td.batch_size[1:])

    def originals(self, x):
        """Rows of the identity, of a tensor or tensordict."""
        return x[: len(x) // self.count]

    def report(self, td_out: TensorDictBase, kl: Tensor, clipped: Tensor, log_ratio: Tensor) -> None:
        """Diagnostics of the original rows, and of every element under ``*_sym``, ``(N,)``."""
        values = {
            "kl_approx": kl.detach(),
            "clip_fraction": clipped,
            "mean_ratio": log_ratio.detach().exp(),
        }
        for name, value in values.items():
            td_out.set(name, self.originals(value).mean())
        td_out.set("max_ratio", self.originals(values["mean_ratio"]).max())
        lw = self.originals(log_ratio.detach()).squeeze(-1)
        td_out.set("ESS", _effective_size(lw, 0) / len(lw))
        blocks = log_ratio.detach().reshape(self.count, -1)
        td_out.set("ESS_sym", _effective_size(blocks, 1) / blocks.shape[1])
        for name in ("kl_approx", "clip_fraction"):
            td_out.set(f"{name}_sym", values[name].reshape(self.count, -1).mean(1))


class DrawnRows:
    """One copy per row, under an element drawn uniformly for each.

    Args:
        symmetry: what transforms how.
        td: the original rows, ``[B, ...]``.
        mapped_keys: what differs between copies; they share every other entry.

    Attributes:
        td: the original rows.
        expanded: the rows to evaluate, ``[B, ...]``.
        element: the drawn elements, ``[B, ...]``.
        count: number of elements N.
    """

    def __init__(
        self, symmetry: Symmetry, td: TensorDictBase, mapped_keys: list[NestedKey], memory: Memory
    ) -> None:
        self.td = td
        self.count = symmetry.group.order
        self.element = memory.draw(symmetry, td)
        self.expanded = memory.rebuild(symmetry(td, self.element, keys=mapped_keys), self.element)

    def originals(self, x):
        """All rows, weighted so that their mean is that of the rows that drew the identity."""
        drawn = (self.element == 0).to(torch.get_default_dtype())
        weight = drawn / drawn.mean().clamp_min(1 / drawn.numel())
        return x * weight.reshape(weight.shape + (1,) * (x.ndim - weight.ndim))

    def report(self, td_out: TensorDictBase, kl: Tensor, clipped: Tensor, log_ratio: Tensor) -> None:
        """Diagnostics of the rows that drew the identity, and of every element, ``(N,)``."""
        lw = log_ratio.detach().squeeze(-1)  # may have more dimensions (agents) than the batch
        element = self.element.reshape(self.element.shape + (1,) * (lw.ndim - self.element.ndim)).expand_as(
            lw
        )
        index = torch.arange(self.count, device=lw.device)
        member = element.flatten() == index[:, None]  # (N, rows)
        size = member.sum(1).clamp_min(1)
        values = torch.stack([kl.detach().squeeze(-1), clipped.squeeze(-1), lw.exp()]).flatten(1)
        kl_sym, clip_sym, ratio_sym = values @ member.to(values.dtype).mT / size
        ess = _effective_size(torch.where(member, lw.flatten(), -torch.inf), 1)
        own = lw.masked_fill(element != 0, -torch.inf)
        own_ess = _effective_size(own, 0) / own.isfinite().sum(0).clamp_min(1)
        td_out.set("kl_approx", kl_sym[0])
        td_out.set("clip_fraction", clip_sym[0])
        td_out.set("mean_ratio", ratio_sym[0])
        td_out.set("max_ratio", own.max().exp())
        td_out.set("ESS", own_ess.nan_to_num())
        td_out.set("kl_approx_sym", kl_sym)
        td_out.set("clip_fraction_sym", clip_sym)
        td_out.set("ESS_sym", (ess / size).nan_to_num())


def _effective_size(log_weight: Tensor, dim: int) -> Tensor:
    """Effective sample size (sum w)^2 / sum w^2, in log space."""
    return (2 * log_weight.logsumexp(dim) - (2 * log_weight).logsumexp(dim)).exp()
