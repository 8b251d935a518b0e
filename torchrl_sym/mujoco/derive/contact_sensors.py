"""Contact sensors: which watches the images of what another watches, and how its fields transform.

A contact sensor picks the contacts between two objects (geoms, bodies, subtrees, or all; inside a site) and
reports some of them in slots. How many there are has no order. A net force is the sum over all of them, in
the world's frame, on the second object: it turns with the world, and changes sign where the objects of the
image are named in the other order. What one slot says depends on which contact the solver puts there,
unless there can be only one.
"""

from __future__ import annotations

import numpy as np
from scipy.linalg import block_diag

from torchrl_sym.mujoco.derive.sensor_places import MISFIT, Object, Places
from torchrl_sym.mujoco.model.types import Array, mj

_FIELDS = {"found": 1, "force": 3, "torque": 3, "dist": 1, "pos": 3, "normal": 3, "tangent": 3}
_NEAREST, _NET = 1, 3  # values of reduce: mindist, netforce
_ROUND = int(mj.mjtGeom.mjGEOM_SPHERE)
_SINGLE = [  # what a sphere touches in one point at most
    int(getattr(mj.mjtGeom, f"mjGEOM_{name}")) for name in ("PLANE", "SPHERE", "CAPSULE", "CYLINDER", "BOX")
]


class ContactSensors:
    """Compares contact sensors under one element."""

    def __init__(self, places: Places) -> None:
        self.places, self.model = places, places.model

    def gaps(self, one: tuple[Object, Object], other: tuple[Object, Object]) -> tuple[float, float]:
        """How far the objects watched are from images: in order, and with the two exchanged."""
        straight = max(self._gap(a, b) for a, b in zip(one, other, strict=True))
        exchanged = max(self._gap(a, b) for a, b in zip(one, other[::-1], strict=True))
        return straight, exchanged

    def _gap(self, one: Object, other: Object) -> float:
        kind, (a, b) = one[0], (one[1], other[1])
        if kind != other[0]:
            return MISFIT
        if kind == "UNKNOWN":
            return 0.0
        if kind == "SITE":
            return self.places.volume_gap(a, b)
        if kind == "GEOM":
            return self.places.geom_gap(a, b)
        counts = [len(self.places.geoms(body, kind == "XBODY")) for body in (a, b)]
        return self.places.body_gap(a, b) if counts[0] == counts[1] else MISFIT

    def block(self, s: int, objects: tuple[Object, Object], exchanged: bool) -> Array | str:
        """How the readings of a sensor become those of its image; in words, why they do not."""
        spec, reduce = (int(x) for x in self.model.sensor_intprm[s, :2])
        fields = [name for bit, name in enumerate(_FIELDS) if spec >> bit & 1]
        slots = int(self.model.sensor_dim[s]) // sum(_FIELDS[name] for name in fields)
        blocks = []
        for name in fields:
            part = self._field(name, reduce, objects, exchanged)
            if isinstance(part, str):
                return f'{part}; ask for data="found"'
            blocks.append(part)
        return np.array(block_diag(*blocks * slots))

    def _field(
        self, name: str, reduce: int, objects: tuple[Object, Object], exchanged: bool
    ) -> Array | str:
        turn, det, sign = self.places.turn, self.places.matcher.det, -1.0 if exchanged else 1.0
        single = self._at_most_one(objects)
        if name == "found":
            return np.eye(1)
        if name == "dist" and (single or reduce in (_NEAREST, _NET)):  # sorted, or always zero
            return np.eye(1)
        if name == "pos" and (single or reduce == _NET):
            moved = self.places.matcher.shift.any()
            return "its positions are in the world, whose origin the element moves" if moved else turn
        if reduce == _NET and name in ("normal", "tangent"):  # those of the world's frame
            return np.eye(3)
        if reduce == _NET:
            if self._has_no_direction(objects):
                return "contacts within what it watches have no first and second object, and so no sign"
            return sign * (turn if name == "force" else det * turn)
        if single and name == "normal":
            return sign * turn
        if single:
            return (
                f'the {name} of one contact is in a frame that the solver chooses; or for reduce="netforce"'
            )
        return "the order of its contacts is the solver's, not the geometry's; or for reduce=\"netforce\""

    def _at_most_one(self, objects: tuple[Object, Object]) -> bool:
        if [kind for kind, _ in objects] != ["GEOM", "GEOM"]:
            return False
        kinds = [int(self.model.geom_type[index]) for _, index in objects]
        return _ROUND in kinds and all(kind in _SINGLE for kind in kinds)

    def _has_no_direction(self, objects: tuple[Object, Object]) -> bool:
        """Whether both ends of a contact may be on either side, as for two feet of one subtree."""
        sides = [self._watched(*object_) for object_ in objects]
        known = [side for side in sides if side is not None]
        if not known:
            return True
        both = set.intersection(*known)
        return len({int(self.model.geom_bodyid[g]) for g in both}) > 1

    def _watched(self, kind: str, index: int) -> set[int] | None:
        if kind in ("UNKNOWN", "SITE"):
            return None  # all
        return {index} if kind == "GEOM" else set(self.places.geoms(index, kind == "XBODY"))
