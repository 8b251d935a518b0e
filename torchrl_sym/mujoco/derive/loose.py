"""Where each tree that nothing holds goes, and how it is turned for it.

A free object is the image of one of the same shape, wherever it starts: first of the one whose name says so
(left, right), then of the one that starts where the element sends it, if that is so for all alike; then of
itself.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.optimize import linear_sum_assignment

from torchrl_sym.groups import PointGroup
from torchrl_sym.mujoco.derive.axis import center
from torchrl_sym.mujoco.derive.names import counterparts, exchanged
from torchrl_sym.mujoco.derive.pairing import Pairing
from torchrl_sym.mujoco.derive.parts import Parts
from torchrl_sym.mujoco.derive.turning import Turning
from torchrl_sym.mujoco.model.releases import weld_ids
from torchrl_sym.mujoco.model.types import Array, label_of, name_of

_GOOD = 1e-4  # a fit below this, in tolerances, needs no better one
_BETTER = 0.1  # a later choice must fit so much better than an earlier one


@dataclass
class Standing:
    """How the loose trees stand: about which point of theirs, how turned, and whose image they are."""

    points: dict[int, Array] = field(default_factory=dict)
    turns: dict[int, Array] = field(default_factory=dict)
    images: list[dict[int, int]] = field(default_factory=list)
    words: list[str] = field(default_factory=list)
    ambiguous: list[str] = field(default_factory=list)
    hopeless: bool = False  # whether a tree has joints on its first link without image, in any pose


def stand(parts: Parts, group: PointGroup, origin: Array, tolerance: float) -> Standing:
    """Find it for every loose tree of a model at a pose; the group acts about the axis through origin."""
    out = Standing(images=[{} for _ in range(group.order)])
    turning = Turning(parts, group.matrices.numpy(), generators(group), tolerance)
    for alike in _buckets(turning):
        _stand_alike(turning, group, origin, alike, out)
    return out


def generators(group: PointGroup) -> list[int]:
    """A few elements whose products are the group: what fits them fits all."""
    found, reached = [], {0}
    for g in range(1, group.order):
        if g not in reached:
            found.append(g)
            while True:
                more = {int(group.table[a, b]) for a in found for b in reached} - reached
                if not more:
                    break
                reached |= more
    return found


def _stand_alike(
    turning: Turning, group: PointGroup, origin: Array, alike: list[int], out: Standing
) -> None:
    model, own = turning.model, None
    if len(alike) > 1:
        for images in (_by_name(turning, group, alike), _by_place(turning, group, origin, alike)):
            if images is not None and _exchange(turning, group, images, alike, out):
                return
        own = {b: _own(turning, b) for b in alike}
        if max(o[0] for o in own.values()) > 1 and _exchange(
            turning, group, _by_shape(turning, group, alike), alike, out
        ):
            return
        names = ", ".join(label_of(model, "body", b) for b in alike)
        out.ambiguous.append(f"{names} are alike: each is taken for its own image")
    for b in alike:
        _, words, turn, point = own[b] if own else _own(turning, b)
        out.hopeless |= not turning.is_rigid(b) and b not in turning.held
        out.turns[b], out.points[b] = turn, point
        for images in out.images:
            images[b] = b
        if words != "as it is":
            out.words.append(f"{label_of(model, 'body', b)} {words}")


def _own(turning: Turning, tree: int) -> tuple[float, str, Array, Array]:
    """Misfit, words, turn and point with which a tree is its own image, the first that is good enough."""
    elements, zero = turning.generators, np.zeros(3)
    tried: list[tuple[float, str, Array, Array]] = []

    def attempt(by: Turning, words: str, turn: Array, point: Array) -> bool:
        if not any(point is t[3] and _close(turn, t[2]) for t in tried):
            tried.append((by.misfit(tree, tree, (turn, turn), elements), words, turn, point))
        return tried[-1][0] <= _GOOD

    if any(attempt(turning, *usual, zero) for usual in turning.usual(tree)):
        return tried[-1]
    held = tree in turning.held
    more = turning.more(tree) if turning.is_object(tree) or not held else ()
    if any(attempt(turning, *turn, zero) for turn in more):
        return tried[-1]
    if min(tried, key=_misfit)[0] > 1 and not held:  # the frame may be anywhere in the body
        for point in _points(turning, tree):
            about = turning.parts.about({tree: turning.parts.points[tree] + point})
            by = Turning(about, turning.matrices, turning.generators, turning.tolerance)
            if any(attempt(by, *usual, point) for usual in by.usual(tree)):
                return tried[-1]
            turning.held |= by.held
        if min(tried, key=_misfit)[0] > 1:
            tried = [t for t in tried if t[3] is zero]
    best = min(tried, key=_misfit)
    if not np.isfinite(best[0]):
        return tried[0]
    return next(t for t in tried if _BETTER * t[0] <= best[0])


def _close(one: Array, other: Array) -> bool:
    return bool((np.abs(one - other) <= 1e-12 + 1e-5 * np.abs(other)).all())


def _misfit(tried: tuple[float, str, Array, Array]) -> float:
    return tried[0]


def _points(turning: Turning, tree: int) -> list[Array]:
    """Points of a tree that may be on its axis: its centre of mass, and where its joints agree."""
    parts = turning.parts
    mass = parts.data.subtree_com[tree] - parts.points[tree]
    if turning.is_rigid(tree):
        return [mass]
    about = parts.about({tree: parts.points[tree] + mass})
    found = [mass]
    for _, turn in turning.usual(tree):
        elements = turning.matrices[turning.generators]
        pairings = [Pairing(about, turn.T @ m @ turn, m) for m in elements]
        moved = center((p, p.images(tree, tree)) for p in pairings)
        found.append(mass + moved)
    return found[:1] + [p for p in found[1:] if np.isfinite(p).all()]


def _exchange(
    turning: Turning,
    group: PointGroup,
    images: list[dict[int, int]] | None,
    alike: list[int],
    out: Standing,
) -> bool:
    """Take over images if the trees fit them, turned alike; whether they do."""
    if images is None:
        return False
    usual = {b: _together(turning, b) for b in alike}
    for k, (words, _) in enumerate(usual[alike[0]]):
        misfit = max(
            turning.misfit(a, b, (usual[a][k][1], usual[b][k][1]), [g])
            for g in range(1, group.order)
            for a, b in images[g].items()
        )
        if misfit <= 1:
            out.turns |= {b: usual[b][k][1] for b in alike}
            out.points |= dict.fromkeys(alike, np.zeros(3))
            for g, own in enumerate(images):
                out.images[g] |= own
            if k:
                out.words.append(f"{', '.join(label_of(turning.model, 'body', b) for b in alike)} {words}")
            return True
    return False


def _together(turning: Turning, tree: int) -> list[tuple[str, Array]]:
    """Turns that are tried for all trees of a kind at once: objects may lie in any way."""
    upright = turning.parts.data.xmat[tree].reshape(3, 3).T
    return turning.usual(tree) + [("upright", upright)] * turning.is_object(tree)


def _buckets(turning: Turning) -> list[list[int]]:
    """Loose trees that may be images of each other: as many parts, nearly as heavy and as large."""
    parts, model = turning.parts, turning.model
    found: list[tuple[tuple, Array, list[int]]] = []
    for b in parts.loose:
        links = [parts.links[x] for x in parts.tree(b)]
        kinds = tuple(sorted(int(model.jnt_type[j]) for link in links for j in link.joints))
        moments = np.linalg.eigvalsh(parts.inertias[b])
        numbers = np.array([sum(link.mass for link in links), _reach(parts, b), *moments])
        key = (len(links), kinds, bool(model.body_mocapid[b] >= 0))
        for other, near, members in found:
            if other == key and np.allclose(numbers, near, rtol=0.1, atol=1e-9 + 0.02 * moments.max()):
                members.append(b)
                break
        else:
            found.append((key, numbers, [b]))
    return [members for *_, members in found]


def _reach(parts: Parts, tree: int) -> float:
    """How far a tree's shapes reach from its frame, however it is turned."""
    model = parts.model
    geoms = np.flatnonzero(np.isin(weld_ids(model)[model.geom_bodyid], parts.tree(tree)))
    away = np.linalg.norm(parts.data.geom_xpos[geoms] - parts.data.xpos[tree], axis=1)
    return float((away + model.geom_rbound[geoms]).max(initial=0.0))


