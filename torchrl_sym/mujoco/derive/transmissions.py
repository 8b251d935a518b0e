"""What actuators drive, and whether one drives the image of what another does.

A motor on a hinge, slide or tendon pulls along a length, one on a ball or free joint along a vector of its
velocities: both are vectors v whose image is Q v. A thruster pushes in the frame of its site, or in that of
a reference site; a slider-crank pulls between two sites; adhesion pulls at the contacts of a body.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchrl_sym.mujoco.derive.coordinates import CoordinateMap
from torchrl_sym.mujoco.derive.images import Image
from torchrl_sym.mujoco.derive.lengths import joint_length, map_lengths, tendon_length
from torchrl_sym.mujoco.derive.matching import Matcher
from torchrl_sym.mujoco.derive.sites import site_frame, site_gap
from torchrl_sym.mujoco.model.releases import weld_ids
from torchrl_sym.mujoco.model.types import BALL, FREE, Array, MjModel, mj

_KINDS = {
    int(getattr(mj.mjtTrn, f"mjTRN_{name.upper()}")): name
    for name in ("joint", "jointinparent", "tendon", "site", "body", "slidercrank")
}
_ANGLE = 0.1  # rad: vectors further apart are not each other's images


@dataclass(frozen=True)
class Fit:
    """An actuator drives the image of what another drives: the sign between them, and how far off it is."""

    sign: float
    misfit: float = 0.0


def dofs(model: MjModel, joint: int) -> int:
    """Number of velocities of a joint."""
    return {FREE: 6, BALL: 3}.get(int(model.jnt_type[joint]), 1)


class Transmissions:
    """What each actuator drives, and its image under one element."""

    def __init__(
        self, matcher: Matcher, map_: CoordinateMap, tendons: dict[int, Image], tolerance: float
    ) -> None:
        self.matcher, self.map, self.tendons, self.tolerance = matcher, map_, tendons, tolerance
        self.model = matcher.model
        self.matrix, self.offset = map_lengths(self.model, map_, tendons)

    def kind(self, a: int) -> str:
        """Kind of transmission; empty if it is not supported."""
        return _KINDS.get(int(self.model.actuator_trntype[a]), "")

    def gear(self, a: int) -> Array:
        """The six gears of an actuator of one output."""
        addresses = getattr(self.model, "actuator_outadr", None)
        return self.model.actuator_gear[a if addresses is None else addresses[a]]

    def unsupported(self, a: int) -> str:
        """Why an actuator's image cannot be told; empty if it can."""
        model = self.model
        if getattr(model, "actuator_ctrlnum", np.ones(a + 1))[a] != 1:
            return "it has several controls, which is not supported"
        if not self.kind(a):
            return f"its transmission is not supported; supported are {sorted(set(_KINDS.values()))}"
        if int(model.actuator_plugin[a]) >= 0:
            return "it is a plugin, which cannot be looked into"
        return ""

    def length(self, a: int) -> Array | None:
        """What an actuator drives as a vector over velocities and tendons; None if it is none."""
        model, kind, gear = self.model, self.kind(a), self.gear(a)
        target = int(model.actuator_trnid[a, 0])
        if kind == "tendon":
            return gear[0] * tendon_length(model, target)
        if kind not in ("joint", "jointinparent"):
            return None
        size = dofs(model, target)
        if size == 1:
            return gear[0] * joint_length(model, target)
        if kind == "jointinparent":
            return None
        vector, start = np.zeros(model.nv + model.ntendon), int(model.jnt_dofadr[target])
        vector[start : start + size] = gear[:size]
        return vector

    def shift(self, a: int) -> float:
        """What is added to the length of an actuator whose joints have offsets."""
        length = self.length(a)
        return 0.0 if length is None else float(length @ self.offset)

    def fits(self, known: list[int]) -> dict[tuple[int, int], Fit]:
        """Which actuators drive the images of what which do."""
        lengths = {a: length for a in known if (length := self.length(a)) is not None and length.any()}
        found = {}
        if lengths:
            whole = np.stack(list(lengths.values()))
            whole /= np.linalg.norm(whole, axis=1, keepdims=True)
            near = np.abs(whole @ self.matrix.T @ whole.T) > np.cos(_ANGLE)
            order = list(lengths)
            for row, column in np.argwhere(near):
                found[order[row], order[column]] = self._along(
                    order[row], order[column], self.matrix @ whole[row], whole[column]
                )
        rest = [a for a in known if a not in lengths]
        for a in rest:
            for b in rest:
                if self.kind(a) == self.kind(b):
                    found[a, b] = self._frames(a, b)
        return {pair: fit for pair, fit in found.items() if fit is not None}

    def _frames(self, a: int, b: int) -> Fit | None:
        """Of what is no length: sites, bodies, and joints of three or six velocities."""
        fit = {
            "site": self._sites,
            "slidercrank": self._cranks,
            "body": self._bodies,
            "jointinparent": self._in_parent,
        }.get(self.kind(a), self._idle)(a, b)
        return fit if fit is None or fit.misfit <= max(self.tolerance, _ANGLE) else None

    def _idle(self, a: int, b: int) -> Fit | None:
        """Of joints and tendons that a gear of zero drives."""
        return Fit(1.0) if self.model.actuator_trnid[a, 0] == self.model.actuator_trnid[b, 0] else None

    def _along(self, a: int, b: int, image: Array, theirs: Array) -> Fit | None:
        model = self.model
        if self.kind(a) == self.kind(b) == "tendon":
            tendon = self.tendons[int(model.actuator_trnid[a, 0])]
            if tendon.mixture or tendon.index != int(model.actuator_trnid[b, 0]):
                return None  # how alike the tendons are is said of them
            return Fit(float(tendon.sign * np.sign(self.gear(a)[0] * self.gear(b)[0])))
        fit = _parallel(image, theirs)
        joint = int(model.actuator_trnid[a, 0])
        is_ball = self.kind(a) == "joint" and int(model.jnt_type[joint]) == BALL
        if is_ball and self.is_servo(a):
            return self._turned(fit, self.map.at_zero[joint], self.map.frames[int(model.jnt_bodyid[joint])])
        return fit

    def _turned(self, fit: Fit | None, parent: Array, child: Array) -> Fit | None:
        """A servo measures an angle, which has an image if both of its frames are turned alike."""
        gap = float(np.abs(parent - child).max())
        return None if fit is None or gap > _ANGLE else Fit(fit.sign, max(fit.misfit, gap))

    def _in_parent(self, a: int, b: int) -> Fit | None:
        """A ball or free joint's gear in the frame before the joint."""
        joint, other = (int(self.model.actuator_trnid[x, 0]) for x in (a, b))
        if self.map.joints.get(joint) != other:
            return None
        det, gear, theirs = self.matcher.det, self.gear(a), self.gear(b)
        if dofs(self.model, joint) == 6:
            turn = self.matcher.matrix
            return _parallel(np.concatenate([turn @ gear[:3], det * turn @ gear[3:]]), theirs)
        parent = self.map.at_zero[joint]
        fit = _parallel(det * parent @ gear[:3], theirs[:3])
        if self.is_servo(a):
            return self._turned(fit, parent, self.map.frames[int(self.model.jnt_bodyid[joint])])
        return fit

    def _sites(self, a: int, b: int) -> Fit | None:
        sites, theirs = self.model.actuator_trnid[[a, b]].tolist()
        if (sites[1] < 0) != (theirs[1] < 0):
            return None
        gaps = [site_gap(self.matcher, i, j) for i, j in zip(sites, theirs, strict=True) if i >= 0]
        frame = own = site_frame(self.matcher, sites[0], theirs[0])
        gear, other = self.gear(a), self.gear(b)
        if sites[1] >= 0:  # the wrench is in the frame of the reference site
            frame = site_frame(self.matcher, sites[1], theirs[1])
        wrench = np.concatenate([frame @ gear[:3], self.matcher.det * frame @ gear[3:]])
        fit = _parallel(wrench, other)
        for part in (slice(0, 3), slice(3, 6)):  # a rotor's torque is small, and says which way it turns
            if fit and gear[part].any() and other[part].any():
                one = _parallel(wrench[part], other[part])
                if one is None or one.sign != fit.sign:
                    return None
                fit = Fit(fit.sign, max(fit.misfit, one.misfit))
        if sites[1] >= 0 and gear[3:].any() and self.is_servo(a):
            fit = self._turned(fit, frame, own)
        return None if fit is None else Fit(fit.sign, max([fit.misfit, *gaps]))

    def _cranks(self, a: int, b: int) -> Fit | None:
        cranks, sliders = self.model.actuator_trnid[[a, b]].T.tolist()
        gaps = [site_gap(self.matcher, *pair) for pair in (cranks, sliders)]
        if not np.isfinite(max(gaps)):
            return None
        rods = self.model.actuator_cranklength[[a, b]]
        rod = abs(float(rods[0] - rods[1])) / max(float(rods.max()), 1e-12)
        away = float(np.linalg.norm(site_frame(self.matcher, *sliders)[:, 2] - np.eye(3)[2]))
        sign = float(np.sign(self.gear(a)[0] * self.gear(b)[0]))
        return Fit(sign, max([away, rod, *gaps]))

    def _bodies(self, a: int, b: int) -> Fit | None:
        bodies = self.model.actuator_trnid[[a, b], 0]
        one, other = (int(link) for link in weld_ids(self.model)[bodies])
        return Fit(1.0) if self.map.bodies.get(one) == other else None

    def is_servo(self, a: int) -> bool:
        """Whether an actuator's force depends on its length."""
        model = self.model
        affine = int(model.actuator_gaintype[a]) == int(mj.mjtGain.mjGAIN_AFFINE)
        return bool(model.actuator_biasprm[a, 1] != 0 or (affine and model.actuator_gainprm[a, 1] != 0))


def _parallel(image: Array, target: Array) -> Fit | None:
    """Whether two vectors point along one line, whatever their lengths."""
    sizes = float(np.linalg.norm(image)), float(np.linalg.norm(target))
    if min(sizes) == 0:
        return Fit(1.0) if max(sizes) == 0 else None
    one, other = image / sizes[0], target / sizes[1]
    gap, minus = min((float(np.linalg.norm(one - sign * other)), -sign) for sign in (1.0, -1.0))
    return Fit(-minus, gap if gap > 1e-9 else 0.0) if gap <= _ANGLE else None
