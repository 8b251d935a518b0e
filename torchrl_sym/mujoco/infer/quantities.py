"""What an entry of an observation seems to be: the joint, sensor or body whose value it always equals."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrl_sym.mujoco.infer.columns import matches
from torchrl_sym.mujoco.model.types import Array, MjModel, name_of
from torchrl_sym.mujoco.verify.physics import PhysicsSubject
from torchrl_sym.mujoco.verify.subjects import Subject

# Fields of MjData, what they describe, and the words for one of their values. The first that fits names.
_FIELDS = (
    ("sensordata", "sensor", "sensor {}"),
    ("qfrc_actuator", "joint", "{} actuator torque"),
    ("act", "actuator", "{} activation"),
    ("ctrl", "actuator", "{} control"),
    ("actuator_force", "actuator", "{} force"),
    ("actuator_length", "actuator", "{} length"),
    ("ten_length", "tendon", "{} length"),
    ("xpos", "body", "{} place"),
    ("xquat", "body", "{} quaternion"),
    ("xmat", "body", "{} rotation"),
    ("subtree_com", "body", "{} center of mass"),
    ("site_xpos", "site", "{} place"),
    ("cfrc_ext", "body", "{} outer force"),
    ("cvel", "body", "{} velocity"),
    ("cinert", "body", "{} inertia"),
)


def values_of(subject: Subject, state: Any) -> Tensor:
    """Everything that has a name, ``(rows, k)``, in the state that the environment is in."""
    parts = [state.qpos, state.qvel]
    if isinstance(subject, PhysicsSubject):
        fields = [np.array(getattr(subject.data, field)).reshape(1, -1) for field, *_ in _FIELDS]
        parts += [torch.as_tensor(x, dtype=torch.float64) for x in fields]
    return torch.cat(parts, dim=1)


def names_of(subject: Subject) -> list[str]:
    """The names of :func:`values_of`, in order."""
    model = subject.model
    names = [*_coordinates(model, "qpos", "{}"), *_coordinates(model, "qvel", "{} velocity")]
    if not isinstance(subject, PhysicsSubject):
        return names
    for field, kind, words in _FIELDS:
        values = np.array(getattr(subject.data, field))
        if field == "qfrc_actuator":
            names += _coordinates(model, "qvel", words)
        elif field == "sensordata":
            starts = [*model.sensor_adr, model.nsensordata]
            names += _split(model, kind, starts, words)
        elif field == "act":
            names += [f"activation {i}" for i in range(len(values))]
        else:
            each = values[0].size if len(values) else 1
            names += _split(model, kind, range(0, values.size + 1, each), words)
    return names


def _coordinates(model: MjModel, kind: str, words: str) -> list[str]:
    """Names of all entries of qpos or qvel, by their joint."""
    size, starts = (model.nq, model.jnt_qposadr) if kind == "qpos" else (model.nv, model.jnt_dofadr)
    return _split(model, "joint", [*starts, size], words)


def _split(model: MjModel, kind: str, starts: Any, words: str) -> list[str]:
    """A name for every value, of things of which each has the values from its start to the next."""
    count = {"actuator": getattr(model, "nactuator", model.nu)}.get(kind, len(starts))  # one may have more
    names = []
    for i, (start, end) in enumerate(itertools.pairwise(starts)):
        name = words.format(name_of(model, kind, i) if i < count else f"{kind} {i}")
        names += [name] if end - start == 1 else [f"{name}[{k}]" for k in range(end - start)]
    return names


def labels_of(names: list[str], quantities: Array, values: Array, margin: Array) -> list[str]:
    """What each entry of ``(n, d)`` equals, up to a sign; ``""`` if nothing.

    Args:
        names: of the quantities.
        quantities: ``(n, k)``.
        values: the entries.
        margin: largest difference of each entry.
    """
    still = np.ptp(values, axis=0) <= margin
    labels = []
    for found, constant in zip(matches(quantities, values, margin), still, strict=True):
        best = min(found, key=lambda match: (match.index, -match.sign), default=None)
        labels.append("" if best is None or constant else "-" * (best.sign < 0) + names[best.index])
    return labels
