"""Running normalisers that commute with every L_g, by construction.

The mean and variance that a policy's own data have are not symmetric: the mirror image of a normalised
observation is then not the normalised observation of the mirrored state, and every symmetric copy is wrong.
The statistics of the data and of all their images together are symmetric. They need no images:

    mean      m = 1/N sum_g rho(g) E[x]                    the part that no element changes
    variance  v = mean over a component of E[(x - m)_i^2]  one for all entries that elements exchange or mix

Then ``(rho(g) x - m) / sqrt(v) = rho(g) ((x - m) / sqrt(v))``: rho(g) keeps m, and within a component it
multiplies by one number. Where the group acts by signed permutations, m and v are exactly the mean and the
variance of the augmented data; of entries that it mixes, v is the mean of their variances.

:class:`SymmetricNorm` belongs inside networks, which then take the raw observation.
:class:`~torchrl_sym.SymmetricVecNorm` is a transform.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from torchrl_sym import checks
from torchrl_sym.representations import Representation


class GroupAverage(nn.Module):
    """What averaging over the group does to a mean and to a variance; on the last dimensions of a tensor.

    Args:
        representation: how the entries transform; None if no element changes them.
    """

    labels: Tensor
    sizes: Tensor

    def __init__(self, representation: Representation | None) -> None:
        super().__init__()
        self.representation = representation
        none = torch.zeros(0, dtype=torch.int64)
        labels = none if representation is None else representation.components.clone()
        self.register_buffer("labels", labels, persistent=False)
        self.register_buffer("sizes", labels.bincount(), persistent=False)

    def mean(self, mean: Tensor) -> Tensor:
        """The part that no element changes."""
        return mean if self.representation is None else self.representation.orbit(mean).mean(0)

    def pool(self, variance: Tensor) -> Tensor:
        """The same number for all entries of a component: the mean of theirs."""
        if self.representation is None:
            return variance
        flat = variance.reshape(-1, len(self.labels))
        sums = flat.new_zeros(len(flat), len(self.sizes)).index_add_(-1, self.labels, flat)
        return (sums / self.sizes)[:, self.labels].reshape(variance.shape)

    def moments(self, rows: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and variance of rows, along the first dimension, and of all their images together."""
        own = rows.mean(0)
        mean = self.mean(own)
        return mean, self.pool(rows.var(0, correction=0) + (own - mean) ** 2)

    def merge(self, mean: Tensor, variance: Tensor, rows: Tensor, weight: Tensor | float) -> None:
        """Move statistics, in place, by a weight towards those of rows (Chan et al., 1979)."""
        new_mean, new_variance = self.moments(rows)
        step = new_mean - mean
        mean.add_(weight * step)
        variance.add_(weight * self.pool(step**2)).mul_(1 - weight).add_(weight * new_variance)


