"""Why a group is refused: which part has no image, and how far the nearest is."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from torchrl_sym.mujoco.derive.pairing import Misfit, Pairing
from torchrl_sym.mujoco.model.links import is_loose
from torchrl_sym.mujoco.model.types import label_of, name_of


def explain(pairing: Pairing, misfit: Misfit, element: str, tolerance: float) -> str:
    """What has no image and how far the nearest is, in degrees and millimetres."""
    model, a, b = pairing.model, misfit.one, misfit.other
    if misfit.kind == "missing":
        return (
            f"{label_of(model, 'body', a)} has no image under {element!r}: no body with as many joints "
            "and children is left on the other side"
        )
    limit = f"tolerance {tolerance:g}"
    if misfit.kind == "link":
        gap, size = float(pairing.gaps.of_centers([(a, b)])[0]), pairing.parts.size(b)
        name = name_of(model, "body", a)
        return (
            f"{label_of(model, 'body', a)} has no image under {element!r}: the nearest, "
            f"{label_of(model, 'body', b)}, has its centre of mass {1e3 * gap:.1f} mm beside it "
            f"({100 * gap / size:.0f} % of the size of what moves; {limit})"
            + f"; if it may have any shape, pass carried=[{name!r}]"
            * (is_loose(model, a) and not pairing.links[a].children)
        )
    if misfit.kind == "order":
        return _order(pairing, a, b, element)
    turn, away = (float(gap[0]) for gap in pairing.gaps.of_joints([(a, b)]))
    if not np.isfinite(turn):
        what = label_of(model, "joint", a)
        return f"{what} has no image under {element!r}: no joint of its type is there"
    return (
        f"{label_of(model, 'joint', a)} has no image under {element!r}: the nearest, "
        f"{label_of(model, 'joint', b)}, misses it by {np.degrees(turn):.2g} degrees and "
        f"{1e3 * away:.3g} mm ({limit})"
    )


def _order(pairing: Pairing, a: int, b: int, element: str) -> str:
    def listed(joints: Sequence[int]) -> str:
        return ", ".join(label_of(pairing.model, "joint", j) for j in joints)

    images = pairing.joints_to(a, b)
    return (
        f"{label_of(pairing.model, 'body', a)} has no image under {element!r}: its joints, "
        f"{listed(pairing.links[a].joints)}, go to {listed(list(images.values()))} in this order, but "
        f"{label_of(pairing.model, 'body', b)} has them in the order {listed(pairing.links[b].joints)}, "
        "and they do not commute; list the joints of both bodies in the same order, or use a ball joint"
    )
