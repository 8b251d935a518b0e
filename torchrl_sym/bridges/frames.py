"""Where an element carries the frames of a model (bodies, sites), and what it does to what they measure.

A vector that is measured in a frame B is carried to one in the image's frame B'. In a state q, and in the
image of that state, ``R B(q)`` and ``B'(g q)`` are the same directions in space; components are mapped by

    M = B'(g q)^T R B(q)

which is the same in every state: R itself in a frame that points forward, and whatever it takes in one that
does not. Rays that start in a frame are carried by the same matrix to those that start in the image's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from torchrl_sym.mujoco import ModelSymmetry
from torchrl_sym.mujoco.model.types import Array, MjModel, mj
from torchrl_sym.representations import Representation, permutation
from torchrl_sym.representations.blocks import SignedPermutation

_TOLERANCE = 1e-4  # metres, between a ray and the image of another; robots' models are not exact


def places(
    robot: ModelSymmetry, names: Sequence[str], tables: Sequence[Mapping[str, str]]
) -> Representation:
    """How named bodies or sites change places.

    Raises:
        ValueError: an element carries one to another that is not among them.
    """
    maps = {}
    for element, table in zip(robot.group.names, tables, strict=True):
        images = {name: table[name] for name in names if name in table}
        lost = [
            f"{name} ({images.get(name, 'no image')})" for name in names if images.get(name) not in names
        ]
        if lost:
            raise ValueError(
                f"{element!r} carries {', '.join(lost)} to one that is not among {list(names)}"
            )
        maps[element] = images
    return permutation(robot.group, names, maps)


def frame_maps(robot: ModelSymmetry, kind: str, names: Sequence[str], align: str = "base") -> Tensor:
    """The matrices M of frames for every element, ``(N, F, 3, 3)``.

    Args:
        robot: the model's symmetry.
        kind: ``"body"`` or ``"site"``.
        names: the frames.
        align: ``"base"``: the frames as they are; ``"yaw"``: turned about the vertical axis only, as their
            x axis is; ``"world"``: not at all.
    """
    matrices = []
    for g, matrix in enumerate(robot.group.matrices.numpy()):
        here = torch.as_tensor(robot.model.qpos0)
        table = robot.table(kind, g)  # pyright: ignore[reportArgumentType]
        before = _rotations(robot.model, kind, names, here.numpy(), align)
        images = [table[name] for name in names]
        after = _rotations(robot.model, kind, images, robot.map_qpos(here, g).numpy(), align)
        matrices.append(np.swapaxes(after, -1, -2) @ matrix @ before)
    return torch.as_tensor(np.stack(matrices))


def refuse_turned_yaw(robot: ModelSymmetry, kind: str, names: Sequence[str]) -> None:
    """ValueError if an element moves the x axis of a frame, whose direction its yaw is, off its line.

    Where an element makes the y axis of it, the yaw of the image is that of another axis of the frame, and
    differs from the image of the yaw as soon as the frame is tilted.
    """
    forward = frame_maps(robot, kind, names)[..., 0, 0].abs()  # (N, F)
    for g, f in (forward < 1 - _TOLERANCE).nonzero().tolist():
        raise ValueError(
            f"{robot.group.names[g]!r} turns the x axis of {names[f]}, of which its yaw is computed, to "
            "another axis; use ray_alignment='base' or a smaller group"
        )


def _rotations(model: MjModel, kind: str, names: Sequence[str], qpos: Array, align: str) -> Array:
    data = mj.MjData(model)
    data.qpos[:] = qpos
    mj.mj_kinematics(model, data)
    found = np.stack([getattr(data, kind)(name).xmat.reshape(3, 3) for name in names])
    if align == "base":
        return found
    turned = np.broadcast_to(np.eye(3), found.shape).copy()
    if align == "yaw":
        forward = found[:, :2, 0] / np.linalg.norm(found[:, :2, 0], axis=-1, keepdims=True)
        turned[:, :2, 0] = forward
        turned[:, :2, 1] = np.stack([-forward[:, 1], forward[:, 0]], -1)
    return turned


def rays(frames: Representation, maps: Tensor, starts: Tensor, directions: Tensor) -> Representation:
    """How the rays of several frames change places, all rays of the first frame first.

    Args:
        frames: how the frames change places.
        maps: the matrices M, ``(N, F, 3, 3)``.
        starts: where the rays of a frame start, ``(P, 3)``, in metres.
        directions: where they point, ``(P, 3)``.

    Raises:
        ValueError: the image of a ray is none.
    """
    pattern = torch.cat([starts, directions], -1).double().cpu()  # (P, 6)
    count, group = len(pattern), frames.group
    source = torch.zeros(group.order, frames.dim * count, dtype=torch.int64)
    for g, images in enumerate(frames.absolute().matrices):
        for f in range(frames.dim):
            image = int(images[:, f].argmax())
            carried = torch.cat([pattern[:, :3] @ maps[g, f].mT, pattern[:, 3:] @ maps[g, f].mT], -1)
            distance, nearest = torch.cdist(carried, pattern).min(-1)
            if not (distance <= _TOLERANCE).all() or len(nearest.unique()) < count:
                i = int(distance.argmax())
                raise ValueError(
                    f"{group.names[g]!r} carries the ray from {_metres(starts[i])} to where none starts "
                    "with the image's direction; make the pattern symmetric about the frame"
                )
            source[g, image * count + nearest] = f * count + torch.arange(count)
    block = SignedPermutation(source, torch.ones_like(source))
    return Representation.from_blocks(group, [block])


def _metres(point: Tensor) -> str:
    return "(" + ", ".join(f"{x:.4g}" for x in point.tolist()) + ") m"
