"""States of MuJoCo simulations: what is written, read and mapped."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrl_sym.mujoco.derive import ModelSymmetry
from torchrl_sym.mujoco.model.types import MjData, MjModel, mj

_FIELDS = ("qpos", "qvel", "mocap_pos", "mocap_quat", "act", "ctrl", "qacc_warmstart")


@dataclass
class PhysicsState:
    """State of one MuJoCo simulation as tensors with one row, and what its environment remembers beside.

    ``added`` is added to what MuJoCo computes, by field, before anything is observed.
    """

    qpos: Tensor
    qvel: Tensor
    mocap_pos: Tensor
    mocap_quat: Tensor
    act: Tensor
    ctrl: Tensor
    qacc_warmstart: Tensor
    time: float
    memory: dict[str, Any] = field(default_factory=dict)
    added: dict[str, Tensor] = field(default_factory=dict)

    def rows(self, ids: slice) -> PhysicsState:
        """A copy."""
        return dataclasses.replace(self, **{name: getattr(self, name)[ids].clone() for name in _FIELDS})


def read_state(data: MjData, memory: dict[str, Any]) -> PhysicsState:
    """The state of a simulation, with what is remembered beside."""
    rows: dict[str, Any] = {name: torch.as_tensor(np.array(getattr(data, name)))[None] for name in _FIELDS}
    return PhysicsState(**rows, time=float(data.time), memory=memory)


def physics_states(model: MjModel, state: Any) -> list[PhysicsState]:
    """Each row of another kind of state; what it lacks is as the model has it."""
    rows = []
    for row in range(len(state.qpos)):
        data = mj.MjData(model)
        write_state(data, state, row)
        rows.append(read_state(data, {}))
    return rows


def write_state(data: MjData, state: Any, row: int = 0) -> None:
    """Write one row of a state into an ``MjData``; what the state lacks keeps its value."""
    for name in _FIELDS:
        value = getattr(state, name, None)
        if value is not None and value[row].numel():
            getattr(data, name)[:] = value[row].numpy()
    data.time = float(torch.as_tensor(state.time).reshape(-1)[row])


def image_of(
    robot: ModelSymmetry, state: PhysicsState, g: int, memory: dict[str, Any], added: dict[str, Tensor]
) -> PhysicsState:
    """Image of a state under one element, with those of its memory and of what is added."""
    model = robot.model
    position, rotation = state.mocap_pos, state.mocap_quat
    if model.nmocap:
        position, rotation = robot.map_mocap(position, rotation, g)
    return PhysicsState(
        qpos=robot.map_qpos(state.qpos, g),
        qvel=robot.map_qvel(state.qvel, g),
        mocap_pos=position,
        mocap_quat=rotation,
        act=robot.map_act(state.act, g) if model.na else state.act,
        ctrl=robot.map_ctrl(state.ctrl, g) if model.nu else state.ctrl,
        qacc_warmstart=robot.map_qvel(state.qacc_warmstart, g),
        time=state.time,
        memory=memory,
        added=added,
    )


def touches(model: MjModel, state: Any, row: int = 0) -> bool:
    """Whether anything is in contact in a row of a state."""
    data = mj.MjData(model)
    write_state(data, state, row)
    mj.mj_fwdPosition(model, data)
    return bool(data.ncon > 0)
