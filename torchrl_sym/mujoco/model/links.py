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

_NO_EXTENT = 1e-6  # metres; the size of what has none


@dataclass
class Link:
    """A rigid part at the reference pose; positions and axes in the world frame."""

    body: int
    parent: int
    tree: int = 0  # the link on the world that it hangs on, itself or another
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
                links[body].tree = links[parent].tree or body
        links[root].bodies.append(body)
    for link in links.values():
        _lump(model, data, link)
    return links


def _lump(model: MjModel, data: MjData, link: Link) -> None:
    """Mass, centre of mass and inertia about it of all bodies of a link; the world's do not matter."""
    bodies = [link.body] if link.body == 0 else link.bodies
    masses, centers = model.body_mass[bodies], data.xipos[bodies]
    link.mass = float(masses.sum())
    link.com = masses @ centers / link.mass if link.mass > 0 else data.xpos[link.body].copy()
    axes, arms = data.ximat[bodies].reshape(-1, 3, 3), centers - link.com
    second = np.einsum("bij,bj,bkj->ik", axes, model.body_inertia[bodies], axes)
    spread = np.einsum("b,bi,bj->ij", masses, arms, arms)
    link.inertia = second + np.trace(spread) * np.eye(3) - spread


def sizes_of(model: MjModel, data: MjData, links: dict[int, Link]) -> dict[int, float]:
    """Size of every tree of moving links, by its first link: the longest side of the box around it.

    Lengths are compared relative to it rather than to ``stat.extent``, which a wall 60 m away sets. Trees
    that are fixed to the world make one machine: its box counts for all, up to twice the largest of them.
    """
    boxes = model.geom_aabb.reshape(-1, 2, 3)
    turns = data.geom_xmat.reshape(-1, 3, 3)
    centers = data.geom_xpos + np.einsum("gij,gj->gi", turns, boxes[:, 0])
    halves = np.einsum("gij,gj->gi", np.abs(turns), boxes[:, 1])
    bounded = (model.geom_rbound > 0)[:, None]  # planes are not
    low = np.concatenate([data.xpos, np.where(bounded, centers - halves, np.inf)])
    high = np.concatenate([data.xpos, np.where(bounded, centers + halves, -np.inf)])
    root = np.array([links[b].tree for b in weld_ids(model)])
    owner = np.concatenate([root, root[model.geom_bodyid]])
    bottom, top = np.full((model.nbody, 3), np.inf), np.full((model.nbody, 3), -np.inf)
    np.minimum.at(bottom, owner, low)
    np.maximum.at(top, owner, high)
    trees = sorted(set(root.tolist()) - {0})
    sizes = {b: max(float((top[b] - bottom[b]).max()), _NO_EXTENT) for b in trees}
    fixed = [b for b in trees if not is_loose(model, b)]
    if fixed:
        together = float((top[fixed].max(axis=0) - bottom[fixed].min(axis=0)).max())
        together = min(together, 2 * max(sizes[b] for b in fixed))
        # parked dummies have no extent of their own
        sizes |= dict.fromkeys(fixed, together if together > _NO_EXTENT else max(sizes.values()))
    return sizes


def is_loose(model: MjModel, body: int) -> bool:
    """Whether nothing holds a body: it has a free joint, or is a mocap body."""
    joint = int(model.body_jntadr[body])
    return model.body_mocapid[body] >= 0 or (joint >= 0 and int(model.jnt_type[joint]) == FREE)


def carried_bodies(model: MjModel, names: Sequence[str]) -> frozenset[int]:
    """Numbers of the bodies that are only carried along by a turn of the world.

    Raises:
        KeyError: no such body; the message lists those that qualify.
        ValueError: a body that is neither free nor mocap, or that moving bodies hang on.
    """
    known = {name_of(model, "body", b): b for b in range(model.nbody)}
    found = set()
    names = [names] if isinstance(names, str) else checks.sequence("carried", names)
    for name in names:
        if not isinstance(name, str) or name not in known:
            choice = [n for n, b in known.items() if is_loose(model, b)]
            raise KeyError(f"no body {name!r} to be carried; free and mocap bodies are {choice}")
        body = known[name]
        if not is_loose(model, body):
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
