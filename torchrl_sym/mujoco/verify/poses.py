"""Random states that a few random actions do not reach: fast, bent, lying on any side, touching anything.

An entry that never changes says nothing of how it transforms: a contact force stays zero until something
touches, and the torso of a quadruped touches when it lies on its back.
"""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import torch

from torchrl_sym.mujoco.model.filters import Filters
from torchrl_sym.mujoco.model.types import BALL, FREE, SLIDE, Array, MjData, MjModel, mj
from torchrl_sym.mujoco.verify.states import PhysicsState, touches, write_state

_SPEED = 1.0  # standard deviation of random velocities, m/s and rad/s
_SINK = 40  # steps in which a body is lowered until it touches
TRIES = 100  # poses in search of a contact
KINDS = 3


def random_pose(
    model: MjModel, state: PhysicsState, generator: torch.Generator, number: int
) -> PhysicsState:
    """A state like another: as it is, moving, or in any pose, lowered until it touches; by number."""
    kind = number % KINDS
    if kind == 0:
        return state
    random = np.random.default_rng(int(torch.randint(2**31, (), generator=generator)))
    qpos, qvel = (x[0].numpy().copy() for x in (state.qpos, state.qvel))
    qvel += _SPEED * random.standard_normal(model.nv)
    act, mocap = (x[0].numpy().copy() for x in (state.act, state.mocap_pos))
    if kind == 2:
        _turn_joints(model, qpos, random)
        act = random.uniform(0, 0.5, model.na)
        mocap += 0.02 * float(model.stat.extent) * random.standard_normal(mocap.shape)
    changed = dataclasses.replace(
        state, **{k: torch.as_tensor(x)[None] for k, x in _named(qpos, qvel, act, mocap).items()}
    )
    return _lowered(model, changed) if kind == 2 else changed


def _named(qpos: Array, qvel: Array, act: Array, mocap: Array) -> dict[str, Array]:
    return {"qpos": qpos, "qvel": qvel, "act": act, "mocap_pos": mocap}


def _turn_joints(model: MjModel, qpos: Array, random: np.random.Generator) -> None:
    for j in range(model.njnt):
        kind, i = int(model.jnt_type[j]), int(model.jnt_qposadr[j])
        if kind in (FREE, BALL):
            i += 3 if kind == FREE else 0
            q = random.standard_normal(4)
            qpos[i : i + 4] = q / np.linalg.norm(q)
            if kind == FREE:
                qpos[i - 3 : i - 1] += 0.3 * float(model.stat.extent) * random.standard_normal(2)
        elif model.jnt_limited[j]:
            qpos[i] = random.uniform(*model.jnt_range[j])
        else:
            scale = 0.1 * float(model.stat.extent) if kind == SLIDE else np.pi / 2
            qpos[i] += scale * random.uniform(-1, 1)


def _lowered(model: MjModel, state: PhysicsState) -> PhysicsState:
    """With every free body just so low that something touches, if anything does."""
    data: Any = mj.MjData(model)
    write_state(data, state)
    heights = [int(model.jnt_qposadr[j]) + 2 for j in range(model.njnt) if model.jnt_type[j] == FREE]
    for height in heights:
        data.qpos[height] = _height_of_contact(model, data, height)
    return dataclasses.replace(state, qpos=torch.as_tensor(np.array(data.qpos))[None])


def _height_of_contact(model: MjModel, data: MjData, height: int) -> float:
    """The highest place, in small steps from well above, at which more touches than far up."""
    start, extent = float(data.qpos[height]), float(model.stat.extent)

    def contacts(z: float) -> int:
        data.qpos[height] = z
        mj.mj_kinematics(model, data)
        mj.mj_comPos(model, data)
        mj.mj_collision(model, data)
        return int(data.ncon)

    top = start + extent
    none = contacts(top)
    steps = np.linspace(top, start - 2 * extent, _SINK)
    touching = next((z for z in steps if contacts(z) > none), None)
    if touching is None:
        return start
    low, high = float(touching), float(touching) + 3 * extent / (_SINK - 1)
    for _ in range(8):  # a shallow contact: the deep ones have forces that all look alike once clipped
        middle = (low + high) / 2
        low, high = (middle, high) if contacts(middle) > none else (low, middle)
    return low


def reach_contact(model: MjModel, state: PhysicsState, generator: torch.Generator) -> PhysicsState | None:
    """A state in which something touches, None if no random pose does."""
    for _ in range(TRIES):
        pose = random_pose(model, state, generator, KINDS - 1)
        if touches(model, pose):
            return pose
    return None


def can_touch(model: MjModel) -> bool:
    """Whether any two geoms collide when they meet: not of one link, of parent and child, or excluded."""
    filters = Filters(model)
    return bool(filters.may.any() or filters.pairs)
