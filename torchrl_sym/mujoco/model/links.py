"""Rigid links of a MuJoCo model.

A *link* is a body that moves on its own (it has a joint or is a mocap body) together with everything
welded to it; the world is a link too. Links rather than bodies are matched, so that it does not matter how
a modeller split a rigid part into bodies, or where the body frames are.

How links hang together and what they weigh is the same at every pose: a `Skeleton` is read once, and says
for any pose where the links' masses are and how large its trees are.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from torchrl_sym import checks
from torchrl_sym.mujoco.model.releases import weld_ids
from torchrl_sym.mujoco.model.types import FREE, Array, MjData, MjModel, name_of

_NO_EXTENT = 1e-6  # metres; the size of what has none
_NO_MASS = 1e-12  # kg; what is taken for the mass of what has none, to divide by

Numbers = NDArray[np.intp]


@dataclass
class Link:
    """A rigid part."""

    body: int
    parent: int
    tree: int = 0  # the link on the world that it hangs on, itself or another
    bodies: list[int] = field(default_factory=list)
    joints: list[int] = field(default_factory=list)
    children: list[int] = field(default_factory=list)
    mass: float = 0.0


@dataclass(frozen=True)
class Lumps:
    """Where the masses of links are at a pose, in the world; by body number, of other bodies zero.

    Attributes:
        centers: centres of mass, ``(nbody, 3)``; of a link without mass, its origin.
        inertias: about them, ``(nbody, 3, 3)``.
    """

    centers: Array
    inertias: Array


class Skeleton:
    """How the links of a model hang together.

    Attributes:
        model: the model; its masses, and which bodies there are, must not change.
        links: by the number of the body that moves them, the world (0) first.
        owner: the link of every body, ``(nbody,)``.
        tree: the tree of every link by body number, 0 of the world and of other bodies, ``(nbody,)``.
        masses: of links by body number, of other bodies zero, ``(nbody,)``; the world's is its own body's.
        total_mass: of all that moves.
        joint_links: the link of every joint, ``(njnt,)``.
        kinds: types of joints.
        fixed: trees that hang on the world.
        loose: trees that nothing holds.
    """

    def __init__(self, model: MjModel) -> None:
        self.model, self.owner = model, weld_ids(model).astype(np.intp)
        self.links: dict[int, Link] = {}
        for body, root in enumerate(self.owner.tolist()):
            if root == body:
                parent = int(self.owner[model.body_parentid[body]]) if body else -1
                start, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
                self.links[body] = Link(body, parent, joints=list(range(start, start + count)))
                if body:
                    self.links[parent].children.append(body)
                    self.links[body].tree = self.links[parent].tree or body
            self.links[root].bodies.append(body)

        self.tree = np.zeros(model.nbody, dtype=np.intp)
        self.tree[list(self.links)] = [link.tree for link in self.links.values()]

        counted = np.flatnonzero((self.owner != 0) | (np.arange(model.nbody) == 0))
        self._lumped = _Groups(counted, self.owner[counted])
        self.masses = np.zeros(model.nbody)
        self.masses[self._lumped.labels] = self._lumped.sum(model.body_mass[self._lumped.members])
        for body, link in self.links.items():
            link.mass = float(self.masses[body])

        self.total_mass = max(float(self.masses[1:].sum()), _NO_MASS)
        self.kinds: list[int] = model.jnt_type.tolist()
        self.joint_links = self.owner[model.jnt_bodyid]
        trees = self.links[0].children
        self.fixed = [b for b in trees if not is_loose(model, b)]
        self.loose = [b for b in trees if is_loose(model, b)]

    @functools.cached_property
    def names(self) -> dict[str, list[str]]:
        """Names of bodies and of joints, by kind and number."""
        counts = {"body": self.model.nbody, "joint": self.model.njnt}
        return {kind: [name_of(self.model, kind, k) for k in range(n)] for kind, n in counts.items()}

    @functools.cached_property
    def numbers(self) -> dict[str, dict[str, int]]:
        """Numbers of bodies and of joints, by kind and name."""
        return {kind: {name: k for k, name in enumerate(names)} for kind, names in self.names.items()}

    @functools.cached_property
    def geoms(self) -> dict[int, list[int]]:
        """Geoms of every link that has some."""
        found: dict[int, list[int]] = {}
        for geom, link in enumerate(self.owner[self.model.geom_bodyid].tolist()):
            found.setdefault(link, []).append(geom)
        return found

    def lumps(self, data: MjData) -> Lumps:
        """Where the masses are at a pose."""
        model, members, labels = self.model, self._lumped.members, self._lumped.labels
        masses, places = model.body_mass[members], data.xipos[members]
        total = self.masses[labels][:, None]
        centers, inertias = np.zeros((model.nbody, 3)), np.zeros((model.nbody, 3, 3))
        weighted = self._lumped.sum(masses[:, None] * places) / np.where(total > 0, total, 1.0)
        centers[labels] = np.where(total > 0, weighted, data.xpos[labels])

        axes, arms = data.ximat[members].reshape(-1, 3, 3), places - centers[self.owner[members]]
        second = (axes * model.body_inertia[members][:, None]) @ axes.swapaxes(1, 2)
        spread = masses[:, None, None] * arms[:, :, None] * arms[:, None]
        away = masses * (arms * arms).sum(axis=1)
        inertias[labels] = self._lumped.sum(second + away[:, None, None] * np.eye(3) - spread)
        return Lumps(centers, inertias)

    @functools.cached_property
    def _boxed(self) -> tuple[Numbers, Numbers, _Groups]:
        """Bodies and bounded geoms that move, and the trees of both: planes have no end."""
        model = self.model
        root = self.tree[self.owner]
        bodies = np.flatnonzero(root)
        geoms = np.flatnonzero((model.geom_rbound > 0) & (root[model.geom_bodyid] > 0))
        owners = np.concatenate([root[bodies], root[model.geom_bodyid[geoms]]])
        return bodies, geoms, _Groups(np.arange(len(owners)), owners)

    def sizes(self, data: MjData) -> dict[int, float]:
        """Size of every tree of moving links at a pose: the longest side of the box around it.

        Lengths are compared relative to it rather than to ``stat.extent``, which a wall 60 m away sets.
        Trees that are fixed to the world make one machine: its box counts for all, up to twice the largest
        of them.
        """
        bodies, geoms, trees = self._boxed
        if not len(trees.labels):
            return {}
        boxes, turns = (
            self.model.geom_aabb[geoms].reshape(-1, 2, 3),
            data.geom_xmat[geoms].reshape(-1, 3, 3),
        )
        centers = data.geom_xpos[geoms] + (turns @ boxes[:, 0, :, None])[..., 0]
        halves = (np.abs(turns) @ boxes[:, 1, :, None])[..., 0]
        low = trees.least(np.concatenate([data.xpos[bodies], centers - halves])[trees.members])
        high = -trees.least(-np.concatenate([data.xpos[bodies], centers + halves])[trees.members])
        sides = np.maximum((high - low).max(axis=1), _NO_EXTENT)
        sizes = dict(zip(trees.labels.tolist(), sides.tolist(), strict=True))
        if self.fixed:
            some = np.searchsorted(trees.labels, self.fixed)
            together = float((high[some].max(axis=0) - low[some].min(axis=0)).max())
            together = min(together, 2 * float(sides[some].max()))
            # parked dummies have no extent of their own
            sizes |= dict.fromkeys(self.fixed, together if together > _NO_EXTENT else max(sizes.values()))
        return sizes


class _Groups:
    """Sums and least values over groups of rows.

    Attributes:
        members: what the rows are, group by group.
        labels: of the groups, in ascending order.
    """

    def __init__(self, members: Numbers, labels: Numbers) -> None:
        order = np.argsort(labels, kind="stable")
        self.members = members[order]
        self.labels, self._starts = np.unique(labels[order], return_index=True)

    def sum(self, rows: Array) -> Array:
        """Of rows in the order of the members."""
        return np.add.reduceat(rows, self._starts, axis=0)

    def least(self, rows: Array) -> Array:
        """Of rows in the order of the members."""
        return np.minimum.reduceat(rows, self._starts, axis=0)


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
