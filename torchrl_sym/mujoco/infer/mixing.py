"""Images that mix entries: vectors turned by 120 degrees, quaternions, frames that are mounted askew.

If the entries are independent, least squares has one answer. If some depend on others (a sum beside its
terms), it is looked for among few neighbours, as the parts of one vector are.
"""

from __future__ import annotations

import itertools

import numpy as np

from torchrl_sym.groups import PointGroup
from torchrl_sym.mujoco.infer.columns import Flags
from torchrl_sym.mujoco.model.types import Array

_ROOTS = np.sqrt([0.0, 0.25, 0.5, 0.75, 1.0])  # sines of the angles that most groups turn by
_SNAP = 1e-5  # distance from one of them that is taken for noise
_INDEPENDENT = 1e-4  # smallest singular value, of columns of unit length
_WINDOWS = (2, 3, 4, 6, 9)  # entries of planar vectors, vectors, quaternions, two of them, rotations


def least_squares(data: Array, images: Array, margin: Array) -> tuple[Array, Flags]:
    """Matrices ``(N, k, k)`` with ``images[g] = data @ matrices[g].T``, and which rows have none.

    Args:
        data: ``(samples, k)``.
        images: ``(N, samples, k)``.
        margin: largest difference for each entry, ``(k,)``.

    Returns:
        The matrices, and residuals that exceed the margin, ``(N, k)`` bool.
    """
    count, size = len(images), data.shape[1]
    scale = np.linalg.norm(data, axis=0).clip(min=1e-300)
    values = np.linalg.svd(data / scale, compute_uv=False)
    if len(data) > size and values[-1] > _INDEPENDENT:
        flat = np.concatenate(list(images), axis=1)
        solution = np.linalg.lstsq(data / scale, flat, rcond=None)[0] / scale[:, None]
        matrices = solution.T.reshape(count, size, size)
    else:
        matrices = np.stack([_among_neighbours(data, image, margin) for image in images])
    matrices = _snapped(matrices)
    off = np.abs(images - np.einsum("nk,gik->gni", data, matrices)).max(axis=1)
    return matrices, off > margin


def _among_neighbours(data: Array, image: Array, margin: Array) -> Array:
    """Each row from as few adjacent entries as explain it; zeros where none do."""
    size = data.shape[1]
    matrix = np.zeros((size, size))
    for i, wanted in enumerate(image.T):
        windows = (range(s, s + w) for w in (1, *_WINDOWS) for s in range(size - w + 1))
        pairs = itertools.combinations(range(size), 2) if size <= 40 else iter(())
        fits = []
        for places in itertools.chain(windows, pairs):
            columns = list(places)
            solution, *_ = np.linalg.lstsq(data[:, columns], wanted, rcond=None)
            fit = np.abs(data[:, columns] @ solution - wanted).max() <= margin[i]
            if fit and abs(solution @ solution - 1) < _SNAP:
                fits.append((len(columns), i not in columns, abs(columns[0] - i), columns, solution))
                if i in columns:
                    break
        if fits:
            *_, columns, solution = min(fits, key=lambda fit: fit[:3])
            matrix[i, columns] = solution
    return matrix


def _snapped(matrices: Array) -> Array:
    """Entries within 1e-5 of 0, 1/2, sqrt(1/2), sqrt(3/4) or 1 are that number."""
    distance = np.abs(np.abs(matrices)[..., None] - _ROOTS)
    nearest = _ROOTS[distance.argmin(axis=-1)]
    return np.where(distance.min(axis=-1) < _SNAP, np.sign(matrices) * nearest, matrices)


def polished(group: PointGroup, matrices: Array, rounds: int = 8) -> Array:
    """The representation by orthogonal matrices that is nearest to nearly one, ``(N, k, k)``.

    Each matrix is replaced by the mean of ``M(gh) M(h)^T`` over all h, then by the nearest orthogonal one.
    """
    table = group.table.numpy()
    for _ in range(rounds):
        mean = np.einsum("ghij,hkj->gik", matrices[table], matrices) / len(matrices)
        u, _, v = np.linalg.svd(mean)
        matrices = u @ v
    return _snapped(matrices) if np.abs(_snapped(matrices) - matrices).max(initial=0) < 1e-9 else matrices
