"""The builder for images, whose pixels change places: cameras, depth images, occupancy grids.

An image has a row axis and a column axis, which run along axes of the robot. An element that turns them
into one another, and leaves the axis that the camera looks along, turns or flips the image. One that turns
the camera away has no image of it: it shows what another camera sees, so that both must be observed.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from torchrl_sym import checks
from torchrl_sym.groups import PointGroup, check_group
from torchrl_sym.representations.base import MAX_DIM, Representation
from torchrl_sym.representations.blocks import SignedPermutation, join, product
from torchrl_sym.representations.vectors import invariant

_TOLERANCE = 1e-9
_AXES = [sign + axis for sign in ("", "-") for axis in "xyz"]


def image(
    group: PointGroup,
    shape: Sequence[int],
    layout: str = "HW",
    *,
    rows: str = "-x",
    columns: str = "-y",
    value: Representation | None = None,
) -> Representation:
    """Pixels that change places, on events of the given shape.

    ============================================  ==============  =============
    camera                                        ``rows``        ``columns``
    ============================================  ==============  =============
    seen from above, forward is up (the default)  ``"-x"``        ``"-y"``
    in front, looking forward                     ``"-z"``        ``"-y"``
    upright, one of several that change places    ``"-z"``        ``"right"``
    ============================================  ==============  =============

    The last is for cameras all around, each of which an element may carry to another: a turn leaves their
    images as they are, a reflection flips them. ``items(cameras, image(..., columns="right"))`` then says
    which image comes from which camera.

    Args:
        group: the group that acts.
        shape: sizes in the order of the layout.
        layout: ``"HW"``, ``"HWC"`` or ``"CHW"``: height (rows), width (columns), channels.
        rows: the robot's axis along which the rows follow one another, downwards in the image.
        columns: that of the columns, to the right in the image; or ``"right"``.
        value: how the channels of a pixel transform, as of optical flow. Defaults to colours, which no
            element changes.

    Raises:
        ValueError: an element moves the axis that the camera looks along, turns the image by other than
            right angles, or turns one that is not square; the message names it.

    Example:
        >>> camera = image(PointGroup.reflection("y"), (2, 3))
        >>> camera(torch.tensor([[1, 2, 3], [4, 5, 6]]), "reflect-y")
        tensor([[3, 2, 1],
                [6, 5, 4]])
    """
    check_group(group)
    checks.one_of("layout", layout, ("HW", "HWC", "CHW"))
    sizes = [checks.whole("shape", size, 1, MAX_DIM) for size in checks.sequence("shape", shape, "sizes")]
    if len(sizes) != len(layout):
        raise ValueError(f"shape: expected {len(layout)} sizes, those of {layout!r}, got {tuple(sizes)}")
    size = dict(zip(layout, sizes, strict=True))
    if size["H"] * size["W"] * size.get("C", 1) > MAX_DIM:
        raise ValueError(f"shape: expected at most {MAX_DIM} entries, got {tuple(sizes)}")

    pixels = _pixels(group, size["H"], size["W"], _plane(group, rows, columns))
    if value is None:
        value = invariant(group, size.get("C", 1))
    if checks.instance("value", value, Representation).group != group:
        raise ValueError(f"expected a value of the same group, {group}, got {value.group}")
    if value.event_shape != (size.get("C", 1),):
        raise ValueError(
            f"value: expected one of {size.get('C', 1)} channels, as of layout {layout!r} and shape "
            f"{tuple(sizes)}, got {value}"
        )
    channels = join(value.blocks)
    block = product(channels, [pixels]) if layout == "CHW" else product(pixels, [channels])
    return Representation.from_blocks(group, [block], event_shape=tuple(sizes), check=False)


def _plane(group: PointGroup, rows: str, columns: str) -> Tensor:
    """How every element moves the image's axes: signed permutations of (row, column), ``(N, 2, 2)``."""
    checks.one_of("rows", rows, _AXES)
    checks.one_of("columns", columns, [*_AXES, "right"])
    if columns == "right":
        _refuse_moved(group, "z", "an upright camera")
        if rows.removeprefix("-") != "z":
            raise ValueError(f"rows: expected 'z' or '-z' for columns that run to the right, got {rows!r}")
        return torch.diag_embed(torch.stack([torch.ones_like(group.det), group.det], -1))

    seen = rows.removeprefix("-") + columns.removeprefix("-")
    if len(set(seen)) == 1:
        raise ValueError(f"expected rows and columns along two axes, got {rows!r} and {columns!r}")
    (normal,) = set("xyz") - set(seen)
    _refuse_moved(group, normal, "a camera that looks along it")
    frame = torch.stack([_axis(rows), _axis(columns)])  # (2, 3)
    plane = frame @ group.matrices @ frame.mT
    turned = ((plane.abs() - plane.abs().round()).abs() > _TOLERANCE).flatten(1).any(1)
    if turned.any():
        name = group.names[int(turned.long().argmax())]
        raise ValueError(
            f"{name!r} turns the image by other than right angles, which sends pixels between pixels; "
            "use a subgroup, or points() on a layout that is closed under the group"
        )
    return plane.round()


def _axis(name: str) -> Tensor:
    axis = torch.zeros(3, dtype=torch.float64, device="cpu")
    axis["xyz".index(name[-1])] = -1.0 if name.startswith("-") else 1.0
    return axis


def _refuse_moved(group: PointGroup, axis: str, camera: str) -> None:
    moved = (group.matrices @ _axis(axis) - _axis(axis)).abs().amax(-1) > _TOLERANCE
    if moved.any():
        name = group.names[int(moved.long().argmax())]
        raise ValueError(
            f"expected a group that fixes the {axis} axis, but {name!r} moves it, so that {camera} has no "
            "image of itself: stack the cameras that change places, "
            "items(cameras, image(..., rows='-z', columns='right'))"
        )


def _pixels(group: PointGroup, height: int, width: int, plane: Tensor) -> SignedPermutation:
    """How the pixels change places, entry ``i * width + j``."""
    swapped = plane[:, 0, 0] == 0
    if height != width and swapped.any():
        name = group.names[int(swapped.long().argmax())]
        raise ValueError(
            f"{name!r} turns rows into columns: expected a square image, got {height} x {width} pixels; "
            "cut it, or use a subgroup"
        )
    lines = [torch.arange(1 - size, size, 2, device="cpu") for size in (height, width)]  # twice, centred
    source = torch.cartesian_prod(*lines).double() @ plane  # the inverse is the transpose
    i, j = ((source[..., k] + size - 1) / 2 for k, size in ((0, height), (1, width)))
    index = (i * width + j).long()  # (N, height * width)
    return SignedPermutation(index, torch.ones_like(index))
