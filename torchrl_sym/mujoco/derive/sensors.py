"""Finds the image of every sensor, from the images of all it may measure.

Sensors are matched directly, by link and place rather than through images of their objects: two range
finders at one place that look in different directions are told apart, and every duplicate has an image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import linear_sum_assignment

from torchrl_sym.mujoco.derive.coordinates import CoordinateMap
from torchrl_sym.mujoco.derive.images import Image
from torchrl_sym.mujoco.derive.matching import Matcher
from torchrl_sym.mujoco.derive.sensor_rules import (
    _AXES,
    _OBJECTS,
    _POSES,
    _RAY_FIELDS,
    _RULES,
    _TYPES,
    _UNSUPPORTED,
)
from torchrl_sym.mujoco.model.releases import weld_ids
from torchrl_sym.mujoco.model.rotations import conjugate, product, quaternion, sandwich
from torchrl_sym.mujoco.model.types import BALL, Array, MjModel, mj, name_of

_MISFIT = 1e6  # cost of a pair that cannot be the image of each other


class _NotLinear(ValueError):
    """A sensor's reading is not mapped by a matrix; the message says why."""


@dataclass
class SensorMap:
    """One element's action: images and blocks by sensor, and why the others have none."""

    images: dict[int, Image] = field(default_factory=dict)
    blocks: dict[int, Array] = field(default_factory=dict)
    refusals: dict[int, str] = field(default_factory=dict)


def sensor_matrices(
    model: MjModel, maps: Sequence[SensorMap], sensors: Sequence[int], elements: Sequence[str]
) -> list[Array]:
    """One matrix per element on the readings of some sensors, in the order given.

    Raises:
        ValueError: a sensor has no linear image, or one that is not among those asked for.
    """
    sizes = [int(model.sensor_dim[s]) for s in sensors]
    start = dict(zip(sensors, np.cumsum([0, *sizes[:-1]]), strict=True)) if sensors else {}
    matrices = []
    for map_, element in zip(maps, elements, strict=True):
        matrix = np.zeros((sum(sizes), sum(sizes)))
        for s, size in zip(sensors, sizes, strict=True):
            name = name_of(model, "sensor", s)
            if s in map_.refusals:
                raise ValueError(
                    f"sensor {name!r} has no representation under {element!r}: {map_.refusals[s]}"
                    "; or select other sensors with sensors(names)"
                )
            image = map_.images[s].index
            if image not in start:
                raise ValueError(
                    f"{element!r} sends sensor {name!r} to {name_of(model, 'sensor', image)!r}, which is "
                    "not among the sensors asked for; add it"
                )
            matrix[start[image] : start[image] + size, start[s] : start[s] + size] = map_.blocks[s]
        matrices.append(matrix)
    return matrices


def _assign(cost: Array) -> list[tuple[int, int]]:
    """Best pairs; sensors that measure the same go to their images in order, so that the maps compose."""
    rows, columns = (
        np.tril(np.isclose(c[:, None], c[None], atol=1e-9).all(-1), -1).sum(1) for c in (cost, cost.T)
    )
    ranked = cost + 1e-8 * np.abs(np.subtract.outer(rows, columns))
    return list(zip(*linear_sum_assignment(ranked), strict=True))


