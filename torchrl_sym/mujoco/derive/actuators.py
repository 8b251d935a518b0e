"""Images of actuators, which are mapped by what they drive.

The sign says whether the image pushes the other way. A motor whose image nobody drives may be its own
image, or that of another, through an equality constraint: one finger is driven, a constraint moves the
other. Motors on slides that an element mixes mix as they do. What cannot be told is refused by actuator: it
has no image, but everything else has.
"""

from __future__ import annotations

import numpy as np

from torchrl_sym.mujoco.derive.coordinates import CoordinateMap
from torchrl_sym.mujoco.derive.images import Image, SymmetryError, assign, mixture
from torchrl_sym.mujoco.derive.lengths import Ties
from torchrl_sym.mujoco.derive.matching import Matcher
from torchrl_sym.mujoco.derive.transmissions import Transmissions
from torchrl_sym.mujoco.model.types import Array, MjModel, label_of, mj

_NONE = 1e9  # cost of a pair that cannot be the image of each other
_SCALE = 1e-2  # relative: how far a control's scale through constraints may be from 1
_FILTERS = [int(getattr(mj.mjtDyn, f"mjDYN_{name}")) for name in ("FILTER", "FILTEREXACT")]
_INTEGRATOR = int(mj.mjtDyn.mjDYN_INTEGRATOR)


def map_actuators(
    matcher: Matcher, map_: CoordinateMap, tendons: dict[int, Image], tolerance: float
) -> tuple[dict[int, Image], dict[int, str]]:
    """Image of every actuator, and why others have none.

    Raises:
        SymmetryError: no actuator drives the image of what one drives.
    """
    model = matcher.model
    drives = Transmissions(matcher, map_, tendons, tolerance)
    count = getattr(model, "nactuator", model.nu)
    if matcher.is_identity:
        return {a: Image(a) for a in range(count)}, {}
    refusals = {a: reason for a in range(count) if (reason := drives.unsupported(a))}
    known = [a for a in range(count) if a not in refusals]
    fits = drives.fits(known)
    cost = np.full((len(known), len(known)), _NONE)
    for (a, b), fit in fits.items():
        cost[known.index(a), known.index(b)] = (
            _gain_distance(model, a, b)
            + _one_sided(drives, a, b, fit.sign)
            + 10 * fit.misfit
            + 1e-6 * (a != b)
        )
    images: dict[int, Image] = {}
    for row, column in assign(cost):
        if cost[row, column] < _NONE:
            a, b = known[row], known[column]
            images[a] = Image(b, fits[a, b].sign, misfit=fits[a, b].misfit)
            _add_offset(drives, images[a], a, drives.shift(b))

    rest = [a for a in known if a not in images]
    taken = {image.index for image in images.values()}
    ties = Ties.of(model) if rest else None
    for a in rest:
        free = [b for b in known if b not in taken]
        image = _mixed(drives, a) or (ties and _tied(drives, ties, a, free))
        if not image:
            raise SymmetryError(
                f"{label_of(model, 'actuator', a)} has no image: no actuator drives the image of what it "
                "drives; add the missing actuator, or use a smaller group"
            )
        images[a] = image
        taken.add(image.index)
    return dict(sorted(images.items())), refusals


def _gain_distance(model: MjModel, a: int, b: int) -> float:
    """How different two actuators of one transmission are: a joint may have several."""
    kinds = ("actuator_dyntype", "actuator_gaintype", "actuator_biastype")
    distance = sum(1e3 for field in kinds if int(getattr(model, field)[a]) != int(getattr(model, field)[b]))
    for field in ("actuator_gainprm", "actuator_biasprm"):
        one, other = (getattr(model, field)[x] for x in (a, b))
        scale = np.maximum(np.abs(one), np.abs(other))
        distance += float((np.abs(one - other) / np.where(scale > 0, scale, 1.0)).sum())
    return distance


