"""What an entry of an observation seems to be: the joint, sensor or body whose value it always equals."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrl_sym.mujoco.infer.columns import matches
from torchrl_sym.mujoco.model.types import Array, MjModel, name_of
from torchrl_sym.mujoco.verify.physics import PhysicsSubject
from torchrl_sym.mujoco.verify.subjects import Subject

# Fields of MjData by what they describe, with the words for one of their values. The first that fits names.
_FIELDS = (
    ("act", "activation", "actuator"),
    ("ctrl", "control", "actuator"),
    ("actuator_force", "force", "actuator"),
    ("actuator_length", "length", "actuator"),
    ("ten_length", "length", "tendon"),
    ("xpos", "place", "body"),
    ("xquat", "quaternion", "body"),
    ("xmat", "rotation", "body"),
    ("subtree_com", "center of mass", "body"),
    ("site_xpos", "place", "site"),
    ("cfrc_ext", "outer force", "body"),
    ("cvel", "velocity", "body"),
    ("cinert", "inertia", "body"),
)


def quantities_of(subject: Subject, state: Any) -> dict[str, Tensor]:
    """Values by name, ``(rows,)`` each, of the state that the environment is in."""
    model = subject.model
    out: dict[str, Tensor] = {}
    for kind in ("qpos", "qvel"):
        out |= dict(zip(_coordinates(model, kind), getattr(state, kind).T, strict=True))
    if not isinstance(subject, PhysicsSubject):
        return out
    for i in range(model.nsensor):
        start, count = int(model.sensor_adr[i]), int(model.sensor_dim[i])
        values = subject.data.sensordata[start : start + count]
        _put(out, f"sensor {name_of(model, 'sensor', i)}", values)
    for v, value in enumerate(subject.data.qfrc_actuator):
        name = name_of(model, "joint", int(model.dof_jntid[v]))
        _put(out, f"{name} actuator torque [{v - int(model.jnt_dofadr[model.dof_jntid[v]])}]", value)
    for field, words, kind in _FIELDS:
        values = getattr(subject.data, field)
        for i in range(len(values)):
            _put(out, f"{name_of(model, kind, i)} {words}", values[i])
    return out


def _put(out: dict[str, Tensor], name: str, values: Array) -> None:
    flat = np.array(values, dtype=np.float64).reshape(-1)
    for i, value in enumerate(flat):
        out[name if len(flat) == 1 else f"{name}[{i}]"] = torch.tensor([value], dtype=torch.float64)


def _coordinates(model: MjModel, kind: str) -> list[str]:
    """Names of all entries of qpos or qvel, by their joint."""
    size, starts = (model.nq, model.jnt_qposadr) if kind == "qpos" else (model.nv, model.jnt_dofadr)
    words = "" if kind == "qpos" else " velocity"
    names = []
    for j, (start, end) in enumerate(zip(starts, [*starts[1:], size], strict=True)):
        name = name_of(model, "joint", j) + words
        names += [name] if end - start == 1 else [f"{name}[{i}]" for i in range(end - start)]
    return names


def labels_of(quantities: dict[str, Tensor], values: Array, margin: Array) -> list[str]:
    """What each entry of ``(n, d)`` equals, up to a sign; ``""`` if nothing."""
    if not quantities:
        return [""] * values.shape[1]
    names = list(quantities)
    table = torch.stack([quantities[name] for name in names], dim=1).numpy()
    constant = np.ptp(values, axis=0) <= margin
    labels = []
    for found, still in zip(matches(table, values, margin), constant, strict=True):
        best = min(found, key=lambda hit: (hit[0], -hit[1]), default=None)
        labels.append("" if best is None or still else "-" * (best[1] < 0) + names[best[0]])
    return labels
