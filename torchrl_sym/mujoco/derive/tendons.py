"""Images of tendons, which are mapped by what they couple.

A fixed tendon is mapped by its joint coefficients (up to a common sign), a spatial one by its path (in
either direction).
"""

from __future__ import annotations

from torchrl_sym.mujoco.derive.coordinates import CoordinateMap
from torchrl_sym.mujoco.derive.images import Image, SymmetryError
from torchrl_sym.mujoco.model.types import MjModel, mj, name_of

_WRAP = mj.mjtWrap


def map_tendons(model: MjModel, map_: CoordinateMap, sites: dict[int, int]) -> dict[int, Image]:
    """Image of every tendon, with the sign of its length.

    Raises:
        SymmetryError: a tendon couples joints or sites whose images no tendon couples.
    """
    contents = [_tendon(model, t) for t in range(model.ntendon)]
    images = {}
    for t, (kind, parts) in enumerate(contents):
        if kind == "fixed":
            moved = {map_.joints[j]: map_.signs[j] * c for j, c in parts}
            candidates = [(dict(other), s) for _, other in contents for s in (1.0, -1.0)]
            hits = [
                Image(i // 2, sign)
                for i, (other, sign) in enumerate(candidates)
                if contents[i // 2][0] == "fixed"
                and other.keys() == moved.keys()
                and all(abs(moved[j] - sign * other[j]) < 1e-6 for j in moved)
            ]
        else:
            path = [(w, sites.get(o) if w == "site" else None) for w, o in parts]
            hits = [
                Image(i)
                for i, (other_kind, other) in enumerate(contents)
                if other_kind == "spatial" and _same_path(path, other)
            ]
        if not hits:
            raise SymmetryError(
                f"{name_of(model, 'tendon', t)} has no image: no tendon couples the images of what it "
                "couples; add the missing tendon, or use a smaller group"
            )
        images[t] = next((hit for hit in hits if hit.index == t), hits[0])
    return images


def _tendon(model: MjModel, t: int) -> tuple[str, list[tuple]]:
    start, count = int(model.tendon_adr[t]), int(model.tendon_num[t])
    kinds, objects = model.wrap_type[start : start + count], model.wrap_objid[start : start + count]
    if kinds[0] == int(_WRAP.mjWRAP_JOINT):
        coefficients = model.wrap_prm[start : start + count]
        return "fixed", [(int(j), float(c)) for j, c in zip(objects, coefficients, strict=True)]
    names = {int(_WRAP.mjWRAP_SITE): "site", int(_WRAP.mjWRAP_PULLEY): "pulley"}
    return "spatial", [(names.get(int(k), "geom"), int(o)) for k, o in zip(kinds, objects, strict=True)]


def _same_path(path: list[tuple], other: list[tuple]) -> bool:
    def equal(a: list[tuple], b: list[tuple]) -> bool:
        # wrapping geoms are compared by their place in the path only; the audit compares their shapes
        return len(a) == len(b) and all(
            x[0] == y[0] and (x[0] != "site" or x[1] == y[1]) for x, y in zip(a, b, strict=True)
        )

    return equal(path, other) or equal(path[::-1], other)
