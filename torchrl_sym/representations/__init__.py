"""Representations of point groups: how observations and actions transform."""

from torchrl_sym.representations.base import Representation
from torchrl_sym.representations.orientations import quaternion, rotation_6d, rotation_matrix
from torchrl_sym.representations.permutations import (
    height_map,
    permutation,
    points,
    signed_permutation,
)
from torchrl_sym.representations.vectors import (
    axial,
    heading,
    invariant,
    planar,
    polar,
    pseudoscalar,
    scalar,
)

__all__ = [
    "Representation",
    "axial",
    "heading",
    "height_map",
    "invariant",
    "permutation",
    "planar",
    "points",
    "polar",
    "pseudoscalar",
    "quaternion",
    "rotation_6d",
    "rotation_matrix",
    "scalar",
    "signed_permutation",
]
