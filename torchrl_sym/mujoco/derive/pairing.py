"""Which link and which joint is the image of which, under one isometry.

Matching at a single pose is enough: a kinematic tree is determined by its reference configuration and its
joint axes (the product of exponentials), so if masses, anchors and axes are mapped onto each other at one
pose that the symmetry keeps, the equations of motion are mapped onto each other everywhere.

Trees are matched from the root: the children of a link go to children of its image, so that the sum over
their subtrees of all distances is least. Where two assignments are equally good, as for the fingers of a
closed gripper, names and ranges decide, and then that parts stay where they are.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from torchrl_sym.mujoco.derive.chains import JointPairs, pair_joints
from torchrl_sym.mujoco.derive.gaps import Gaps, Pairs, columns
from torchrl_sym.mujoco.derive.hints import Hints, exchanges
from torchrl_sym.mujoco.derive.parts import Parts
from torchrl_sym.mujoco.model.types import Array

_MISFIT = 1e3  # cost of a pair that cannot be the image of each other; far above any distance
_STAY = 1e-9  # links at one place stay where they are
_UNDECIDED = 2e-2  # assignments whose costs differ by less are told apart by names and ranges
_ORDER = 0.1  # joints that act in another order: less than a link on the wrong side
_NEAREST = 8  # of many siblings, only so many near ones are compared in full
# A link's centre of mass may miss its image's by so many tolerances (10 % of its tree, by default): enough
# for cables and payloads of real robots, too little for a leg that is sent to itself across the plane.
_CENTER = 10.0


@dataclass(frozen=True)
class Misfit:
    """The worst pair of a matching, in units of what is tolerated: a joint, a link, or a missing one."""

    size: float
    kind: str = "joint"
    one: int = 0
    other: int = 0


@dataclass(slots=True)
class _Siblings:
    """Two sets of siblings, one of which is to be mapped into the other.

    Attributes:
        mine, theirs: the links.
        compared: for each of mine, the places in theirs that it is compared with in full; None for all.
        costs: of pairs that are not, ``(len(mine), len(theirs))``.
        cost, pairs: of the best assignment, once it is known.
    """

    mine: Sequence[int]
    theirs: Sequence[int]
    compared: NDArray[np.intp] | None = None
    costs: Array | None = None
    cost: float = 0.0
    pairs: list[tuple[int, int]] = field(default_factory=list)

    def candidates(self) -> Pairs:
        """Pairs that are compared in full."""
        if self.compared is None:
            return [(a, b) for a in self.mine for b in self.theirs]
        rows = zip(self.mine, self.compared.tolist(), strict=True)
        return [(a, self.theirs[k]) for a, places in rows for k in places]


_NONE = _Siblings([], [])  # of links without children, of which most pairs are


class Pairing:
    """Finds images under one isometry.

    Args:
        parts: the model at a pose.
        matrix: the isometry R, ``(3, 3)``; it acts on each tree about its point.
        acting: the element that R stands for, if the trees are turned for the trial. It says which names
            go to which.
    """

    def __init__(self, parts: Parts, matrix: Array, acting: Array | None = None) -> None:
        self.parts, self.model, self.links = parts, parts.model, parts.links
        self.matrix, self.acting = matrix, matrix if acting is None else acting
        self.gaps = Gaps(parts, matrix)
        self.undecided: dict[tuple[int, int], tuple[int, int]] = {}
        self._hints: Hints | None = None
        self._compared: list[tuple[int, int]] = []  # pairs of links, each after its parents
        self._own: dict[tuple[int, int], float] = {}  # costs of pairs of links without what is below
        self._below: dict[tuple[int, int], _Siblings] = {}
        self._costs: dict[tuple[int, int], float] = {}  # of pairs of joints
        self._joints: dict[tuple[int, int], JointPairs] = {}

    def images(
        self, a: int, b: int, known: dict[int, int] | None = None, only: Sequence[int] | None = None
    ) -> dict[int, int]:
        """Image of every link of the subtree of a, if that of a is b.

        Args:
            a: a link.
            b: the link that it goes to.
            known: images of trees that are known already.
            only: trees to look at; all by default.
        """
        known = known or {}
        if a == 0:
            trees, taken = self.links[0].children if only is None else only, set(known.values())
            mine, theirs = [c for c in trees if c not in known], [c for c in trees if c not in taken]
            self._below[0, 0] = self._siblings(mine, theirs)
        top = [(a, b), *known.items()]
        self._compare(top)
        images = self._descend(top)
        if self._ties(images):
            # once more, with names and ranges where geometry is undecided
            doubtful = {pair[0] for pair in self._ties(images)}
            flags = exchanges(self.parts.skeleton, images, doubtful, self.acting)
            self._hints = Hints(self.gaps, flags)
            self._add_hints(self._compared)
            self._assign(self._compared)
            images = self._descend(top)
        return images

    def _descend(self, top: Pairs) -> dict[int, int]:
        images, stack = {}, [*top]
        while stack:
            a, b = stack.pop()
            images[a] = b
            if (a, b) not in self._below:  # they were too far apart to be compared
                self._compare([(a, b)])
            stack += self._below[a, b].pairs
        return dict(sorted(images.items()))

    def _compare(self, pairs: Pairs) -> None:
        """Find costs of pairs of links, and the best pairs of what hangs on them."""
        found = [*pairs]
        for a, b in found:
            if (a, b) not in self._below:
                carried = not self.parts.carried.isdisjoint((a, b))
                children = [] if carried else self.links[a].children
                self._below[a, b] = self._siblings(children, [] if carried else self.links[b].children)
            found += self._below[a, b].candidates()  # to which this loop comes as well
        new = [pair for pair in found if pair not in self._own]
        self._measure(new)
        if self._hints is not None:
            self._add_hints(new)
        self._compared += new
        self._assign(found)

    def _siblings(self, mine: Sequence[int], theirs: Sequence[int]) -> _Siblings:
        if not mine and not theirs:
            return _NONE
        if not mine or len(theirs) <= _NEAREST:
            return _Siblings(mine, theirs)
        ends = self.gaps.centers[list(mine)], self.parts.centers[list(theirs)]
        apart = np.linalg.norm(ends[0][:, None] - ends[1], axis=-1)
        near = np.argsort(apart, axis=1, kind="stable")[:, :_NEAREST]
        return _Siblings(mine, theirs, near, _MISFIT * (1 + apart / self.parts.extent))

    def _measure(self, pairs: Pairs) -> None:
        """Find costs of pairs of links, those of links below left out."""
        self.measure_joints(pairs)
        one, other = columns(pairs)
        counts, mocap = self.model.body_jntnum, self.model.body_mocapid >= 0
        costs = self.gaps.of_links(pairs) + _STAY * (one != other)
        costs += _MISFIT * (mocap[one] != mocap[other]) + _MISFIT * (counts[one] != counts[other])
        joints = [self._cost_of_joints(a, b) for a, b in pairs]
        self._own.update(zip(pairs, (costs + joints).tolist(), strict=True))
        for a, b in pairs if self.parts.carried else ():
            if a in self.parts.carried or b in self.parts.carried:
                self._own[a, b] = 0.0 if a == b else _MISFIT

    def measure_joints(self, pairs: Pairs) -> None:
        """Compare the joints of many pairs of links at once, for what is asked about them later."""
        links = self.links
        joints = [
            (i, j)
            for a, b in pairs
            if len(links[a].joints) == len(links[b].joints)
            for i in links[a].joints
            for j in links[b].joints
        ]
        self._costs.update(zip(joints, self.gaps.joint_costs(joints, _MISFIT).tolist(), strict=True))

    def _cost_of_joints(self, a: int, b: int) -> float:
        mine, theirs = self.links[a].joints, self.links[b].joints
        if len(mine) == len(theirs) == 1:
            return self._costs[mine[0], theirs[0]]
        joints = self.joint_pairs(a, b)
        return sum(joints.costs.values()) + _ORDER * joints.order

    def _add_hints(self, pairs: Pairs) -> None:
        """Add what names and ranges say to the costs of pairs of links."""
        assert self._hints is not None
        free = [(a, b) for a, b in pairs if a not in self.parts.carried and b not in self.parts.carried]
        costs = self._hints.costs(free, [self.joints_to(a, b) for a, b in free])
        for pair, cost in zip(free, costs, strict=True):
            self._own[pair] += cost

    def _assign(self, pairs: Pairs) -> None:
        """Find the best pairs of the children of pairs of links, each of which comes after its parents."""
        for pair in reversed(pairs):
            below = self._below[pair]
            if below is _NONE:
                continue
            mine, theirs = below.mine, below.theirs
            rest = _MISFIT * abs(len(mine) - len(theirs))
            if not mine or not theirs:
                below.cost = rest
            elif len(mine) == len(theirs) == 1:
                below.pairs = [(mine[0], theirs[0])]
                below.cost = self._cost(*below.pairs[0])
            else:
                table = self._table(below)
                best = linear_sum_assignment(table)
                below.pairs = [(mine[r], theirs[c]) for r, c in zip(*best, strict=True)]
                below.cost = float(table[best].sum()) + rest
                self._find_undecided(table[np.ix_(*best)], below.pairs)

    def _cost(self, a: int, b: int) -> float:
        """Cost of mapping the subtree of a onto that of b."""
        return self._own[a, b] + self._below[a, b].cost

    def _table(self, below: _Siblings) -> Array:
        if below.costs is None or below.compared is None:
            return np.array([[self._cost(a, b) for b in below.theirs] for a in below.mine])
        table = below.costs.copy()
        costs = [self._cost(a, b) for a, b in below.candidates()]
        np.put_along_axis(table, below.compared, np.reshape(costs, below.compared.shape), axis=1)
        return table

    def _find_undecided(self, costs: Array, pairs: Pairs) -> None:
        """Remember pairs that could as well be exchanged with others, by costs of the ends of all pairs."""
        least = costs.diagonal()
        swap = costs + costs.T - (least[:, None] + least)
        for r, c in zip(*(axis.tolist() for axis in np.nonzero(swap < _UNDECIDED)), strict=True):
            if r < c:
                self.undecided[pairs[r]], self.undecided[pairs[c]] = pairs[c], pairs[r]

    def joints_to(self, a: int, b: int) -> dict[int, int]:
        """Image among the joints of link b of every joint of link a; empty if their numbers differ."""
        return self.joint_pairs(a, b).images

    def joint_pairs(self, a: int, b: int) -> JointPairs:
        """Images among the joints of link b of those of link a, whether they mix and in which order."""
        if (a, b) not in self._joints:
            mine, theirs = self.links[a].joints, self.links[b].joints
            if len(mine) != len(theirs) or not mine:
                self._joints[a, b] = JointPairs({}, {})
            elif len(mine) == 1:
                self._joints[a, b] = JointPairs(
                    {mine[0]: theirs[0]}, {mine[0]: self.joint_cost(mine[0], theirs[0])}
                )
            else:
                cost = np.array([[self.joint_cost(i, j) for j in theirs] for i in mine])
                self._joints[a, b] = pair_joints(self.parts, self.matrix, mine, theirs, cost)
        return self._joints[a, b]

    def joint_cost(self, i: int, j: int) -> float:
        """How far joint i's image is from joint j: type, axis up to sign, and anchor."""
        if (i, j) not in self._costs:
            self.measure_joints([tuple(self.parts.skeleton.joint_links[[i, j]].tolist())])
        return self._costs[i, j]

    def holds(self, a: int, b: int, tolerance: float) -> bool:
        """Whether b is where a should be, and joints on a have images on b: no pose decides that."""
        if self.gaps.of_centers([(a, b)])[0] > _CENTER * tolerance * self.parts.size(b):
            return False
        mine, theirs = ([j for c in self.links[x].children for j in self.links[c].joints] for x in (a, b))
        costs = self.gaps.joint_costs([(i, j) for i in mine for j in theirs], _MISFIT)
        return bool((costs.reshape(len(mine), len(theirs)) <= tolerance).any(axis=1).all())

    def worst(self, images: dict[int, int], tolerance: float) -> Misfit:
        """The worst of a matching's pairs of joints and links; above 1 it is no matching."""
        found = Misfit(0.0)
        pairs = [(a, b) for a, b in images.items() if a and a not in self.parts.carried]
        self.measure_joints([pair for pair in pairs if pair not in self._own])
        gaps = self.gaps.of_centers(pairs) / self.parts.link_sizes[columns(pairs)[1]] / _CENTER
        for (a, b), gap in zip(pairs, gaps.tolist(), strict=True):
            link = self.links[a]
            joints = self.joint_pairs(a, b)
            short = len(link.joints) != len(self.links[b].joints) or any(
                c not in images for c in link.children
            )
            if short or (self.model.body_mocapid[a] >= 0) != (self.model.body_mocapid[b] >= 0):
                return Misfit(np.inf, "missing", a, b)
            if gap > found.size * tolerance:
                found = Misfit(gap / max(tolerance, 1e-12), "link", a, b)
            if joints.order > found.size * tolerance:
                found = Misfit(joints.order / max(tolerance, 1e-12), "order", a, b)
            for i, j in joints.images.items():
                cost = joints.costs[i]
                if cost > found.size * tolerance:
                    found = Misfit(cost / max(tolerance, 1e-12), "joint", i, j)
        return found

    def _ties(self, images: dict[int, int]) -> list[tuple[int, int]]:
        """Pairs of the matching that could as well be exchanged with others."""
        return [
            pair
            for pair, swap in self.undecided.items()
            if images.get(pair[0]) == pair[1] and swap[0] in images
        ]

    def ambiguous(self, images: dict[int, int]) -> list[tuple[int, int]]:
        """Pairs of links that even names and ranges do not tell apart."""
        found = []
        for a, b in self._ties(images):
            c, d = self.undecided[a, b]
            if a < c and images.get(c) == d:
                both = ((a, b), (c, d)), ((a, d), (c, b))
                self._compare([pair for pair in itertools.chain(*both) if pair not in self._own])
                now, swapped = (sum(self._cost(*pair) for pair in pairs) for pairs in both)
                if abs(now - swapped) < 1e-6:
                    found.append((a, c))
        return found
