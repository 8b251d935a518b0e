"""Why an entry has no image: what its image looks like instead."""

from __future__ import annotations

import numpy as np

from torchrl_sym.mujoco.model.types import Array

_NEAR = 0.02  # relative distance at which an entry is nearly another


def reason_of(data: Array, image: Array, index: int, margin: float, labels: list[str]) -> tuple[float, str]:
    """Relative distance from the nearest entry, and what the image looks like.

    Args:
        data: all entries of the key, ``(n, d)``.
        image: the entry's image, ``(n,)``.
        index: of the entry.
        margin: the largest difference that counts as none.
        labels: what entries seem to be.
    """
    scale = max(float(np.abs(image).max(initial=0.0)), 1e-12)
    off = np.stack([np.abs(image[:, None] - s * data).max(axis=0) for s in (1.0, -1.0)])  # (2, d)
    sign, nearest = np.unravel_index(int(off.argmin()), off.shape)
    residual = float(off.min()) / scale
    name = f"{'-' * int(sign)}[{int(nearest)}]"
    name += f" ({labels[int(nearest)]})" if labels[int(nearest)] else ""

    if np.ptp(data[:, index]) <= margin and np.ptp(image) <= margin:
        return residual, f"it is constant, but another constant in mirrored states ({image[0]:.4g})"
    slope, offset, j, gap = _line(data, image)
    if gap <= 10 * margin and j >= 0 and (abs(offset) > margin or abs(abs(slope) - 1) > 1e-6):
        where = f"[{j}]" + (f" ({labels[j]})" if labels[j] else "")
        if abs(abs(slope) - 1) < 1e-6:
            sort = f"{'-' * (slope < 0)}{where} plus {offset:.4g}"
            return residual, f"its image is {sort}; observe it relative to a symmetric pose"
        return residual, f"its image is {slope:.4g} times {where}; scale both alike"
    if residual < _NEAR:
        return residual, (
            f"its image is nearly {name}, off by {residual:.1g}: the model, its solver or its contacts are "
            "not quite symmetric"
        )
    same = np.abs(np.abs(image[:, None]) - np.abs(data)).max(axis=0)
    if same.min() <= margin:
        j = int(same.argmin())
        return residual, (
            f"its image is [{j}] up to a sign that changes from state to state (an absolute value, or a "
            "quaternion, whose sign is arbitrary: observe a rotation matrix)"
        )
    if len(data) > 2 * data.shape[1]:
        design = np.concatenate([data, np.ones((len(data), 1))], axis=1)
        solution = np.linalg.lstsq(design, image, rcond=1e-9)[0]
        if np.abs(design @ solution - image).max() <= 100 * margin:
            return residual, (
                "its image is a mixture of entries, but not an orthogonal one, or with an offset; observe "
                "its parts in one unit, relative to a symmetric pose"
            )
    return residual, f"no entry or mixture is its image; nearest is {name}, off by {residual:.2g}"


def _line(data: Array, image: Array) -> tuple[float, float, int, float]:
    """The entry of which the image is most nearly a linear function: slope, offset, which, how far off."""
    centered, wanted = data - data.mean(axis=0), image - image.mean()
    power = (centered**2).sum(axis=0)
    slopes = np.where(power > 1e-18, (wanted @ centered) / power.clip(min=1e-18), 0.0)
    gaps = np.abs(wanted[:, None] - slopes * centered).max(axis=0)
    gaps[power <= 1e-18] = np.inf
    j = int(gaps.argmin())
    offset = float(image.mean() - slopes[j] * data[:, j].mean())
    return float(slopes[j]), offset, j if np.isfinite(gaps[j]) else -1, float(gaps[j])
