"""Where the vertical axis stands that the group acts about.

An element acts as x -> R x + (I - R) o. With p' the image of p, (I - R) o = p' - R p: every tree on the
world, taken for the image of one of them, proposes a place of the axis, or of its plane. The proposal that
fits best is then moved to where all joints agree.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from typing import TypeAlias

import numpy as np

from torchrl_sym.mujoco.derive.pairing import Misfit, Pairing
from torchrl_sym.mujoco.derive.parts import Parts
from torchrl_sym.mujoco.model.types import BALL, HINGE, Array

Matching: TypeAlias = tuple[Pairing, dict[int, int]]  # of one element, with the images of links
_MOST = 64  # places that are tried at most
_BETTER = 0.1  # a place other than the origin must fit so much better, if the origin fits


def find_axis(parts: Parts, matrices: Array, tolerance: float) -> tuple[Array, float]:
    """The place (x, y, 0) of the axis, and how well the trees on the world fit there, in tolerances."""
    best, misfit = np.zeros(3), fit(parts, matrices, np.zeros(3), tolerance)
    if misfit <= 1e-6 or not parts.fixed:
        return best, misfit
    limit = _BETTER * misfit if misfit <= 1 else np.inf
    for place in _proposals(parts, matrices):
        refined = place + center(_matchings(parts, matrices, place))
        for o in (place, refined):
            found = fit(parts, matrices, o, tolerance)
            if found < min(misfit, limit):
                best, misfit = np.round(o, 12), found
        if misfit <= 1e-6:
            break
    return best, misfit


def fit(parts: Parts, matrices: Array, place: Array, tolerance: float) -> float:
    """The worst misfit of all trees on the world about an axis, in tolerances."""
    parts = _about(parts, place)
    if not all(_near(parts, matrix, tolerance) for matrix in matrices):
        return np.inf
    return max((worst_of(*found, tolerance).size for found in _matchings(parts, matrices)), default=0.0)


def worst_of(pairing: Pairing, images: dict[int, int], tolerance: float) -> Misfit:
    """The worst of a matching of the trees on the world, those without image included."""
    missing = [b for b in pairing.parts.fixed if b not in images]
    return Misfit(np.inf, "missing", missing[0], 0) if missing else pairing.worst(images, tolerance)


def center(matchings: Iterable[Matching]) -> Array:
    """By how much an axis has to be moved so that joints come to lie on their images, at best."""
    rows, values = [np.zeros((0, 2))], [np.zeros(0)]
    for pairing, images in matchings:
        model, parts, matrix = pairing.model, pairing.parts, pairing.matrix
        for a, b in images.items():
            if a == 0 or a in parts.carried:
                continue
            for i, j in pairing.joints_to(a, b).items():
                kind = int(model.jnt_type[i])
                if kind not in (HINGE, BALL) or int(model.jnt_type[j]) != kind:
                    continue
                across = np.eye(3)
                if kind == HINGE:
                    across -= np.outer(parts.axes[j], parts.axes[j])
                gap = parts.anchors[j] - matrix @ parts.anchors[i]
                rows.append((across @ (np.eye(3) - matrix))[:, :2])
                values.append(across @ gap)
    moved = np.linalg.lstsq(np.concatenate(rows), np.concatenate(values), rcond=1e-6)[0]
    return np.array([*moved, 0.0])


def _about(parts: Parts, place: Array) -> Parts:
    return parts.about({b: np.asarray(place) for b in parts.fixed})


def _matchings(parts: Parts, matrices: Array, place: Array | None = None) -> Iterator[Matching]:
    parts = parts if place is None else _about(parts, place)
    for matrix in matrices:
        pairing = Pairing(parts, matrix)
        yield pairing, pairing.images(0, 0, only=parts.fixed)


def _near(parts: Parts, matrix: Array, tolerance: float) -> bool:
    """Whether each link's image has a link nearby: quickly said, and of most places it is not so."""
    links = [b for tree in parts.fixed for b in parts.tree(tree)]
    mine, theirs = parts.centers[[b for b in links if parts.links[b].mass > 0]], parts.centers[links]
    apart = np.linalg.norm((mine @ matrix.T)[:, None] - theirs, axis=-1)
    sizes = np.array([parts.size(b) for b in links if parts.links[b].mass > 0])
    return bool((apart.min(axis=1, initial=np.inf) <= 10 * tolerance * sizes).all())


def _proposals(parts: Parts, matrices: Array) -> list[Array]:
    """Places where the tree with the most mass would be the image of one like it, or of itself."""
    masses = {b: sum(parts.links[x].mass for x in parts.tree(b)) for b in parts.fixed}
    centers = {b: parts.data.subtree_com[b] for b in parts.fixed}
    first = max(masses, key=lambda b: masses[b])
    like = [b for b in parts.fixed if abs(masses[b] - masses[first]) <= 0.2 * masses[first]]
    found: list[Sequence[tuple[Array, Array]]] = []
    for matrix in matrices:
        equations = (np.eye(3) - matrix)[:2, :2]
        found.append([(equations, (centers[b] - matrix @ centers[first])[:2]) for b in like])
    independent = _independent(matrices)
    places = []
    for choice in itertools.islice(itertools.product(*(found[k] for k in independent)), _MOST):
        rows, values = (np.concatenate([part[k] for part in choice]) for k in (0, 1))
        places.append(np.array([*np.linalg.lstsq(rows, values, rcond=1e-6)[0], 0.0]))
    return places


def _independent(matrices: Array) -> list[int]:
    """Elements that together determine the axis: one turn, or reflections in two planes, or one."""
    turns = [k for k, m in enumerate(matrices) if np.linalg.det(m) > 0]
    if turns:
        return turns[:1]
    return list(range(min(len(matrices), 2)))
