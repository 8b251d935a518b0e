"""Quaternions (w, x, y, z) and rotation matrices, as MuJoCo writes them."""

from __future__ import annotations

import numpy as np

from torchrl_sym.mujoco.model.types import Array, mj


def quaternion(matrix: Array) -> Array:
    """(w, x, y, z) of a rotation matrix."""
    out = np.zeros(4)
    mj.mju_mat2Quat(out, matrix.flatten())
    return out / np.linalg.norm(out)


def rotation(q: Array) -> Array:
    """Matrix of a unit quaternion (w, x, y, z)."""
    out = np.zeros(9)
    mj.mju_quat2Mat(out, np.ascontiguousarray(q))
    return out.reshape(3, 3)


def conjugate(q: Array) -> Array:
    """Inverse of a unit quaternion."""
    return q * np.array([1.0, -1.0, -1.0, -1.0])


def product(a: Array, b: Array) -> Array:
    """Hamilton product a b."""
    return left_matrix(a) @ b


def sandwich(a: Array, b: Array) -> Array:
    """Matrix of q -> a q b."""
    return left_matrix(a) @ right_matrix(b)


def left_matrix(q: Array) -> Array:
    """Matrix of p -> q p."""
    w, x, y, z = q
    return np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])


def right_matrix(q: Array) -> Array:
    """Matrix of p -> p q."""
    w, x, y, z = q
    return np.array([[w, -x, -y, -z], [x, w, z, -y], [y, -z, w, x], [z, y, -x, w]])