def _by_name(turning: Turning, group: PointGroup, alike: list[int]) -> list[dict[int, int]] | None:
    """Images that the names of bodies say, if they are an action; None if they say nothing."""
    known = {name_of(turning.model, "body", b): b for b in alike}
    images = []
    for matrix in group.matrices.numpy():
        said = {
            a: [known[n] for n in counterparts(name, *exchanged(matrix)) if n in known]
            for name, a in known.items()
        }
        images.append({a: said[a][0] if said[a] else a for a in alike})
    return _action(group, images)


def _by_place(
    turning: Turning, group: PointGroup, origin: Array, alike: list[int]
) -> list[dict[int, int]] | None:
    """Images by where trees start, if that is so for all of them; None if they start anyhow."""
    places = turning.model.body_pos[alike] - origin
    limit = 1e-3 * max(turning.parts.sizes[b] for b in alike)
    images = []
    for matrix in group.matrices.numpy():
        apart = np.linalg.norm((places @ matrix.T)[:, None] - places, axis=-1)
        nearest = apart.argmin(axis=1)
        if (apart.min(axis=1) > limit).any() or (np.count_nonzero(apart <= limit, axis=1) > 1).any():
            return None
        images.append({a: alike[k] for a, k in zip(alike, nearest, strict=True)})
    return _action(group, images)


def _by_shape(turning: Turning, group: PointGroup, alike: list[int]) -> list[dict[int, int]] | None:
    """Images with the least misfit, where not every tree is its own."""
    images, turns = [dict(zip(alike, alike, strict=True))], {b: _together(turning, b) for b in alike}
    for g in range(1, group.order):
        table = np.array([
            [min(turning.misfit(a, b, (one[1], other[1]), [g])
                 for one, other in zip(turns[a], turns[b], strict=True)) for b in alike]
            for a in alike
        ])  # fmt: skip
        rows, columns = linear_sum_assignment(np.minimum(table, 1e6))
        images.append({alike[r]: alike[c] for r, c in zip(rows, columns, strict=True)})
    return _action(group, images)


def _action(group: PointGroup, images: list[dict[int, int]]) -> list[dict[int, int]] | None:
    """The images if something moves, every one has one source, and they compose; else None."""
    if all(a == b for own in images for a, b in own.items()):
        return None
    if any(len(set(own.values())) != len(own) for own in images):
        return None
    table = group.table
    composes = all(
        images[g][images[h][a]] == images[int(table[g, h])][a]
        for g in range(group.order)
        for h in range(group.order)
        for a in images[0]
    )
    return images if composes else None