def _one_sided(drives: Transmissions, a: int, b: int, sign: float) -> float:
    """How little the image of what only pulls, or pulls more than it pushes, does so: of antagonists."""
    model = drives.model
    if sign < 0 and int(model.actuator_gaintype[a]) == int(mj.mjtGain.mjGAIN_MUSCLE):
        return 1.0
    if drives.is_servo(a) or not (model.actuator_ctrllimited[a] and model.actuator_ctrllimited[b]):
        return 0.0
    one, other = (
        np.sort((1.0 if _is_damper(model, a) else sign) * model.actuator_ctrlrange[a]),
        model.actuator_ctrlrange[b],
    )
    return min(1.0, float(np.abs(one - other).max()) / max(float(np.ptp(other)), 1e-12))


def _is_damper(model: MjModel, a: int) -> bool:
    """Whether the control scales a force that changes its sign with the length, or its velocity."""
    constant, *slopes = model.actuator_gainprm[a, :3]
    return bool(
        int(model.actuator_gaintype[a]) == int(mj.mjtGain.mjGAIN_AFFINE) and constant == 0 and any(slopes)
    )


def _add_offset(drives: Transmissions, image: Image, a: int, shift: float) -> None:
    """What is added to the length, and to control and state of a servo, which are lengths."""
    image.length_offset = shift
    image.keeps = _is_damper(drives.model, a)
    if drives.is_servo(a) and not image.keeps:
        dynamics = int(drives.model.actuator_dyntype[a])
        image.offset = 0.0 if dynamics == _INTEGRATOR else shift
        image.state_offset = shift if dynamics in (*_FILTERS, _INTEGRATOR) else 0.0


def _mixed(drives: Transmissions, a: int) -> Image | None:
    """Image of a motor on slides that an element mixes, among motors of its kind on each of them."""
    model, mine = drives.model, drives.length(a)
    if mine is None or not drives.map.mixed:
        return None
    target = drives.matrix @ mine
    parts: dict[int, Array] = {}
    fields = ("trntype", "dyntype", "gaintype", "biastype")
    candidates = sorted(
        range(len(model.actuator_trntype)), key=lambda b: (_gain_distance(model, a, b), b != a, b)
    )
    for b in candidates:
        length = None if drives.unsupported(b) else drives.length(b)
        alike = all(
            getattr(model, f"actuator_{f}")[a] == getattr(model, f"actuator_{f}")[b] for f in fields
        )
        if length is None or not alike or not length.any():
            continue
        rank = np.linalg.matrix_rank(np.stack([*parts.values(), length]), tol=1e-9)
        if rank > len(parts) and np.abs(length @ target) > 1e-9:
            parts[b] = length
    weights = mixture(target, parts)
    if not weights:
        return None
    image = Image(max(weights, key=lambda b: abs(weights[b])), mixture=weights)
    sizes = [float(np.linalg.norm(parts[b])) for b in weights] + [float(np.linalg.norm(mine))]
    image.misfit = max(sizes) / min(sizes) - 1
    _add_offset(drives, image, a, drives.shift(image.index))
    return image


def _tied(drives: Transmissions, ties: Ties, a: int, free: list[int]) -> Image | None:
    """Image of an actuator through equality constraints: an actuator that moves what its image would."""
    model, mine = drives.model, drives.length(a)
    if mine is None:
        return None
    target = drives.matrix @ mine
    found: list[tuple[float, bool, int, Image]] = []
    for b in free:
        theirs = drives.length(b)
        if theirs is None:
            continue
        wanted, actual = ties.project(target), ties.project(theirs)
        sizes = np.linalg.norm(wanted), np.linalg.norm(actual)
        if min(sizes) < 1e-9 or abs(sizes[0] / sizes[1] - 1) > _SCALE:
            continue
        for sign in (1.0, -1.0):
            k = ties.combine(target - sign * sizes[0] / sizes[1] * theirs)
            if k is not None:
                image = Image(b, sign, through=ties.words(model, k))
                image.misfit = abs(float(sizes[0] / sizes[1]) - 1)
                _add_offset(drives, image, a, sign * float(target @ drives.offset - k @ ties.values))
                found.append((_gain_distance(model, a, b), b != a, b, image))
    return min(found, key=lambda f: f[:3])[3] if found else None
