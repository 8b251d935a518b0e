"""Whether an environment's sizes, boxes and transforms fit a representation."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey
from tensordict.utils import unravel_key
from torchrl.data import Bounded, TensorSpec
from torchrl.data.tensor_specs import ContinuousBox
from torchrl.envs import Compose, EnvBase, TransformedEnv, VecNorm, VecNormV2

from torchrl_sym.representations import Representation


def check_size(key: NestedKey, spec: TensorSpec, representation: Representation) -> None:
    """ValueError unless the last dimensions of a spec are those of its representation."""
    if not representation.fits(spec.shape):
        raise ValueError(
            f"{key!r}: the environment has shape {tuple(spec.shape)}, expected {representation.wanted}"
        )


def check_box(key: NestedKey, spec: TensorSpec, representation: Representation) -> None:
    """ValueError unless every element maps the box of a bounded spec onto itself."""
    if not isinstance(spec, Bounded) or not isinstance(spec.space, ContinuousBox):
        return
    vector = representation.flatten()
    bounds = [
        bound.double().cpu().expand(spec.shape).reshape(-1, vector.dim)
        for bound in (spec.space.low, spec.space.high)
    ]
    for row in torch.cat(bounds, dim=-1).unique(dim=0):  # environments of a batch share their box
        if row.isnan().any():
            raise ValueError(f"{key!r}: expected a box of numbers, got NaN in its bounds")
        row_low, row_high = row.chunk(2)
        image_low, image_high = vector.image_of_box(row_low, row_high)  # (N, d)
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


def check_normalizers(env: EnvBase, keys: Sequence[NestedKey]) -> None:
    """Refuse running normalisers of declared observations, whose statistics are not symmetric."""
    while isinstance(env, TransformedEnv):
        transforms = env.transform if isinstance(env.transform, Compose) else [env.transform]
        for transform in transforms:
            names = {unravel_key(key) for key in (*transform.in_keys, *transform.out_keys)}
            touched = sorted(map(str, names & set(keys)))
            if isinstance(transform, VecNorm | VecNormV2) and touched:
                raise ValueError(
                    f"{type(transform).__name__} normalises {touched} by running statistics, "
                    " which are not symmetric, so that the mirrored observation is not the observation of "
                    "the mirrored state; scale by constants, or normalise inside the networks"
                )
        env = env.base_env
