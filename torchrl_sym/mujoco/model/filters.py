"""Which geoms may touch each other: by bits, bodies, excludes and explicit pairs.

A terrain has thousands of geoms, but they differ in few ways: a *class* holds the geoms of one body with
the same contype and conaffinity, and MuJoCo treats them alike. Tables are over classes, so that time and
memory do not grow with the square of the number of geoms.
"""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from torchrl_sym.mujoco.model.releases import weld_ids
from torchrl_sym.mujoco.model.types import MjModel, mj, name_of

_DISABLE = mj.mjtDisableBit
_NO_CONTACT = int(_DISABLE.mjDSBL_CONTACT) | int(_DISABLE.mjDSBL_CONSTRAINT)


class Filters:
    """Which classes of geoms may touch.

    Attributes:
        of: the class of every geom, ``(ngeom,)``.
        body: the body of every class, ``(k,)``.
        bits: its contype and conaffinity, ``(k, 2)``.
        moves: whether it belongs to a moving part, ``(k,)``.
        alike: pairs of classes that bits and kinship allow to touch, before excludes, ``(k, k)``.
        excluded: pairs of classes that an exclude keeps apart, ``(k, k)``.
        pairs: explicit pairs of geoms, which touch whatever else is said, smaller number first.
    """

    def __init__(self, model: MjModel) -> None:
        keys = np.stack([model.geom_bodyid, model.geom_contype, model.geom_conaffinity], axis=1)
        unique, of = np.unique(keys, axis=0, return_inverse=True)
        self.of: NDArray[np.intp] = of.reshape(-1)  # some versions of numpy add a dimension
        self.body, self.bits = unique[:, 0], unique[:, 1:]
        contype, conaffinity = self.bits.T
        off = model.opt.disableflags & _NO_CONTACT
        link = weld_ids(model)[self.body]
        self.moves: NDArray[np.bool_] = link != 0
        self.alike: NDArray[np.bool_] = (contype[:, None] & conaffinity) != 0
        self.alike |= self.alike.T
        active = model.body_dofnum[link] > 0  # a mocap body moves, but nothing can push it
        self.alike &= (link[:, None] != link) & (active[:, None] | active) & (not off)
        if not model.opt.disableflags & int(_DISABLE.mjDSBL_FILTERPARENT):
            parent = weld_ids(model)[model.body_parentid[link]]
            child = (parent[:, None] == link) & self.moves & self.moves[:, None]
            self.alike &= ~(child | child.T)
        self.excluded = np.zeros_like(self.alike)
        for signature in np.asarray(model.exclude_signature):
            one, other = self.body == signature >> 16, self.body == signature & 0xFFFF
            self.excluded |= np.outer(one, other) | np.outer(other, one)
        explicit = zip(model.pair_geom1.tolist(), model.pair_geom2.tolist(), strict=True)
        self.pairs: set[tuple[int, int]] = set() if off else {(min(p), max(p)) for p in explicit}

    @property
    def may(self) -> NDArray[np.bool_]:
        """Pairs of classes that may touch, ``(k, k)``."""
        return self.alike & ~self.excluded

    def members(self) -> list[int]:
        """Geoms that occur in an explicit pair."""
        return sorted(set(itertools.chain(*self.pairs)))


def active_geoms(model: MjModel) -> NDArray[np.intp]:
    """Numbers of the geoms that matter for motion: they may touch another part or feel a fluid."""
    filters = Filters(model)
    active = np.any(filters.alike, axis=1, keepdims=True)[filters.of, 0]
    active[filters.members()] = True
    return np.flatnonzero(active | feels_fluid(model))


def lonely_geoms(model: MjModel) -> NDArray[np.intp]:
    """Moving geoms that nothing in the model can touch, although their bits are set.

    A robot's file often has no floor: that comes with the scene, and its geoms are meant for it. Where the
    model has something fixed that a moving part can touch, what cannot touch anything is meant not to.

    Example:
        >>> drone = '<body><freejoint/><geom size=".1"/></body>'
        >>> for floor in ("", '<geom type="plane" size="1 1 1"/>'):
        ...     text = f"<mujoco><worldbody>{floor}{drone}</worldbody></mujoco>"
        ...     lonely_geoms(mj.MjModel.from_xml_string(text)).tolist()
        [0]
        []
    """
    if model.opt.disableflags & _NO_CONTACT:
        return np.array([], dtype=np.intp)
    filters = Filters(model)
    named = filters.members()
    if filters.alike[~filters.moves].any() or (~filters.moves[filters.of[named]]).any():
        return np.array([], dtype=np.intp)
    bits = (model.geom_contype | model.geom_conaffinity) != 0
    lonely = bits & filters.moves[filters.of] & ~np.any(filters.may, axis=1, keepdims=True)[filters.of, 0]
    lonely[named] = False
    return np.flatnonzero(lonely)


def feels_fluid(model: MjModel) -> NDArray[np.bool_]:
    """Which geoms feel a fluid by their own shape, ``(ngeom,)``."""
    fluid = model.opt.density > 0 or model.opt.viscosity > 0
    return (model.geom_fluid[:, 0] > 0) & fluid


def geom_label(model: MjModel, geom: int) -> str:
    """Name of a geom, or its number and body."""
    body = name_of(model, "body", int(model.geom_bodyid[geom]))
    return model.geom(geom).name or f"geom {geom} of {body!r}"
