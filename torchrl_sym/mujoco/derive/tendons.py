"""Images of tendons, which are mapped by what they couple.

A fixed tendon is mapped by its joint coefficients, up to a common sign; those of slides that an element
mixes mix. A spatial one is mapped by its path: branches, each in either direction, of sites and of the
spheres and cylinders that it wraps around, on the side that the side site says.
"""

from __future__ import annotations

import numpy as np

from torchrl_sym.mujoco.derive.coordinates import CoordinateMap
from torchrl_sym.mujoco.derive.images import Image, SymmetryError, assign, mixture
from torchrl_sym.mujoco.derive.lengths import coordinate_offsets, is_fixed, tendon_length
from torchrl_sym.mujoco.derive.matching import Matcher
from torchrl_sym.mujoco.derive.paths import links_of_path, path_gap, path_words
from torchrl_sym.mujoco.model.types import Array, MjModel, label_of

_COEFFICIENTS = 0.3  # relative: tendons that couple the same joints nearly alike; the audit says how nearly
_PLACES = 10.0  # tolerances that a path may be off, as for centres of mass
_MISFIT = 1e3  # cost of a pair that cannot be the image of each other


def map_tendons(matcher: Matcher, map_: CoordinateMap, tolerance: float) -> dict[int, Image]:
    """Image of every tendon, with the sign of its length and how far off it is.

    Raises:
        SymmetryError: a tendon couples joints or sites whose images no tendon couples.
    """
    model, count = matcher.model, matcher.model.ntendon
    if matcher.is_identity:
        return {t: Image(t) for t in range(count)}
    lengths = [tendon_length(model, t)[: model.nv] for t in range(count)]
    signs, cost = np.ones((count, count)), np.full((count, count), _MISFIT)
    alike: dict[tuple, list[int]] = {}
    for u in range(count):
        alike.setdefault(_couples(model, u, lengths[u], {}), []).append(u)
    for t in range(count):
        moved = map_.qvel @ lengths[t]
        for u in alike.get(_couples(model, t, moved, matcher.images), ()):
            if is_fixed(model, t):
                gap, signs[t, u] = _coefficient_gap(moved, lengths[u])
                fits = gap <= _COEFFICIENTS
            else:
                gap = path_gap(matcher, t, u)
                fits = gap <= _PLACES * tolerance
            if fits:
                cost[t, u] = gap + 1e-7 * (t != u)  # tendons that are alike stay where they are

    images = {}
    for t, u in assign(cost):
        if cost[t, u] < _MISFIT:
            images[t] = Image(u, float(signs[t, u]), misfit=max(cost[t, u] - 1e-7 * (t != u), 0.0))
        else:
            images[t] = _mixed(matcher, map_, lengths, t)
    shifts = coordinate_offsets(model, map_)
    for image in images.values():
        image.offset = float(lengths[image.index] @ shifts)
    return images


def _couples(model: MjModel, tendon: int, length: Array, images: dict[int, int]) -> tuple:
    """What a tendon and its image have in common: which dofs it couples, or the links that it runs over."""
    if is_fixed(model, tendon):
        return ("fixed", *np.flatnonzero(np.abs(length) > 1e-9).tolist())
    return (
        "spatial",
        *sorted((kind, images.get(link, link)) for kind, link in links_of_path(model, tendon)),
    )


def _coefficient_gap(moved: Array, other: Array) -> tuple[float, float]:
    """Relative distance of two sets of coefficients, and the sign with which it is least."""
    if ((np.abs(moved) > 1e-9) != (np.abs(other) > 1e-9)).any():
        return np.inf, 1.0
    size = max(float(np.linalg.norm(other)), 1e-12)
    gaps = [(float(np.linalg.norm(moved - sign * other)) / size, -sign) for sign in (1.0, -1.0)]
    gap, minus = min(gaps)
    return gap, -minus


def _mixed(matcher: Matcher, map_: CoordinateMap, lengths: list[Array], t: int) -> Image:
    """Image of a tendon of slides that mix."""
    model = matcher.model
    name = label_of(model, "tendon", t)
    if not is_fixed(model, t):
        words = path_words(matcher, t)
        raise SymmetryError(
            f"{name} has no image: no tendon takes the image of its path; {words}"
            "add the missing tendon, or use a smaller group"
        )
    parts = {u: v for u, v in enumerate(lengths) if is_fixed(model, u) and np.linalg.norm(v) > 0}
    weights = mixture(map_.qvel @ lengths[t], parts) if map_.mixed else {}
    if not weights:
        raise SymmetryError(
            f"{name} has no image: no tendon couples the images of what it couples; add the missing "
            "tendon, or use a smaller group"
        )
    sizes = [float(np.linalg.norm(parts[u])) for u in {*weights, t}]
    largest = max(weights, key=lambda u: abs(weights[u]))
    return Image(largest, mixture=weights, misfit=max(sizes) / min(sizes) - 1)
