"""Are contact parameters and the filters of contacts mapped onto each other?

Geoms that may touch must have images that may, and the other way: by bits, excludes and explicit pairs. A
filter that lacks its image weighs as much as it is felt: by the share of poses in which its parts touch.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from torchrl_sym.mujoco.audit.comparison import Comparison, column_scale
from torchrl_sym.mujoco.audit.encounters import Encounters
from torchrl_sym.mujoco.audit.report import Kind
from torchrl_sym.mujoco.audit.shapes import DISCRETE
from torchrl_sym.mujoco.model.filters import Filters, feels_fluid, geom_label
from torchrl_sym.mujoco.model.releases import weld_ids
from torchrl_sym.mujoco.model.types import Array, name_of

_PARAMETERS = {
    "friction": ("geom_friction",),
    "condim": ("geom_condim",),
    "priority": ("geom_priority",),
    "contact solref/solimp": ("geom_solref", "geom_solimp", "geom_solmix"),
    "contact margin": ("geom_margin", "geom_gap", "geom_adhesion"),
}
_LENGTHS = ("geom_margin", "geom_gap")
_FRICTION_NEEDS = np.array([3, 4, 6])  # a contact's dimension, for sliding, torsional and rolling friction
_PAIR_FIELDS = ("dim", "friction", "solref", "solreffriction", "solimp", "margin", "gap", "adhesion")


def compare_contacts(c: Comparison, images: dict[int, int]) -> None:
    """Residuals of contact parameters, collision bits, excludes and explicit pairs."""
    if images:
        mine, theirs = (np.array(list(x), dtype=np.intp) for x in (images, images.values()))
        _compare_parameters(c, mine, theirs)
        _compare_filters(c, mine, theirs)
        _compare_pairs(c, images)


def _compare_parameters(c: Comparison, mine: NDArray[np.intp], theirs: NDArray[np.intp]) -> None:
    """Friction, softness and margins of geoms, judged with their shapes."""
    world = weld_ids(c.model)[c.model.geom_bodyid[mine]] == 0
    judged: tuple[tuple[Kind, NDArray[np.bool_]], ...] = (("collision", ~world), ("scenery", world))
    for kind, some in judged:
        for term, fields in _PARAMETERS.items():
            gaps = [_gap(c, field, mine[some], theirs[some]) for field in fields if hasattr(c.model, field)]
            term = "scenery contacts" if kind == "scenery" else term
            _add_worst(c, term, np.max(gaps, axis=0), mine[some], theirs[some], kind)
    wet = feels_fluid(c.model)[mine]
    _add_worst(
        c,
        "fluid coefficients",
        _gap(c, "geom_fluid", mine[wet], theirs[wet]),
        mine[wet],
        theirs[wet],
        "dynamics",
    )


def _gap(c: Comparison, field: str, a: NDArray[np.intp], b: NDArray[np.intp]) -> Array:
    """Relative difference of a field of geoms a and b, ``(n,)``."""
    values = np.asarray(getattr(c.model, field), dtype=float).reshape(c.model.ngeom, -1)
    scale = np.array([c.matcher.extent]) if field in _LENGTHS else column_scale(values[a])
    if field == "geom_friction":  # what no contact uses is no difference
        dims = [c.model.geom_condim.max(initial=1), c.model.pair_dim.max(initial=1)]
        scale = np.where(max(dims) >= _FRICTION_NEEDS, scale, np.inf)
    return (np.abs(values[a] - values[b]) / scale).max(axis=1, initial=0.0)


def _add_worst(
    c: Comparison, term: str, gaps: Array, a: NDArray[np.intp], b: NDArray[np.intp], kind: Kind
) -> None:
    if not len(a):
        return
    k = int(np.argmax(gaps))
    one, other = geom_label(c.model, int(a[k])), geom_label(c.model, int(b[k]))
    c.add(term, float(gaps[k]), one if a[k] == b[k] else f"{one} -> {other}", kind=kind)


def _compare_filters(c: Comparison, mine: NDArray[np.intp], theirs: NDArray[np.intp]) -> None:
    """May the images of geoms touch that may, and the other way? By classes of geoms."""
    model, filters = c.model, Filters(c.model)
    for term, table in (
        ("contype/conaffinity", filters.alike),
        ("excludes", filters.alike & filters.excluded),
    ):
        if table.any():
            c.add(term, 0.0, "", kind="collision")

    moves = np.stack([filters.of[mine], filters.of[theirs]], axis=1)
    (one, other), first = (x.T for x in np.unique(moves, axis=0, return_index=True))
    may, encounters = filters.may, Encounters(model, c.data, filters.of, filters.body)
    wrong = may[np.ix_(one, one)] != may[np.ix_(other, other)]
    for ends in np.argwhere(np.triu(wrong)):
        before, after = one[ends], other[ends]
        here = bool(may[before[0], before[1]])
        share = encounters.share(*map(int, before if here else after))
        names = " with ".join(geom_label(model, int(geom)) for geom in mine[first[ends]])
        who = "may touch, their images may not" if here else "may not touch, their images may"
        name = f"{names} ({who}, and do in {share:.0%} of poses)"
        bits_agree = filters.alike[before[0], before[1]] == filters.alike[after[0], after[1]]
        if _is_due_to_terrain(filters, before, after):
            c.add("scenery filters", max(share, DISCRETE), name, kind="scenery")
        else:
            term = "excludes" if bits_agree else "contype/conaffinity"
            c.add(term, max(share, DISCRETE), name, kind="collision")


def _is_due_to_terrain(filters: Filters, before: NDArray[np.intp], after: NDArray[np.intp]) -> bool:
    """Whether of two classes of geoms only one has other bits than its image, and that is the world's."""
    changed = (filters.bits[before] != filters.bits[after]).any(axis=1)
    return bool(changed.sum() == 1 and not filters.moves[before[changed]].any())


def _compare_pairs(c: Comparison, images: dict[int, int]) -> None:
    """Explicit pairs of geoms, whose images must be such pairs, too."""
    model = c.model
    known = {
        frozenset((int(a), int(b))): p
        for p, (a, b) in enumerate(zip(model.pair_geom1, model.pair_geom2, strict=True))
    }
    encounters = Encounters(model, c.data, np.arange(model.ngeom), model.geom_bodyid)
    for pair, p in known.items():
        moved = known.get(frozenset(images.get(geom, -1) for geom in pair))
        if moved is None:
            share = encounters.share(min(pair), max(pair))
            names = " with ".join(geom_label(model, geom) for geom in sorted(pair))
            name = f"{names} (no image; they touch in {share:.0%} of poses)"
            c.add("contact pairs", max(share, DISCRETE), name, kind="collision")
            continue
        for field in _PAIR_FIELDS:
            values = np.asarray(getattr(model, f"pair_{field}", np.zeros(model.npair)), dtype=float)
            values = values.reshape(model.npair, -1)
            residual = np.abs(values[p] - values[moved]) / column_scale(values)
            c.add("contact pairs", float(residual.max()), name_of(model, "pair", p), kind="collision")
