"""Lengths that actuators drive and equality constraints tie, as vectors.

The coordinate of a joint and the length of a fixed tendon are linear in the coordinates of joints, those of
spatial tendons are not. So a length is a row vector v over (velocities, tendons), with a 1 for a spatial
tendon; its image under the map Q of velocities and tendons is Q v. Joint and tendon equalities whose
polynomial is linear hold the coordinates x on C x = c. There, lengths v and v + C^T k change alike, and
forces along them do the same, for any k: this is how one motor drives two fingers.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from torchrl_sym.mujoco.derive.coordinates import CoordinateMap
from torchrl_sym.mujoco.derive.images import Image
from torchrl_sym.mujoco.model.types import HINGE, SLIDE, Array, MjModel, mj, name_of

_JOINT, _TENDON = int(mj.mjtEq.mjEQ_JOINT), int(mj.mjtEq.mjEQ_TENDON)
_SMALL = 1e-9


def is_fixed(model: MjModel, tendon: int) -> bool:
    """Whether a tendon's length is a sum of joint coordinates."""
    return int(model.wrap_type[model.tendon_adr[tendon]]) == int(mj.mjtWrap.mjWRAP_JOINT)


def joint_length(model: MjModel, joint: int) -> Array:
    """The coordinate of a hinge or slide."""
    vector = np.zeros(model.nv + model.ntendon)
    vector[model.jnt_dofadr[joint]] = 1.0
    return vector


def tendon_length(model: MjModel, tendon: int) -> Array:
    """The length of a tendon."""
    vector = np.zeros(model.nv + model.ntendon)
    if is_fixed(model, tendon):
        start, count = int(model.tendon_adr[tendon]), int(model.tendon_num[tendon])
        for w in range(start, start + count):
            vector[model.jnt_dofadr[model.wrap_objid[w]]] += model.wrap_prm[w]
    else:
        vector[model.nv + tendon] = 1.0
    return vector


def coordinate_offsets(model: MjModel, map_: CoordinateMap) -> Array:
    """What is added to the coordinates of hinges and slides, by velocity."""
    offset = np.zeros(model.nv)
    for j in map_.scalars:
        offset[model.jnt_dofadr[j]] = map_.qpos_offset[model.jnt_qposadr[j]]
    return offset


def map_lengths(model: MjModel, map_: CoordinateMap, tendons: dict[int, Image]) -> tuple[Array, Array]:
    """The map Q of velocities and tendons, and what it adds to coordinates."""
    size = model.nv + model.ntendon
    matrix, offset = np.zeros((size, size)), np.zeros(size)
    matrix[: model.nv, : model.nv] = map_.qvel
    offset[: model.nv] = coordinate_offsets(model, map_)
    for t, image in tendons.items():
        matrix[model.nv + image.index, model.nv + t] = image.sign
    return matrix, offset


@dataclass
class Ties:
    """The linear equality constraints C x = c that are active, and their numbers."""

    rows: Array
    values: Array
    equalities: list[int]

    @classmethod
    def of(cls, model: MjModel) -> Ties:
        """Read joint and tendon equalities with linear polynomials."""
        rows, values, equalities = [], [], []
        for e in range(model.neq):
            if int(model.eq_type[e]) not in (_JOINT, _TENDON) or not model.eq_active0[e]:
                continue
            constant, slope, *higher = model.eq_data[e, :5]
            one, other = int(model.eq_obj1id[e]), int(model.eq_obj2id[e])
            if other >= 0 and any(higher):
                continue
            row, rest = _length(model, int(model.eq_type[e]), one)
            value = rest + constant
            if other >= 0:
                second, start = _length(model, int(model.eq_type[e]), other)
                row, value = row - slope * second, value - slope * start
            rows.append(row)
            values.append(value)
            equalities.append(e)
        whole = np.stack(rows) if rows else np.zeros((0, model.nv + model.ntendon))
        return cls(whole, np.array(values), equalities)

    def combine(self, gap: Array) -> Array | None:
        """K with C^T k = gap; None if the constraints do not tie it."""
        if not len(self.rows):
            return None
        k = np.linalg.lstsq(self.rows.T, gap, rcond=None)[0]
        return (
            np.asarray(k, dtype=np.float64)
            if np.abs(self.rows.T @ k - gap).max() < 1e-6 * max(1.0, np.abs(gap).max())
            else None
        )

    def project(self, vector: Array) -> Array:
        """The part of a length that the constraints leave free."""
        if not len(self.rows):
            return vector
        return vector - self.rows.T @ np.linalg.lstsq(self.rows.T, vector, rcond=None)[0]

    def words(self, model: MjModel, k: Array) -> str:
        """Names of the constraints that enter."""
        names = [
            name_of(model, "equality", e)
            for e, x in zip(self.equalities, k, strict=True)
            if abs(x) > _SMALL
        ]
        return ", ".join(names)


def _length(model: MjModel, kind: int, index: int) -> tuple[Array, float]:
    """What an equality measures, and its value in qpos0."""
    if kind == _TENDON:
        return tendon_length(model, index), float(model.tendon_length0[index])
    assert int(model.jnt_type[index]) in (HINGE, SLIDE)  # the compiler demands it
    return joint_length(model, index), float(model.qpos0[model.jnt_qposadr[index]])
