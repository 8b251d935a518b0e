"""What sensors measure: which are alike, and how far what one measures is from the image of another's."""

from __future__ import annotations

import numpy as np

from torchrl_sym.mujoco.derive.action import Action
from torchrl_sym.mujoco.derive.contact_sensors import ContactSensors
from torchrl_sym.mujoco.derive.lengths import is_fixed
from torchrl_sym.mujoco.derive.sensor_places import MISFIT, Object, Places
from torchrl_sym.mujoco.derive.sensor_rules import AXES, OBJECTS, RULES, TYPES, UNSUPPORTED
from torchrl_sym.mujoco.model.types import mj

_TENDON = int(mj.mjtTrn.mjTRN_TENDON)
JOINTS = [int(mj.mjtTrn.mjTRN_JOINT), int(mj.mjtTrn.mjTRN_JOINTINPARENT)]


class Measurements:
    """Sensors of a model under one element."""

    def __init__(self, action: Action) -> None:
        self.action, self.matcher, self.coordinates = action, action.matcher, action.coordinates
        self.model, self.tolerance = self.matcher.model, action.tolerance
        self.places = Places(self.matcher)
        self.contacts = ContactSensors(self.places)

    def kind(self, s: int) -> str:
        """Its type, as in mjtSensor."""
        return TYPES[int(self.model.sensor_type[s])]

    def object(self, s: int) -> Object:
        """What it is on."""
        return OBJECTS[int(self.model.sensor_objtype[s])], int(self.model.sensor_objid[s])

    def reference(self, s: int) -> Object | None:
        """What it measures relative to, or the second of what it is about."""
        index = int(self.model.sensor_refid[s])
        if index < 0 or self.kind(s) in ("FRAMELINACC", "FRAMEANGACC"):  # MuJoCo has no relative ones
            return None
        return OBJECTS[int(self.model.sensor_reftype[s])], index

    def watched(self, s: int) -> tuple[Object, Object]:
        """The two objects of a contact sensor."""
        return self.object(s), self.reference(s) or ("UNKNOWN", -1)

    def mixture(self, s: int) -> dict[int, float]:
        """Weights of the joints, tendons or actuators that an element mixes what it measures with."""
        where, index = RULES[self.kind(s)][0], self.object(s)[1]
        if where == "joint":
            return self.coordinates.mixed.get(index, {})
        images = {"tendon": self.action.tendons, "actuator": self.action.actuators}.get(where, {})
        return images[index].mixture if index in images else {}

    def unsupported(self, s: int) -> str:
        """Why a sensor cannot be mapped under this element; empty if it can."""
        kind = self.kind(s)
        if kind not in RULES:
            return UNSUPPORTED.get(kind, f"sensors of type {kind.lower()} are not supported")
        for object_ in filter(None, (self.object(s), self.reference(s))):
            if object_[0] == "CAMERA" and (kind == "RANGEFINDER" or self.model.cam_mode[object_[1]] != 0):
                return "it is on a camera: only frame sensors on cameras of mode 'fixed' are supported"
        where, index = RULES[kind][0], self.object(s)[1]
        if where == "actuator" and index in self.action.refusals:
            return f"the image of its actuator cannot be told, as {self.action.refusals[index]}"
        if kind in ("JOINTACTFRC", "TENDONACTFRC"):
            through = self._through(kind, index)
            if through:
                return (
                    f"its actuator has an image only through equality {through}: its force's image is a "
                    "force of the constraint, which this sensor does not measure"
                )
        shift = self.matcher.shift
        if shift.any() and self._is_world_position(s):
            return (
                "its reading is a position in the world, to which the element adds "
                f"({shift[0]:.4g}, {shift[1]:.4g}, 0) m, as its axis is not at the origin; measure it "
                "relative to a body (reftype, refname)"
            )
        return ""

    def _through(self, kind: str, index: int) -> str:
        """Equality constraints that the image of an actuator on a joint or tendon takes."""
        where = "joint" if kind == "JOINTACTFRC" else "tendon"
        joints, tendons = self.coordinates.joints, self.action.tendons
        image = joints[index] if where == "joint" else tendons[index].index
        for a, found in self.action.actuators.items():
            driven = {x for b in (a, found.index) for x in self._driven(where, b)}
            if found.through and driven & {index, image}:
                return found.through
        return ""

    def _driven(self, where: str, a: int) -> list[int]:
        """Joints or tendons that an actuator acts on."""
        model, target = self.model, int(self.model.actuator_trnid[a, 0])
        kind = int(model.actuator_trntype[a])
        if kind in JOINTS:
            return [target] if where == "joint" else []
        if kind != _TENDON:
            return []
        if where == "tendon":
            return [target]
        start, count = int(model.tendon_adr[target]), int(model.tendon_num[target])
        return model.wrap_objid[start : start + count].tolist() if is_fixed(model, target) else []

    def _is_world_position(self, s: int) -> bool:
        kind = self.kind(s)
        if kind == "RANGEFINDER":
            fields = int(self.model.sensor_intprm[s, 0])
            return bool(fields & (1 << 2 | 1 << 3))  # origin and point
        return kind in ("SUBTREECOM", "GEOMFROMTO") or (kind == "FRAMEPOS" and self.reference(s) is None)

    def signature(self, s: int) -> tuple:
        """What a sensor and its image have in common."""
        model, kind = self.model, self.kind(s)
        objects = [self.object(s)[0], (self.reference(s) or ("WORLD", -1))[0]]
        # a delayed sensor answers later than an image without delay
        fields = ("dim", "datatype", "cutoff", "intprm", "delay", "interval", "history")
        return (
            "AXIS" if kind in AXES else kind,
            *(sorted(objects) if RULES[kind][0] in ("pair", "contact") else objects),
            *np.concatenate([np.ravel(getattr(model, f"sensor_{name}")[s]) for name in fields]).tolist(),
        )

    def misfit(self, s: int, t: int) -> float:
        """How far the image of what s measures is from what t measures; zero in an exact model."""
        where = RULES[self.kind(s)][0]
        (kind, a), (_, b) = self.object(s), self.object(t)
        if where == "model":
            return 0.0
        if where == "joint":
            return 0.0 if self.coordinates.joints.get(a) == b else MISFIT
        if where in ("tendon", "actuator"):
            image = (self.action.tendons if where == "tendon" else self.action.actuators)[a]
            return 0.0 if image.index == b else MISFIT
        if where == "body":
            return self.places.body_gap(a, b)
        if where == "pair":
            return min(self.pair_misfits(s, t))
        if where == "contact":
            return min(self.contacts.gaps(self.watched(s), self.watched(t)))
        cost = self._near(kind, a, b, position=not where.endswith("link"))
        if where.startswith("body"):
            cost += self.places.body_gap(*(int(self.model.site_bodyid[site]) for site in (a, b)))
        if where.endswith("volume"):
            cost = max(cost, self.places.volume_gap(a, b))
        if self.kind(s) == "RANGEFINDER":
            frame = self.places.frame(("SITE", a), ("SITE", b))
            cost += float(np.linalg.norm(frame[:, 2] - np.eye(3)[2]))
        if self.kind(s) in AXES and cost < MISFIT:
            cost += 1.0 - abs(self.axis(s, t))
        one, other = self.reference(s), self.reference(t)
        if one and other and self.kind(s) == "INSIDESITE":
            cost = max(cost, self.places.volume_gap(one[1], other[1]))
        elif one and other:
            cost += self._near(one[0], one[1], other[1], position=self.kind(s) == "FRAMEPOS")
        return cost

    def _near(self, kind: str, a: int, b: int, position: bool) -> float:
        """Distance of object b from the image of a; a mere preference if no position is measured."""
        gap = self.places.gap(kind, a, b)
        return gap if position or gap >= MISFIT else gap * 1e-3 * self.tolerance

    def pair_misfits(self, s: int, t: int) -> tuple[float, float]:
        """Of the distance between two objects: mapped in order, and with the two exchanged."""
        one, two, other, another = self.object(s), self.reference(s), self.object(t), self.reference(t)
        assert two is not None and another is not None  # the compiler demands both

        def apart(x: Object, y: Object) -> float:
            if x[0] != y[0]:
                return MISFIT
            return (self.places.geom_gap if x[0] == "GEOM" else self.places.body_gap)(x[1], y[1])

        return apart(one, other) + apart(two, another), apart(one, another) + apart(two, other)

    def axis(self, s: int, t: int) -> float:
        """Cosine between the image of the local axis that s measures and the one that t measures."""
        frame = self.places.frame(self.object(s), self.object(t))
        return float(frame[AXES.index(self.kind(t)), AXES.index(self.kind(s))])