class SymmetricNorm(nn.Module):
    """Running normalisation inside networks: the observation stays raw, and a policy's file contains it.

    In every way what rsl_rl calls an empirical normalisation, but for its statistics, which are those of
    the data and their images under the group: ``f(rho(g) x) = rho(g) f(x)`` for every element, always.
    In training mode nothing is updated by itself: call :meth:`update` once with new data, or construct it
    with ``update_in_forward=True``. A loss that expands a network (SAC, TD3, REDQ) trains copies of it,
    whose statistics neither reaches reliably: there, normalise by a :class:`~torchrl_sym.SymmetricVecNorm`.

    Args:
        *representations: how each input transforms; as many as :meth:`forward` gets inputs.
        eps: added to the deviation, so that constant entries stay finite; in units of the inputs.
        until: number of rows after which the statistics no longer change. None: they always do.
        update_in_forward: in training mode, every call updates the statistics with its inputs first.

    Raises:
        TypeError: an argument of another type.
        ValueError: no representation, of two groups, or a number out of its range.

    Example:
        >>> import torch
        >>> from torchrl_sym import PointGroup
        >>> from torchrl_sym.representations import polar
        >>> norm = SymmetricNorm(polar(PointGroup.reflection("y")))
        >>> norm.update(torch.tensor([[0.0, 1.0, 2.0], [2.0, 3.0, 2.0]]))
        >>> norm.mean, norm.std  # y is as often negative as positive, among data and mirror images
        (tensor([1., 0., 2.], dtype=torch.float64), tensor([1.0000, 2.2361, 0.0000], dtype=torch.float64))
    """

    mean: Tensor
    var: Tensor
    count: Tensor

    def __init__(
        self,
        *representations: Representation,
        eps: float = 1e-2,
        until: int | None = None,
        update_in_forward: bool = False,
    ) -> None:
        super().__init__()
        if not representations:
            raise ValueError("expected at least one representation, got none")
        for representation in representations:
            checks.instance("representations", representation, Representation)
        flat = [representation.flatten() for representation in representations]
        self.eps = checks.real("eps", eps, above=0)
        self.until = None if until is None else checks.whole("until", until, 1)
        self.update_in_forward = checks.flag("update_in_forward", update_in_forward)
        self.average = GroupAverage(sum(flat[1:], start=flat[0]))
        self.shapes = [torch.Size(rep.event_shape) for rep in representations]
        size = len(self.average.labels)
        self.register_buffer("mean", torch.zeros(size, dtype=torch.float64))
        self.register_buffer("var", torch.ones(size, dtype=torch.float64))
        self.register_buffer("count", torch.zeros((), dtype=torch.int64))

    @property
    def std(self) -> Tensor:
        """Standard deviation of every entry, the inputs one after the other."""
        return self.var.sqrt()

    def forward(self, *inputs: Tensor) -> Tensor | tuple[Tensor, ...]:
        """Normalise the inputs ``(*B, *event)``, each in its own precision.

        Returns:
            As many tensors of the same shapes and dtypes; a single one not in a tuple.
        """
        self._check(inputs)
        if self.update_in_forward and self.training:
            self.update(*inputs)
        sizes = [shape.numel() for shape in self.shapes]
        scale = self.std + self.eps
        outputs = []
        for x, shape, m, s in zip(
            inputs, self.shapes, self.mean.split(sizes), scale.split(sizes), strict=True
        ):
            dtype = working_dtype(x)
            y = (x.to(dtype) - m.reshape(shape).to(dtype)) / s.reshape(shape).to(dtype)
            outputs.append(y.to(x.dtype) if x.is_floating_point() else y)
        return outputs[0] if len(outputs) == 1 else tuple(outputs)

    @torch.no_grad()
    def update(self, *inputs: Tensor) -> None:
        """Add rows ``(*B, *event)`` of every input to the statistics."""
        self._check(inputs)
        rows = torch.cat(
            [
                x.reshape(-1, shape.numel()).to(self.mean)
                for x, shape in zip(inputs, self.shapes, strict=True)
            ],
            dim=-1,
        )
        if len(rows) == 0 or (self.until is not None and int(self.count) >= self.until):
            return
        self.count += len(rows)
        self.average.merge(self.mean, self.var, rows, len(rows) / self.count.double())

    def _check(self, inputs: Sequence[Tensor]) -> None:
        events = [x.shape[x.ndim - len(s) :] for x, s in zip(inputs, self.shapes, strict=False)]
        if len(inputs) != len(self.shapes) or events != self.shapes:
            raise ValueError(
                f"expected {len(self.shapes)} inputs with last dimensions {[*map(tuple, self.shapes)]}, "
                f"got {[tuple(x.shape) for x in inputs]}"
            )

    def _apply(self, fn: Any, recurse: bool = True) -> SymmetricNorm:
        """Follow the network's device, not its precision: statistics that are rounded no longer move."""
        exact = {name: getattr(self, name) for name in ("mean", "var")}
        super()._apply(fn, recurse)
        for name, value in exact.items():
            setattr(self, name, value.to(getattr(self, name).device))
        return self

    def extra_repr(self) -> str:
        return f"{[*map(tuple, self.shapes)]}, eps={self.eps}, until={self.until}"


def working_dtype(x: Tensor) -> torch.dtype:
    """At least float32."""
    return torch.promote_types(x.dtype, torch.float32)