@dataclass
class SensorMapper:
    """Finds the image of every sensor under one isometry, from the images of all it may measure."""

    matcher: Matcher
    coordinates: CoordinateMap
    tendons: dict[int, Image]
    actuators: dict[int, Image]
    tolerance: float

    def __post_init__(self) -> None:
        self.model, self.data, self.image = self.matcher.model, self.matcher.data, self.matcher.image
        self.turn, self.det, self.extent = self.matcher.matrix, self.matcher.det, self.matcher.extent

    def map(self) -> SensorMap:
        """Image and block of every sensor that has them; never an error."""
        mj.mj_camlight(self.model, self.data)  # cameras' frames, which only sensors need
        mj.mj_camlight(self.model, self.image)
        out = SensorMap()
        classes: dict[tuple, list[int]] = {}
        for s in range(self.model.nsensor):
            reason = self.unsupported(s)
            if reason:
                out.refusals[s] = reason
            else:
                classes.setdefault(self.signature(s), []).append(s)
        for members in classes.values():
            misfit = np.array([[self.misfit(s, t) for t in members] for s in members])
            for i, j in _assign(misfit):
                if misfit[i, j] <= self.tolerance:
                    self._add(out, members[i], members[j])
                else:
                    out.refusals[members[i]] = (
                        "no sensor of its kind, cutoff and timing measures the image of what it measures; "
                        "add the missing one or use a smaller group"
                    )
        return out

    def _add(self, out: SensorMap, s: int, t: int) -> None:
        try:
            block, offset = self.block(s, t)
        except _NotLinear as error:
            out.refusals[s] = str(error)
            return
        out.images[s] = Image(t, float(block[0, 0]) if block.size == 1 else 1.0, offset)
        out.blocks[s] = block
        if abs(offset) > 1e-9:
            out.refusals[s] = (
                f"its reading is mapped with an offset of {offset:.6g}, as the pose that the group keeps "
                "is not at zero; use joint_positions or map_qpos"
            )

    def kind(self, s: int) -> str:
        return _TYPES[int(self.model.sensor_type[s])]

    def object(self, s: int) -> tuple[str, int]:
        return _OBJECTS[int(self.model.sensor_objtype[s])], int(self.model.sensor_objid[s])

    def reference(self, s: int) -> tuple[str, int] | None:
        index = int(self.model.sensor_refid[s])
        if index < 0 or self.kind(s) in ("FRAMELINACC", "FRAMEANGACC"):  # MuJoCo has no relative ones
            return None
        return _OBJECTS[int(self.model.sensor_reftype[s])], index

    def unsupported(self, s: int) -> str:
        """Why a sensor cannot be mapped under any element; empty if it can."""
        kind = self.kind(s)
        if kind not in _RULES:
            return _UNSUPPORTED.get(kind, f"sensors of type {kind.lower()} are not supported")
        for object_ in filter(None, (self.object(s), self.reference(s))):
            if object_[0] == "CAMERA" and (kind == "RANGEFINDER" or self.model.cam_mode[object_[1]] != 0):
                return "it is on a camera: only frame sensors on cameras of mode 'fixed' are supported"
        if _RULES[kind][0] == "actuator":
            a, site = self.object(s)[1], int(mj.mjtTrn.mjTRN_SITE)
            if self.model.actuator_trntype[a] == site and self.model.actuator_trnid[a, 1] >= 0:
                return "its actuator has a reference site, which is not supported"
        return ""

    def signature(self, s: int) -> tuple:
        """What a sensor and its image have in common."""
        model, kind = self.model, self.kind(s)
        objects = [self.object(s)[0], (self.reference(s) or ("WORLD", -1))[0]]
        # a delayed sensor answers later than an image without delay
        fields = ("dim", "datatype", "cutoff", "intprm", "delay", "interval", "history")
        return (
            "AXIS" if kind in _AXES else kind,
            *(sorted(objects) if _RULES[kind][0] == "pair" else objects),
            *np.concatenate([np.ravel(getattr(model, f"sensor_{name}")[s]) for name in fields]).tolist(),
        )

    def misfit(self, s: int, t: int) -> float:
        """How far the image of what s measures is from what t measures; zero in an exact model."""
        where = _RULES[self.kind(s)][0]
        (kind, a), (_, b) = self.object(s), self.object(t)
        if where == "model":
            return 0.0
        if where == "joint":
            return 0.0 if self.coordinates.joints.get(a) == b else _MISFIT
        if where in ("tendon", "actuator"):
            image = (self.tendons if where == "tendon" else self.actuators)[a]
            return 0.0 if image.index == b else _MISFIT
        if where == "body":
            return self._body_misfit(a, b)
        if where == "pair":
            return min(self._pair_misfits(s, t))
        cost = self._place_misfit(kind, a, b, position=where != "link")
        if where == "body place":
            cost += self._body_misfit(*(int(self.model.site_bodyid[site]) for site in (a, b)))
        if self.kind(s) == "RANGEFINDER":
            frame = self._frame(("SITE", a), ("SITE", b))
            cost += float(np.linalg.norm(frame[:, 2] - np.eye(3)[2]))
        if self.kind(s) in _AXES and cost < _MISFIT:
            cost += 1.0 - abs(self._axis(s, t))
        one, other = self.reference(s), self.reference(t)
        if one and other:
            needed = self.kind(s) in ("FRAMEPOS", "INSIDESITE")
            cost += self._place_misfit(one[0], one[1], other[1], position=needed)
        return cost

    def _place_misfit(self, kind: str, a: int, b: int, position: bool = True) -> float:
        """Distance of object b from the image of a; a mere preference if no position is measured."""
        one, other = self._link(kind, a), self._link(kind, b)
        if self.coordinates.bodies.get(one) != other:
            return _MISFIT
        positions = (getattr(pose, _POSES[kind][0]) for pose in (self.data, self.image))
        distance = float(np.linalg.norm(self.turn @ next(positions)[a] - next(positions)[b]))
        return distance / self.extent * (1.0 if position else 1e-3 * self.tolerance)

    def _body_misfit(self, a: int, b: int) -> float:
        """The same for whole bodies: one that moves a link, or a part welded to it, by its mass centre."""
        welds = weld_ids(self.model)
        if int(welds[a]) == a or int(welds[b]) == b:
            return 0.0 if self.coordinates.bodies.get(a) == b else _MISFIT
        return self._place_misfit("BODY", a, b)

    def _pair_misfits(self, s: int, t: int) -> tuple[float, float]:
        """Of the distance between two objects: mapped in order, and with the two exchanged."""
        one, two, other, another = self.object(s), self.reference(s), self.object(t), self.reference(t)
        assert two is not None and another is not None  # the compiler demands both

        def apart(x: tuple[str, int], y: tuple[str, int]) -> float:
            if x[0] != y[0]:
                return _MISFIT
            if x[0] == "GEOM":
                same = self.model.geom_type[x[1]] == self.model.geom_type[y[1]]
                return self._place_misfit("GEOM", x[1], y[1]) if same else _MISFIT
            return self._body_misfit(x[1], y[1])

        return apart(one, other) + apart(two, another), apart(one, another) + apart(two, other)

    def block(self, s: int, t: int) -> tuple[Array, float]:
        """Matrix from the readings of s to those of its image t, and the offset."""
        kind, dim = self.kind(s), int(self.model.sensor_dim[s])
        measures, a, b = _RULES[kind][1], self.object(s)[1], self.object(t)[1]
        if measures == "scalar":
            return np.eye(dim), 0.0
        if measures == "signed":
            sign, offset = self._signed(s)
            return np.full((1, 1), sign), offset if kind.endswith("POS") else 0.0
        if measures == "ball":
            whole, start = self.coordinates.qvel, self.model.jnt_dofadr
            if kind == "BALLQUAT":
                whole, start = self.coordinates.qpos, self.model.jnt_qposadr
            return whole[start[b] : start[b] + dim, start[a] : start[a] + dim], 0.0
        if measures == "pair":
            straight, exchanged = self._pair_misfits(s, t)
            swap = exchanged < straight  # a normal points from the first object to the second
            block = {
                "GEOMDIST": np.eye(1),
                "GEOMNORMAL": -self.turn if swap else self.turn,
                "GEOMFROMTO": np.kron(np.eye(2)[:: -1 if swap else 1], self.turn),
            }[kind]
        elif measures == "ray":
            fields = int(self.model.sensor_intprm[s, 0])  # a bit for each
            sizes = [size for bit, size in enumerate(_RAY_FIELDS) if fields >> bit & 1]
            block = np.array(block_diag(*(np.eye(1) if size == 1 else self.turn for size in sizes)))
        elif measures == "quaternion":
            block = self._quaternion_block(s, t)
        else:
            at = self.object if measures in ("polar", "axial", "magnetic") else self.reference
            block = self._frame(at(s), at(t))
            if measures.endswith("axial"):
                block = self.det * block
            elif measures == "magnetic":
                block = self._magnetic_sign() * block
            elif measures == "axis":
                block = float(np.sign(self._axis(s, t))) * block
        self._check_cutoff(s, block)
        return block, 0.0

    def _check_cutoff(self, s: int, block: Array) -> None:
        clips = self.model.sensor_cutoff[s] > 0 and int(self.model.sensor_datatype[s]) == 0
        size = np.abs(block)
        if clips and _RULES[self.kind(s)][0] != "pair" and (np.minimum(size, abs(size - 1)) > 1e-9).any():
            raise _NotLinear(
                "its cutoff clips every entry by itself, but the element mixes entries; remove the cutoff"
            )

    def _signed(self, s: int) -> tuple[float, float]:
        """Sign and offset of what a joint, a tendon or an actuator measures."""
        where, (_, index) = _RULES[self.kind(s)][0], self.object(s)
        if where == "joint":
            return self.coordinates.signs[index], self.coordinates.offsets[index]
        if where == "tendon":
            return self.tendons[index].sign, self._tendon_offset(self.tendons[index].index)
        image, transmission = self.actuators[index], int(self.model.actuator_trntype[index])
        gear = float(self.model.actuator_gear[image.index, 0])
        target = int(self.model.actuator_trnid[index, 0])
        if transmission == int(mj.mjtTrn.mjTRN_TENDON):
            return image.sign, gear * self._tendon_offset(self.tendons[target].index)
        if transmission in (int(mj.mjtTrn.mjTRN_JOINT), int(mj.mjtTrn.mjTRN_JOINTINPARENT)):
            if self.kind(s) == "ACTUATORPOS" and int(self.model.jnt_type[target]) == BALL:
                raise _NotLinear("it measures the angle of a ball joint; measure its ballquat")
            return image.sign, gear * self.coordinates.offsets.get(target, 0.0)
        return image.sign, 0.0

    def _tendon_offset(self, tendon: int) -> float:
        """Change of a fixed tendon's length by the offsets of its joints; a spatial one has none."""
        model = self.model
        start, end = int(model.tendon_adr[tendon]), int(model.tendon_adr[tendon] + model.tendon_num[tendon])
        if model.wrap_type[start] != int(mj.mjtWrap.mjWRAP_JOINT):
            return 0.0
        offsets = {self.coordinates.joints[j]: offset for j, offset in self.coordinates.offsets.items()}
        return sum(float(model.wrap_prm[w]) * offsets[int(model.wrap_objid[w])] for w in range(start, end))

    def _magnetic_sign(self) -> int:
        """The constant field is no part of the state: c V maps its reading if c R m = m for a sign c."""
        field = np.array(self.model.opt.magnetic)
        for sign in (self.det, -self.det):
            if np.allclose(sign * self.turn @ field, field, atol=1e-9 * max(1.0, float(abs(field).max()))):
                return sign
        raise _NotLinear(
            f"the magnetic field {field.tolist()} is not kept, not even up to its sign; set "
            "option/magnetic to a vertical field"
        )

    def _quaternion_block(self, s: int, t: int) -> Array:
        q_turn = self.matcher.lift

        def lift(one: tuple[str, int] | None, other: tuple[str, int] | None) -> Array:
            if one is None or other is None:
                return q_turn
            if self._link(*one) in self.matcher.carried:
                return quaternion(self._frame(one, other))
            start, end = map(quaternion, self._rotations(one, other))
            return product(conjugate(end), product(q_turn, start))

        frame = lift(self.object(s), self.object(t))
        return sandwich(lift(self.reference(s), self.reference(t)), conjugate(frame))

    def _axis(self, s: int, t: int) -> float:
        """Cosine between the image of the local axis that s measures and the one that t measures."""
        frame = self._frame(self.object(s), self.object(t))
        return float(frame[_AXES.index(self.kind(t)), _AXES.index(self.kind(s))])

    def _frame(self, one: tuple[str, int] | None, other: tuple[str, int] | None) -> Array:
        """The matrix V between the frames of two objects; R itself for the world's."""
        if one is None or other is None:
            return self.turn
        start, end = self._rotations(one, other)
        return end.T @ self.turn @ start

    def _link(self, kind: str, index: int) -> int:
        owners = {"SITE": "site_bodyid", "GEOM": "geom_bodyid", "CAMERA": "cam_bodyid"}
        body = int(getattr(self.model, owners[kind])[index]) if kind in owners else index
        return int(weld_ids(self.model)[body])

    def _rotations(self, one: tuple[str, int], other: tuple[str, int]) -> tuple[Array, Array]:
        start, end = getattr(self.data, _POSES[one[0]][1]), getattr(self.image, _POSES[other[0]][1])
        return start[one[1]].reshape(3, 3), end[other[1]].reshape(3, 3)
