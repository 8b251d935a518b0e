"""Rigid links of a MuJoCo model at one pose.

A *link* is a body that moves on its own (it has a joint or is a mocap body) together with everything
welded to it; the world is a link too. Links rather than bodies are matched, so that it does not matter how
a modeller split a rigid part into bodies, or where the body frames are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from torchrl_sym import checks
from torchrl_sym.mujoco.model.releases import weld_ids
from torchrl_sym.mujoco.model.types import FREE, Array, MjData, MjModel, name_of


@dataclass
class Link:
    """A rigid part at the reference pose; positions and axes in the world frame."""

    body: int
    parent: int
    bodies: list[int] = field(default_factory=list)
    joints: list[int] = field(default_factory=list)
    children: list[int] = field(default_factory=list)
    mass: float = 0.0
    com: Array = field(default_factory=lambda: np.zeros(3))
    inertia: Array = field(default_factory=lambda: np.zeros((3, 3)))


def links_of(model: MjModel, data: MjData) -> dict[int, Link]:
    """Links by the number of the body that moves them, the world (0) first."""
    links: dict[int, Link] = {}
    for body in range(model.nbody):
        root = int(weld_ids(model)[body])
        if root == body:
            parent = int(weld_ids(model)[model.body_parentid[body]]) if body else -1
            start, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
            links[body] = Link(body, parent, joints=list(range(start, start + count)))
            if body:
                links[parent].children.append(body)
        links[root].bodies.append(body)
    for link in links.values():
        _lump(model, data, link)
    return links


def _lump(model: MjModel, data: MjData, link: Link) -> None:
    """Mass, centre of mass and inertia about it of all bodies of a link."""
    masses = model.body_mass[link.bodies]
    link.mass = float(masses.sum())
    centers = data.xipos[link.bodies]
    link.com = masses @ centers / link.mass if link.mass > 0 else data.xpos[link.body].copy()
    for body, mass, center in zip(link.bodies, masses, centers, strict=True):
        axes = data.ximat[body].reshape(3, 3)
        r = center - link.com
        link.inertia += axes @ np.diag(model.body_inertia[body]) @ axes.T
        link.inertia += mass * (r @ r * np.eye(3) - np.outer(r, r))


def carried_bodies(model: MjModel, names: Sequence[str]) -> frozenset[int]:
    """Numbers of the bodies that are only carried along by a turn of the world.

    Raises:
        KeyError: no such body; the message lists those that qualify.
        ValueError: a body that is neither free nor mocap, or that moving bodies hang on.
    """
    kinds = model.jnt_type[model.body_jntadr] if model.njnt else np.full(model.nbody, -1)
    loose = ((model.body_jntnum > 0) & (kinds == FREE)) | (model.body_mocapid >= 0)
    known = {name_of(model, "body", b): b for b in range(model.nbody)}
    found = set()
    names = [names] if isinstance(names, str) else checks.sequence("carried", names)
    for name in names:
        if not isinstance(name, str) or name not in known:
            choice = [n for n, b in known.items() if loose[b]]
            raise KeyError(f"no body {name!r} to be carried; free and mocap bodies are {choice}")
        body = known[name]
        if not loose[body]:
            raise ValueError(
                f"{name!r} cannot be carried: it is neither a free body (one free joint) nor a mocap body; "
                "what hangs on a robot or is fixed is mapped with it"
            )
        below = np.flatnonzero((model.body_rootid == body) & (weld_ids(model) != body))
        if len(below):
            raise ValueError(
                f"{name!r} cannot be carried: {name_of(model, 'body', int(below[0]))!r} moves on it, and "
                "only rigid bodies are carried along"
            )
        found.add(body)
    return frozenset(found)
