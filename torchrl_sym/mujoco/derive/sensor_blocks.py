"""How the readings of a sensor become those of the sensor that is its image."""

from __future__ import annotations

import numpy as np
from scipy.linalg import block_diag

from torchrl_sym.mujoco.derive.measurements import JOINTS, Measurements
from torchrl_sym.mujoco.derive.sensor_places import Object
from torchrl_sym.mujoco.derive.sensor_rules import RAY_FIELDS, RULES
from torchrl_sym.mujoco.derive.sites import site_frame
from torchrl_sym.mujoco.model.rotations import conjugate, product, quaternion, sandwich
from torchrl_sym.mujoco.model.types import BALL, Array, mj

_SITE = int(mj.mjtTrn.mjTRN_SITE)


class NotLinear(ValueError):
    """A sensor's reading is not mapped by a matrix; the message says why."""


class SensorBlocks:
    """Matrices between the readings of sensors and their images, under one element."""

    def __init__(self, measurements: Measurements) -> None:
        self.what, self.action, self.model = measurements, measurements.action, measurements.model
        self.places, self.coordinates = measurements.places, measurements.coordinates
        self.matcher = measurements.matcher
        self.turn, self.det = self.matcher.matrix, self.matcher.det

    def block(self, s: int, t: int) -> tuple[Array, float]:
        """Matrix from the readings of s to those of its image t, and the offset.

        Raises:
            NotLinear: there is none.
        """
        kind, dim = self.what.kind(s), int(self.model.sensor_dim[s])
        measures, a, b = RULES[kind][1], self.what.object(s)[1], self.what.object(t)[1]
        if measures == "scalar":
            return np.eye(dim), 0.0
        if measures == "signed":
            sign, offset = self.signed(s)
            return np.full((1, 1), sign), offset if kind.endswith("POS") else 0.0
        if measures == "ball":
            whole, start = self.coordinates.qvel, self.model.jnt_dofadr
            if kind == "BALLQUAT":
                whole, start = self.coordinates.qpos, self.model.jnt_qposadr
            return whole[start[b] : start[b] + dim, start[a] : start[a] + dim], 0.0
        if measures == "contact":
            straight, exchanged = self.what.contacts.gaps(self.what.watched(s), self.what.watched(t))
            found = self.what.contacts.block(s, self.what.watched(s), exchanged < straight)
            if isinstance(found, str):
                raise NotLinear(found)
            return found, 0.0  # it has no cutoff
        if measures == "pair":
            straight, exchanged = self.what.pair_misfits(s, t)
            swap = exchanged < straight  # a normal points from the first object to the second
            block = {
                "GEOMDIST": np.eye(1),
                "GEOMNORMAL": -self.turn if swap else self.turn,
                "GEOMFROMTO": np.kron(np.eye(2)[:: -1 if swap else 1], self.turn),
            }[kind]
        elif measures == "ray":
            fields = int(self.model.sensor_intprm[s, 0])  # a bit for each
            sizes = [size for bit, size in enumerate(RAY_FIELDS) if fields >> bit & 1]
            block = np.array(block_diag(*(np.eye(1) if size == 1 else self.turn for size in sizes)))
        elif measures == "quaternion":
            block = self._quaternion_block(s, t)
        else:
            at = self.what.object if measures in ("polar", "axial", "magnetic") else self.what.reference
            block = self.places.frame(at(s), at(t))
            if measures.endswith("axial"):
                block = self.det * block
            elif measures == "magnetic":
                block = self._magnetic_sign() * block
            elif measures == "axis":
                block = float(np.sign(self.what.axis(s, t))) * block
        self._check_cutoff(s, block)
        return block, 0.0

    def _check_cutoff(self, s: int, block: Array) -> None:
        clips = self.model.sensor_cutoff[s] > 0 and int(self.model.sensor_datatype[s]) == 0
        size = np.abs(block)
        if (
            clips
            and RULES[self.what.kind(s)][0] != "pair"
            and (np.minimum(size, abs(size - 1)) > 1e-9).any()
        ):
            raise NotLinear(
                "its cutoff clips every entry by itself, but the element mixes entries; remove the cutoff"
            )

    def signed(self, s: int) -> tuple[float, float]:
        """Sign and offset of what a joint, a tendon or an actuator measures."""
        where, (_, index) = RULES[self.what.kind(s)][0], self.what.object(s)
        if where == "joint":
            return self.coordinates.signs.get(index, 1.0), self.coordinates.offsets[index]
        if where == "tendon":
            return self.action.tendons[index].sign, self.action.tendons[index].offset
        image, transmission = self.action.actuators[index], int(self.model.actuator_trntype[index])
        if self.what.kind(s) == "ACTUATORPOS":
            target = int(self.model.actuator_trnid[index, 0])
            if transmission in JOINTS and int(self.model.jnt_type[target]) == BALL:
                raise NotLinear("it measures the angle of a ball joint; measure its ballquat")
            if transmission == _SITE and self._turns(index, image.index):
                raise NotLinear(
                    "it measures the rotation between two sites whose frames are turned differently"
                )
        return image.sign, image.length_offset

    def _turns(self, a: int, b: int) -> bool:
        """Whether actuator a measures a rotation between sites whose frames do not turn alike."""
        sites, images = self.model.actuator_trnid[[a, b]].tolist()
        if sites[1] < 0 or not self.model.actuator_gear[a, 3:].any():
            return False
        one, other = (site_frame(self.matcher, *pair) for pair in zip(sites, images, strict=True))
        return bool(np.abs(one - other).max() > 1e-9)

    def _magnetic_sign(self) -> int:
        """The constant field is no part of the state: c V maps its reading if c R m = m for a sign c."""
        field = np.array(self.model.opt.magnetic)
        for sign in (self.det, -self.det):
            if np.allclose(sign * self.turn @ field, field, atol=1e-9 * max(1.0, float(abs(field).max()))):
                return sign
        raise NotLinear(
            f"the magnetic field {field.tolist()} is not kept, not even up to its sign; set "
            "option/magnetic to a vertical field"
        )

    def _quaternion_block(self, s: int, t: int) -> Array:
        q_turn = self.matcher.lift

        def lift(one: Object | None, other: Object | None) -> Array:
            if one is None or other is None:
                return q_turn
            if self.places.link(*one) in self.matcher.carried:
                return quaternion(self.places.frame(one, other))
            start, end = map(quaternion, self.places.rotations(one, other))
            return product(conjugate(end), product(q_turn, start))

        frame = lift(self.what.object(s), self.what.object(t))
        return sandwich(lift(self.what.reference(s), self.what.reference(t)), conjugate(frame))
