"""Which link and which joint is the image of which, under one isometry.

Matching at a single pose is enough: a kinematic tree is determined by its reference configuration and its
joint axes (the product of exponentials), so if masses, anchors and axes are mapped onto each other at one
pose that the symmetry keeps, the equations of motion are mapped onto each other everywhere.

Trees are matched from the root: the children of a link go to children of its image, so that the sum over
their subtrees of all distances is least. Where two assignments are equally good, as for the fingers of a
closed gripper, names and ranges decide, and then that parts stay where they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from torchrl_sym.mujoco.derive.chains import JointPairs, pair_joints
from torchrl_sym.mujoco.derive.names import counterparts, exchanged
from torchrl_sym.mujoco.derive.parts import Parts
from torchrl_sym.mujoco.model.links import is_loose
from torchrl_sym.mujoco.model.types import BALL, FREE, HINGE, SLIDE, Array, label_of, name_of

_MISFIT = 1e3  # cost of a pair that cannot be the image of each other; far above any distance
_STAY = 1e-9  # links at one place stay where they are
_UNDECIDED = 2e-2  # assignments whose costs differ by less are told apart by names and ranges
_NAME, _RANGE = 3e-2, 2e-2  # what a name or a range that disagrees costs then
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
        self.det = round(float(np.linalg.det(matrix)))
        masses = [link.mass for body, link in self.links.items() if body]
        self.total_mass = max(sum(masses), 1e-12)
        inertias = [float(np.trace(link.inertia)) for body, link in self.links.items() if body]
        self.total_inertia = max([*inertias, 1e-12])
        self.undecided: dict[tuple[int, int], tuple[int, int]] = {}
        self._names: tuple[bool, bool] | None = None
        self._costs: dict[tuple[int, int], float] = {}
        self._known: dict[str, dict[str, int]] = {}
        self._pairs: dict[tuple[int, int], tuple[float, list[tuple[int, int]]]] = {}
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
        trees = (known or {}), self.links[0].children if only is None else only
        images = self._descend(a, b, *trees)
        if not self._ties(images):
            return images
        # once more, with names and ranges where geometry is undecided
        self._names = self._exchanged(images)
        self._pairs.clear()
        return self._descend(a, b, *trees)

    def _descend(self, a: int, b: int, known: dict[int, int], trees: Sequence[int]) -> dict[int, int]:
        images, stack = {}, [(a, b)]
        while stack:
            a, b = stack.pop()
            images[a] = b
            if a == 0:
                mine = [c for c in trees if c not in known]
                theirs = [c for c in trees if c not in known.values()]
                stack += [*known.items(), *self.assign(mine, theirs)[1]]
            else:
                stack += self._pair(a, b)[1]
        return dict(sorted(images.items()))

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
            turn, away = self.joint_gaps(i, j)
            size = self.parts.size(int(self.model.jnt_bodyid[j]))
            self._costs[i, j] = 1 - float(np.cos(turn)) + away / size if np.isfinite(turn) else _MISFIT
        return self._costs[i, j]

    def joint_gaps(self, i: int, j: int) -> tuple[float, float]:
        """Angle (rad) between the axes and distance (m) between the anchors; infinite for other types."""
        kind = int(self.model.jnt_type[i])
        if kind != int(self.model.jnt_type[j]):
            return np.inf, np.inf
        if kind == FREE:
            return 0.0, 0.0
        offset = self.matrix @ self.parts.anchors[i] - self.parts.anchors[j]
        if kind == BALL:
            return 0.0, float(np.sqrt(offset @ offset))
        axis = self.parts.axes[j]
        image = self.matrix @ self.parts.axes[i]
        x, y, z = image
        u, v, w = axis
        sine = np.sqrt((y * w - z * v) ** 2 + (z * u - x * w) ** 2 + (x * v - y * u) ** 2)
        turn = float(np.arctan2(sine, abs(image @ axis)))
        if kind == SLIDE:
            return turn, 0.0  # a slide's anchor does not matter
        offset = offset - (offset @ axis) * axis  # a hinge's anchor may be anywhere on its axis
        return turn, float(np.sqrt(offset @ offset))

    def holds(self, a: int, b: int, tolerance: float) -> bool:
        """Whether b is where a should be, and joints on a have images on b: no pose decides that."""
        if self.center_gap(a, b) > _CENTER * tolerance * self.parts.size(b):
            return False
        mine, theirs = ([j for c in self.links[x].children for j in self.links[c].joints] for x in (a, b))
        return all(any(self.joint_cost(i, j) <= tolerance for j in theirs) for i in mine)

    def center_gap(self, a: int, b: int) -> float:
        """Distance (m) of the centre of mass of link a's image from that of b; 0 if one has no mass."""
        if min(self.links[a].mass, self.links[b].mass) <= 0:
            return 0.0
        return float(np.linalg.norm(self.matrix @ self.parts.centers[a] - self.parts.centers[b]))

    def worst(self, images: dict[int, int], tolerance: float) -> Misfit:
        """The worst of a matching's pairs of joints and links; above 1 it is no matching."""
        found = Misfit(0.0)
        for a, b in images.items():
            if a == 0 or a in self.parts.carried:
                continue
            link = self.links[a]
            joints = self.joint_pairs(a, b)
            short = len(link.joints) != len(self.links[b].joints) or any(
                c not in images for c in link.children
            )
            if short or self._is_mocap(a) != self._is_mocap(b):
                return Misfit(np.inf, "missing", a, b)
            gap = self.center_gap(a, b) / self.parts.size(b) / _CENTER
            if gap > found.size * tolerance:
                found = Misfit(gap / max(tolerance, 1e-12), "link", a, b)
            if joints.order > found.size * tolerance:
                found = Misfit(joints.order / max(tolerance, 1e-12), "order", a, b)
            for i, j in joints.images.items():
                cost = joints.costs[i]
                if cost > found.size * tolerance:
                    found = Misfit(cost / max(tolerance, 1e-12), "joint", i, j)
        return found

    def assign(self, mine: Sequence[int], theirs: Sequence[int]) -> tuple[float, list[tuple[int, int]]]:
        """Best pairs of links out of two sets of siblings, and their cost."""
        if not mine or not theirs:
            return _MISFIT * abs(len(mine) - len(theirs)), []
        if len(mine) == len(theirs) == 1:
            return self._pair(mine[0], theirs[0])[0], [(mine[0], theirs[0])]
        table = self._table(mine, theirs)
        rows, columns = linear_sum_assignment(table)
        pairs = [(mine[r], theirs[c]) for r, c in zip(rows, columns, strict=True)]
        swap = table[np.ix_(rows, columns)]
        swap = swap + swap.T - np.add.outer(swap.diagonal(), swap.diagonal())
        for r, c in np.argwhere(np.triu(swap < _UNDECIDED, 1)):
            self.undecided[pairs[r]], self.undecided[pairs[c]] = pairs[c], pairs[r]
        cost = float(table[rows, columns].sum()) + _MISFIT * abs(len(mine) - len(theirs))
        return cost, pairs

    def _table(self, mine: Sequence[int], theirs: Sequence[int]) -> Array:
        if len(theirs) <= _NEAREST:
            return np.array([[self._pair(c, d)[0] for d in theirs] for c in mine])
        ends = self.parts.centers[list(mine)] @ self.matrix.T, self.parts.centers[list(theirs)]
        apart = np.linalg.norm(ends[0][:, None] - ends[1], axis=-1)
        table = _MISFIT * (1 + apart / self.parts.extent)
        for row, c in enumerate(mine):
            for column in np.argsort(apart[row], kind="stable")[:_NEAREST]:
                table[row, column] = self._pair(c, theirs[column])[0]
        return table

    def _pair(self, a: int, b: int) -> tuple[float, list[tuple[int, int]]]:
        if (a, b) not in self._pairs:  # not functools.cache, which does not pickle
            self._pairs[a, b] = self._pair_of_links(a, b)
        return self._pairs[a, b]

    def _pair_of_links(self, a: int, b: int) -> tuple[float, list[tuple[int, int]]]:
        """Cost of mapping subtree a onto subtree b, and the best pairs of children."""
        if a in self.parts.carried or b in self.parts.carried:
            return (0.0 if a == b else _MISFIT), []
        one, other = self.links[a], self.links[b]
        cost = self.center_gap(a, b) / self.parts.size(b) + abs(one.mass - other.mass) / self.total_mass
        image = self.matrix @ one.inertia @ self.matrix.T
        cost += float(np.abs(image - other.inertia).max()) / self.total_inertia
        cost += _STAY * (a != b)
        cost += _MISFIT * (self._is_mocap(a) != self._is_mocap(b))
        joints = self.joint_pairs(a, b)
        cost += _MISFIT * (len(one.joints) != len(other.joints))
        cost += sum(joints.costs.values()) + _ORDER * joints.order
        if self._names is not None:
            cost += self._hint(a, b, joints.images)
        below, pairs = self.assign(one.children, other.children)
        return cost + below, pairs

    def _is_mocap(self, body: int) -> bool:
        return bool(self.model.body_mocapid[body] >= 0)

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
                now, swapped = (
                    sum(self._pair(*pair)[0] for pair in p) for p in (((a, b), (c, d)), ((a, d), (c, b)))
                )
                if abs(now - swapped) < 1e-6:
                    found.append((a, c))
        return found

    def _exchanged(self, images: dict[int, int]) -> tuple[bool, bool]:
        """Whether left and right, front and hind change places, by the names of what is beyond doubt."""
        default = exchanged(self.acting)
        ties = {pair[0] for pair in self._ties(images)}
        votes = {flags: 0 for flags in ((False, False), (True, False), (False, True), (True, True))}
        for a, b in images.items():
            if a and a not in ties and a != b:
                name, image = (name_of(self.model, "body", x) for x in (a, b))
                for flags in votes:
                    votes[flags] += image in counterparts(name, *flags)
        best = max(votes, key=lambda flags: (votes[flags], flags == default))
        return best if votes[best] > votes[default] else default

    def _hint(self, a: int, b: int, joints: dict[int, int]) -> float:
        """What speaks against a pair beside geometry: names that have another counterpart, and ranges."""
        assert self._names is not None
        cost = _NAME * self._named_otherwise("body", a, b)
        for i, j in joints.items():
            cost += _NAME * self._named_otherwise("joint", i, j) + _RANGE * self.range_gap(i, j)
        return cost

    def _named_otherwise(self, kind: str, a: int, b: int) -> bool:
        assert self._names is not None
        known = self._numbers(kind)
        other = [known[n] for n in counterparts(name_of(self.model, kind, a), *self._names) if n in known]
        return bool(other) and b not in other

    def _numbers(self, kind: str) -> dict[str, int]:
        if kind not in self._known:
            count = {"body": self.model.nbody, "joint": self.model.njnt}[kind]
            self._known[kind] = {name_of(self.model, kind, index): index for index in range(count)}
        return self._known[kind]

    def range_gap(self, i: int, j: int) -> float:
        """How far the image of joint i's range is from that of joint j, at most 1."""
        model, kind = self.model, int(self.model.jnt_type[i])
        if kind not in (HINGE, SLIDE) or int(model.jnt_type[j]) != kind:
            return 0.0
        if not (model.jnt_limited[i] and model.jnt_limited[j]):
            return float(model.jnt_limited[i] != model.jnt_limited[j])
        qpos, address = self.parts.data.qpos, model.jnt_qposadr
        sign = self.sign(i, j)
        shift = qpos[address[j]] - sign * qpos[address[i]]
        one, other = np.sort(sign * model.jnt_range[i] + shift), model.jnt_range[j]
        return min(1.0, float(np.abs(one - other).max()) / max(float(np.ptp(other)), 1e-9))

    def sign(self, i: int, j: int) -> float:
        """Sign between the coordinates of two hinges or slides that are images of each other."""
        handed = self.det if int(self.model.jnt_type[i]) == HINGE else 1
        return 1.0 if handed * float(self.matrix @ self.parts.axes[i] @ self.parts.axes[j]) > 0 else -1.0

    def explain(self, misfit: Misfit, element: str, tolerance: float) -> str:
        """What has no image and how far the nearest is, in degrees and millimetres."""
        model, a, b = self.model, misfit.one, misfit.other
        if misfit.kind == "missing":
            return (
                f"{label_of(model, 'body', a)} has no image under {element!r}: no body with as many joints "
                "and children is left on the other side"
            )
        limit = f"tolerance {tolerance:g}"
        if misfit.kind == "link":
            gap, size = self.center_gap(a, b), self.parts.size(b)
            name = name_of(model, "body", a)
            return (
                f"{label_of(model, 'body', a)} has no image under {element!r}: the nearest, "
                f"{label_of(model, 'body', b)}, has its centre of mass {1e3 * gap:.1f} mm beside it "
                f"({100 * gap / size:.0f} % of the size of what moves; {limit})"
                + f"; if it may have any shape, pass carried=[{name!r}]"
                * self._can_be_carried(a)
            )
        if misfit.kind == "order":
            return self._explain_order(a, b, element)
        turn, away = self.joint_gaps(a, b)
        if not np.isfinite(turn):
            what = label_of(model, "joint", a)
            return f"{what} has no image under {element!r}: no joint of its type is there"
        return (
            f"{label_of(model, 'joint', a)} has no image under {element!r}: the nearest, "
            f"{label_of(model, 'joint', b)}, misses it by {np.degrees(turn):.2g} degrees and "
            f"{1e3 * away:.3g} mm ({limit})"
        )

    def _explain_order(self, a: int, b: int, element: str) -> str:
        def listed(joints: Sequence[int]) -> str:
            return ", ".join(label_of(self.model, "joint", j) for j in joints)

        images = self.joints_to(a, b)
        return (
            f"{label_of(self.model, 'body', a)} has no image under {element!r}: its joints, "
            f"{listed(self.links[a].joints)}, go to {listed(list(images.values()))} in this order, but "
            f"{label_of(self.model, 'body', b)} has them in the order {listed(self.links[b].joints)}, "
            "and they do not commute; list the joints of both bodies in the same order, or use a ball joint"
        )

    def _can_be_carried(self, body: int) -> bool:
        return is_loose(self.model, body) and not self.links[body].children
