"""The copies that a symmetric loss evaluates, and which of their rows are the originals.

A loss that sees symmetric copies must tell them apart from the samples of the rollout policy: KL, entropy
and effective sample size describe the policy's change only on the originals. With all elements, rows are
group-major and the first block is the originals; with drawn elements, they are the rows that drew the
identity, scattered over the batch. Padded rows of a sequence count nowhere.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import torch
from tensordict import LazyStackedTensorDict, NestedKey, TensorDictBase
from torch import Tensor

from torchrl_sym.memory import Memory
from torchrl_sym.symmetry import Symmetry


class Copies:
    """All copies of a batch under some elements, or one copy per row under an element drawn for it.

    Args:
        symmetry: what transforms how.
        originals: the original rows, ``[B, ...]``.
        keys: what differs between copies; they share every other entry.
        followers: entries that follow an action, by its key.
        elements: indices of the elements to apply, the identity first; None to draw one for each row.
        memory: what recurrent networks know of their past.
        mask_keys: entries that say which rows count.

    Attributes:
        td: the original rows.
        expanded: the rows to evaluate, ``[N * B, ...]``, or ``[B, ...]`` if drawn.
        element: the drawn elements, ``[B, ...]``; None with all of them.
        count: number of elements N.
        valid: which of the rows to evaluate are no padding; None if all are.
    """

    def __init__(
        self,
        symmetry: Symmetry,
        originals: TensorDictBase,
        keys: Iterable[NestedKey],
        followers: Mapping[NestedKey, NestedKey],
        elements: Sequence[int] | None,
        *,
        memory: Memory,
        mask_keys: Iterable[NestedKey] = (),
    ) -> None:
        if isinstance(originals, LazyStackedTensorDict):
            originals = originals.contiguous()  # TorchRL's losses read no log-probability from lazy stacks
        self.td = originals
        if elements == [0]:  # there is nothing to copy
            self.count, self.element, self.expanded = 1, None, originals
        elif elements is None:
            self.count = symmetry.group.order
            self.element = memory.draw(symmetry, originals)
            copies = symmetry.per_row(originals, self.element, keys=keys, followers=followers)
            self.expanded = memory.rebuild(copies, self.element)
        else:
            self.count = len(elements)
            self.element = None
            orbit = symmetry.orbit(originals, elements, keys=keys, followers=followers)
            self.expanded = memory.rebuild(orbit).reshape(-1, *originals.batch_size[1:])
        self.valid = valid_rows(self.expanded, mask_keys)
        self._weight = self._counted()

    def originals(self, x):
        """Rows of the identity, of a tensor or tensordict: such that their mean is theirs.

        Drawn rows are all there, weighted by whether they drew the identity.
        """
        own = self._weight
        if self.element is None or own is None:
            return x[: len(x) // self.count]
        own, valid = own[0], self.valid
        share = 1.0 if valid is None else valid.to(own.dtype).mean()
        weight = own * (share / own.mean().clamp_min(1 / own.numel()))
        return x * weight.reshape(weight.shape + (1,) * (x.ndim - weight.ndim))

    def mean(self, x: Tensor) -> Tensor:
        """Mean of a value of all rows, over the originals that count."""
        return self.means(x)[0]

    def means(self, x: Tensor) -> Tensor:
        """Mean over the rows of each element that count, ``(N,)``."""
        values, weight = self._table(x)
        if weight is None:
            return values.flatten(1).mean(1)
        values = torch.where(weight > 0, values, 0)
        return values.flatten(1).sum(1) / weight.flatten(1).sum(1).clamp_min(1)

    def overall_mean(self, x: Tensor) -> Tensor:
        """Mean over all rows that count, copies too."""
        valid = self.valid
        if valid is None:
            return x.mean()
        counted = valid.reshape(valid.shape + (1,) * (x.ndim - valid.ndim)).expand_as(x)
        return torch.where(counted, x, 0).sum() / counted.sum().clamp_min(1)

    def report(self, kl: Tensor, clipped: Tensor, log_ratio: Tensor) -> dict[str, Tensor]:
        """Diagnostics of the original rows, and of every element under ``*_sym``, ``(N,)``."""
        out = {}
        for name, value in (("kl_approx", kl.detach()), ("clip_fraction", clipped)):
            out[f"{name}_sym"] = self.means(value)
            out[name] = out[f"{name}_sym"][0]
        log_ratio = log_ratio.detach().squeeze(-1)
        out["mean_ratio"] = self.mean(log_ratio.exp())

        values, weight = self._table(log_ratio)
        if weight is not None:
            values = values.masked_fill(weight == 0, -torch.inf)
        out["max_ratio"] = values[0].max().exp()
        own, counted = (None, None) if weight is None else (weight[0], weight.flatten(1))
        out["ESS_sym"] = _effective_share(values.flatten(1), counted, 1)
        # over the first dimension, as ClipPPOLoss takes it: of every step of sequences, of every agent
        out["ESS"] = out["ESS_sym"][0] if values.ndim == 2 else _effective_share(values[0], own, 0)
        return out

    def _table(self, x: Tensor) -> tuple[Tensor, Tensor | None]:
        """Values of every element's rows, ``(N, B, ...)``, and whether each counts; None if all do."""
        if self.element is None:
            values = x.unflatten(0, (self.count, -1))
        else:
            values = x.expand(self.count, *x.shape)
        weight = self._weight
        if weight is not None:
            weight = weight.reshape(weight.shape + (1,) * (values.ndim - weight.ndim)).expand_as(values)
        return values, weight

    def _counted(self) -> Tensor | None:
        """1 where a row is one of an element's and no padding, ``(N, B, ...)``; None if all are."""
        if self.element is None:
            counted = None if self.valid is None else self.valid.unflatten(0, (self.count, -1))
        else:
            index = torch.arange(self.count, device=self.element.device)
            counted = self.element == index.reshape(-1, *[1] * self.element.ndim)
            counted = counted if self.valid is None else counted & self.valid
        return None if counted is None else counted.to(torch.get_default_dtype())


def valid_rows(td: TensorDictBase, mask_keys: Iterable[NestedKey]) -> Tensor | None:
    """Which rows are no padding; None if all are."""
    valid = None
    for key in mask_keys:
        mask = td.get(key, None)
        if mask is not None:
            mask = mask.reshape(td.batch_size)
            valid = mask if valid is None else valid & mask
    return valid


def variance(x: Tensor, valid: Tensor | None) -> Tensor:
    """Variance over the first dimension, of the rows that are valid."""
    if valid is None:
        return torch.var(x, correction=0, dim=0)
    counted = valid.reshape(valid.shape + (1,) * (x.ndim - valid.ndim)).to(x.dtype)
    rows = counted.sum(0).clamp_min(1)
    x = torch.where(counted > 0, x, 0)
    return ((x - x.sum(0) / rows).square() * counted).sum(0) / rows


def _effective_share(log_weight: Tensor, counted: Tensor | None, dim: int) -> Tensor:
    """Effective sample size (sum w)^2 / sum w^2, in log space, as a share of the rows that count."""
    size = (2 * log_weight.logsumexp(dim) - (2 * log_weight).logsumexp(dim)).exp()
    if counted is None:
        return size / log_weight.shape[dim]
    rows = counted.sum(dim)
    return torch.where(rows > 0, size / rows.clamp_min(1), 0)
