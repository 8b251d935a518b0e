"""Whether an environment's sizes and boxes fit a representation."""

from __future__ import annotations

import torch
from tensordict import NestedKey
from torch import Tensor
from torchrl.data import Bounded, TensorSpec
from torchrl.data.tensor_specs import ContinuousBox

from torchrl_sym.representations import Representation


def check_size(key: NestedKey, spec: TensorSpec, representation: Representation) -> None:
    """ValueError unless the last dimension of a spec is that of its representation."""
    if not spec.shape or spec.shape[-1] != representation.dim:
        raise ValueError(
            f"{key!r}: the environment has shape {tuple(spec.shape)}, expected a last dimension of "
            f"{representation.dim}"
        )


def check_box(key: NestedKey, spec: TensorSpec, representation: Representation) -> None:
    """ValueError unless every element maps the box of a bounded spec onto itself."""
    if not isinstance(spec, Bounded) or not isinstance(spec.space, ContinuousBox):
        return
    bounds = [
        bound.double().cpu().expand(spec.shape).reshape(-1, representation.dim)
        for bound in (spec.space.low, spec.space.high)
    ]
    matrices = representation.matrices.cpu()
    for row in torch.cat(bounds, dim=-1).unique(dim=0):  # environments of a batch share their box
        if row.isnan().any():
            raise ValueError(f"{key!r}: expected a box of numbers, got NaN in its bounds")
        row_low, row_high = row.chunk(2)
        image_low, image_high = image_of_box(matrices, row_low, row_high)  # (N, d)
        wrong = ~(
            torch.isclose(image_low, row_low, atol=1e-6) & torch.isclose(image_high, row_high, atol=1e-6)
        )
        if wrong.any():
            g, i = wrong.nonzero()[0].tolist()
            raise ValueError(
                f"{key!r}: the box of entry {i}, [{row_low[i]:g}, {row_high[i]:g}], is not mapped onto "
                f"itself by {representation.group.names[g]!r}, whose image there is "
                f"[{image_low[g, i]:g}, {image_high[g, i]:g}]; make the box symmetric (actions relative "
                "to a symmetric default pose, equal limits on both sides)"
            )


def image_of_box(matrices: Tensor, low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """Bounds of the images of a box ``(d,)`` under matrices ``(..., d, d)``; 0 * inf counts as 0."""
    ends = [torch.where(matrices == 0, 0.0, matrices * bound) for bound in (low, high)]
    return torch.minimum(*ends).sum(-1), torch.maximum(*ends).sum(-1)
