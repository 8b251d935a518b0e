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

from torchrl_sym.symmetry import Symmetry


class Rows:
    """All copies of a batch, group-major, or one drawn copy per row.

    Args:
        symmetry: what transforms how.
        elements: indices of the elements to apply, the identity first; None to draw one per row.
        td: the original rows, ``[B, ...]``.
        mapped_keys: what differs between copies; they share every other entry.

    Attributes:
        td: the original rows.
        expanded: the rows to evaluate, ``[N * B, ...]``, or ``[B, ...]`` if drawn.
        element: the drawn elements, ``[B, ...]``; None if all were applied.
        count: number of elements N.
    """

    def __init__(
        self,
        symmetry: Symmetry,
        elements: list[int] | None,
        td: TensorDictBase,
        mapped_keys: list[NestedKey],
    ) -> None:
        self.td = td
        self.count = symmetry.group.order if elements is None else len(elements)
        self.element: Tensor | None = None
        mapped, shared = td.select(*mapped_keys), td.exclude(*mapped_keys)
        if elements is None:
            self.element = torch.zeros(td.batch_size, dtype=torch.long, device=td.device)
            if self.count > 1:  # the trivial group leaves the stream of random numbers as it is
                self.element = torch.randint(self.count, td.batch_size, device=td.device)
            self.expanded = symmetry(mapped, self.element).update(shared)
        else:
            orbit = symmetry.orbit(mapped, elements)
            orbit.update(shared.expand(self.count, *td.batch_size))
            self.expanded = orbit.reshape(-1, *td.batch_size[1:])

    def originals(self, x):
        """Rows of the identity. With drawn elements: all rows, weighted so that the mean is theirs."""
        if self.element is None:
            return x[: len(x) // self.count]
        drawn = (self.element == 0).to(torch.get_default_dtype())
        weight = drawn / drawn.mean().clamp_min(1 / drawn.numel())
        return x * weight.reshape(weight.shape + (1,) * (x.ndim - weight.ndim))

    def _element_of(self, x: Tensor) -> Tensor:
        """The drawn elements in the shape of x, which may have more dimensions (agents) than the batch."""
        assert self.element is not None
        return self.element.reshape(self.element.shape + (1,) * (x.ndim - self.element.ndim)).expand_as(x)

    def report(self, td_out: TensorDictBase, kl: Tensor, clipped: Tensor, log_ratio: Tensor) -> None:
        """Diagnostics of the original rows, and of every element under ``*_sym``, ``(N,)``."""
        log_ratio = log_ratio.detach().squeeze(-1)
        own = self._own(log_ratio)
        ess = (2 * own.logsumexp(0) - (2 * own).logsumexp(0)).exp()
        td_out.set("clip_fraction", self.originals(clipped).mean())
        td_out.set("kl_approx", self.originals(kl.detach()).mean())
        td_out.set("ESS", (ess / own.isfinite().sum(0).clamp_min(1)).nan_to_num())
        td_out.set("max_ratio", own.max().exp())
        td_out.set("mean_ratio", self.originals(log_ratio.exp().unsqueeze(-1)).mean())
        td_out.set("clip_fraction_sym", self._per_element(clipped.squeeze(-1)))
        td_out.set("kl_approx_sym", self._per_element(kl.detach().squeeze(-1)))
        td_out.set("ESS_sym", self._ess_per_element(log_ratio))

    def _own(self, log_ratio: Tensor) -> Tensor:
        if self.element is None:
            return log_ratio[: len(log_ratio) // self.count]
        return log_ratio.masked_fill(self._element_of(log_ratio) != 0, -torch.inf)

    def _blocks(self, x: Tensor, fill: float) -> Tensor:
        """Values by element, ``(N, rows)``; with drawn elements, ``fill`` where another was drawn."""
        if self.element is None:
            return x.reshape(self.count, -1)
        index = torch.arange(self.count, device=x.device)
        return torch.where(self._element_of(x).flatten() == index[:, None], x.flatten(), fill)

    def _rows_per_element(self, x: Tensor) -> Tensor | int:
        if self.element is None:
            return x.numel() // self.count
        return torch.bincount(self._element_of(x).flatten(), minlength=self.count).clamp_min(1)

    def _per_element(self, x: Tensor) -> Tensor:
        return self._blocks(x, 0.0).sum(1) / self._rows_per_element(x)

    def _ess_per_element(self, log_ratio: Tensor) -> Tensor:
        lw = self._blocks(log_ratio, -torch.inf)
        ess = (2 * lw.logsumexp(1) - (2 * lw).logsumexp(1)).exp()
        return (ess / self._rows_per_element(log_ratio)).nan_to_num()
