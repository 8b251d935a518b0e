"""Looks for a pose, an axis and a stand of the free bodies that a group keeps.

The pose is the first that fits of those the model has (qpos0, keyframes, zeros, middles of ranges), or one
that is solved for; one that only nearly fits gives way to a later one that clearly does. What fits nearly
is made to fit: a keyframe that is symmetric to 1e-3 would leave every joint with an offset of 1e-3, so that
the pose is averaged over the group, with small offsets taken for none, if the robot fits there as well.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NoReturn

import numpy as np

from torchrl_sym.groups import PointGroup
from torchrl_sym.mujoco.derive.axis import find_axis
from torchrl_sym.mujoco.derive.explanation import explain
from torchrl_sym.mujoco.derive.gaps import columns
from torchrl_sym.mujoco.derive.hints import range_gaps
from torchrl_sym.mujoco.derive.images import SymmetryError
from torchrl_sym.mujoco.derive.loose import Standing, generators, stand
from torchrl_sym.mujoco.derive.matching import Matcher
from torchrl_sym.mujoco.derive.parts import Parts
from torchrl_sym.mujoco.derive.solving import solved
from torchrl_sym.mujoco.model.links import Numbers, Skeleton
from torchrl_sym.mujoco.model.poses import Pose, kinematics, poses, shift
from torchrl_sym.mujoco.model.rotations import quaternion
from torchrl_sym.mujoco.model.types import HINGE, SLIDE, Array, MjModel, label_of

_SNAP = 1e-2  # offsets below it (rad, or relative to a tree's size) are none, if the robot fits as well
_CLOSE = 0.1  # a pose that fits so well (of what is tolerated) is taken without a look at others
_CLEARLY = 0.1  # another pose, or offsets that the ranges say, must fit so much better than the first
_RANGE = 0.1  # of their width, by which ranges may differ at a pose that was solved for


@dataclass
class Stance:
    """Where a group is looked for: a pose, an axis, and how loose trees stand; one matcher per element."""

    pose: Pose
    axis: Array
    standing: Standing
    misfit: float
    matchers: list[Matcher]

    @property
    def words(self) -> str:
        """The pose in words."""
        return "; ".join([self.pose.words, *self.standing.words])

    @property
    def ambiguous(self) -> list[str]:
        """Sentences on parts that nothing tells apart."""
        pairs = {pair for matcher in self.matchers for pair in matcher.ambiguous()}
        model = self.matchers[0].model
        names = [[label_of(model, "body", b) for b in pair] for pair in sorted(pairs)]
        return [*self.standing.ambiguous, *(f"{a} and {b} are alike and in one place" for a, b in names)]


class Search:
    """Looks for the stance of one group.

    Args:
        model: the compiled model.
        group: the group.
        lifts: a quaternion of each element.
        tolerance: of the pairs of joints.
        carried: bodies that are only carried along.
        axis: where the axis is (x, y); None if it is to be found.
    """

    def __init__(
        self,
        model: MjModel,
        group: PointGroup,
        lifts: list[Array],
        tolerance: float,
        carried: frozenset[int],
        axis: tuple[float, float] | None,
    ) -> None:
        self.model, self.group, self.lifts, self.tolerance = model, group, lifts, tolerance
        self.carried, self.axis = carried, axis
        self.matrices = group.matrices.numpy()
        self.skeleton = Skeleton(model)

    def find(self, keyframe: int | str | None) -> Stance:
        """The first stance that fits.

        Raises:
            SymmetryError: none does; the message names what is nearest to fit, and the poses tried.
            KeyError: no such keyframe.
        """
        tried: list[Stance] = []
        for pose in poses(self.model, keyframe):
            tried.append(self._at(pose))
            if tried[-1].misfit <= _CLOSE:
                return self._settled(tried[-1])
            if tried[-1].standing.hopeless:
                break
        if keyframe is None and not tried[-1].standing.hopeless:
            start = tried[0]
            pose = solved(self.skeleton, self.group, start.pose, start.axis, self.carried, self.tolerance)
            if pose is not None and self._in_range(stance := self._at(pose)):
                tried.append(stance)
        best = min(tried, key=lambda stance: stance.misfit)
        if best.misfit > 1:
            self._refuse(tried)
        first = next(stance for stance in tried if stance.misfit <= 1)
        return self._settled(best if best.misfit <= _CLEARLY * first.misfit else first)

    def _at(self, pose: Pose) -> Stance:
        model, parts = self.model, Parts.of(self.skeleton, kinematics(self.model, pose), self.carried)
        if self.axis is None:
            axis = find_axis(parts, self.matrices[generators(self.group)], self.tolerance)[0]
        else:
            axis = np.array([*self.axis, 0.0])
        standing = stand(parts, self.group, axis, self.tolerance)
        data = kinematics(model, self._moved(parts, pose, axis, standing))
        shift(data, -axis)
        # the points of loose trees that are on the axis now, as high as their images
        points = {b: data.xpos[b] + standing.turns[b] @ standing.points[b] for b in standing.turns}
        parts = Parts.of(self.skeleton, data, self.carried).about(points)
        matchers = [
            Matcher(parts, matrix, lift, axis, images)
            for matrix, lift, images in zip(self.matrices, self.lifts, standing.images, strict=True)
        ]
        misfit = max(matcher.misfit(self.tolerance).size for matcher in matchers)
        return Stance(pose, axis, standing, misfit, matchers)

    def _moved(self, parts: Parts, pose: Pose, axis: Array, standing: Standing) -> Pose:
        """The pose with loose trees on the axis."""
        model = self.model
        qpos, mocap_pos, mocap_quat = pose.qpos.copy(), pose.mocap_pos.copy(), pose.mocap_quat.copy()
        orbit = {b: min(images[b] for images in standing.images) for b in standing.turns}
        for b, turn in standing.turns.items():
            first = orbit[b]
            place = axis - turn @ standing.points[b]
            place[2] = (parts.points[first] + standing.points[first])[2] - (turn @ standing.points[b])[2]
            frame = turn @ parts.data.xmat[b].reshape(3, 3)
            same = np.abs(turn - np.eye(3)).max() < 1e-12
            q = parts.data.xquat[b] if same else quaternion(frame)
            mocap = int(model.body_mocapid[b])
            if mocap >= 0:
                mocap_pos[mocap], mocap_quat[mocap] = place, q
            else:
                start = int(model.jnt_qposadr[model.body_jntadr[b]])
                qpos[start : start + 3], qpos[start + 3 : start + 7] = place, q
        return Pose(pose.words, qpos, mocap_pos, mocap_quat)

    def _in_range(self, stance: Stance) -> bool:
        """Whether a pose that was solved for fits, and sends ranges of joints to ranges."""
        return stance.misfit <= 1 and all(
            (range_gaps(matcher.pairing.gaps, list(matcher.joints().items())) <= _RANGE).all()
            for matcher in stance.matchers
        )

    def _settled(self, stance: Stance) -> Stance:
        """The stance at the pose's average over the group, if the robot fits there as well or better."""
        best = stance
        for by_ranges in (False, True):
            qpos = self._average(stance, by_ranges)
            if np.abs(qpos - best.pose.qpos).max(initial=0.0) > 1e-12:
                even = self._at(stance.pose.at(qpos))
                same = all(a.images == b.images for a, b in zip(even.matchers, best.matchers, strict=True))
                factor = _CLEARLY if by_ranges else 1.1
                best = even if same and even.misfit <= factor * best.misfit + 1e-9 else best
        return best

    def _average(self, stance: Stance, by_ranges: bool) -> Array:
        """Mean over the group of the images of hinges and slides, small offsets taken for none."""
        model, qpos = self.model, stance.pose.qpos
        sums = np.zeros(model.nq)
        on_line = np.isin(model.jnt_type, (HINGE, SLIDE))
        for matcher in stance.matchers:
            pairs = [(i, j) for i, j in matcher.joints().items() if on_line[i]]
            (i, j), signs = columns(pairs), matcher.pairing.gaps.signs(pairs)
            moved, ends = signs * qpos[model.jnt_qposadr[i]], model.jnt_qposadr[j]
            sizes = matcher.pairing.parts.link_sizes[self.skeleton.joint_links[i]]
            limits = _SNAP * np.where(model.jnt_type[i] == SLIDE, sizes, 1.0)
            sums[ends] += moved + self._snapped(i, j, signs, qpos[ends] - moved, limits, by_ranges)
        even = qpos.copy()
        address = model.jnt_qposadr[on_line]
        even[address] = sums[address] / len(stance.matchers)
        return even

    def _snapped(
        self, i: Numbers, j: Numbers, signs: Array, offsets: Array, limits: Array, by_ranges: bool
    ) -> Array:
        """Offsets, or those near them that are meant: none, or those between the ranges."""
        limited, middles = self.model.jnt_limited != 0, self.model.jnt_range.mean(axis=1)
        between = middles[j] - signs * middles[i]
        none_near = np.abs(offsets) < limits
        between_near = limited[i] & limited[j] & (np.abs(between - offsets) < limits)
        first, second = (between_near, none_near) if by_ranges else (none_near, between_near)
        meant, other = (between, 0.0) if by_ranges else (0.0, between)
        return np.where(first, meant, np.where(second, other, offsets))

    def _refuse(self, tried: list[Stance]) -> NoReturn:
        best = min(tried, key=lambda stance: stance.misfit)
        names, tolerance = self.group.names, self.tolerance
        found = [
            (matcher.misfit(tolerance), name, matcher)
            for name, matcher in zip(names, best.matchers, strict=True)
        ]
        misfit, name, matcher = next(f for f in found if f[0].size > 1)
        reason = explain(matcher.pairing, misfit, name, tolerance)
        if misfit.kind == "missing":
            raise SymmetryError(reason)
        words = list(dict.fromkeys(stance.words for stance in tried))
        where = (
            f" at the best of {len(words)} poses, {best.words}" if len(words) > 1 else f" at {best.words}"
        )
        listed = f" (tried: {', '.join(words[:6])}{', ...' * (len(words) > 6)})" if len(words) > 1 else ""
        raise SymmetryError(
            f"{reason}{where}{listed}; if another pose is symmetric, pass keyframe=... for it"
        )
