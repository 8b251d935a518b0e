"""Representations of point groups: how observations and actions transform."""

from torchrl_sym.representations.base import Representation
from torchrl_sym.representations.clocks import gait_clock
from torchrl_sym.representations.fields import height_map, points
from torchrl_sym.representations.images import image
from torchrl_sym.representations.items import items
from torchrl_sym.representations.orientations import quaternion, rotation_6d, rotation_matrix
from torchrl_sym.representations.permutations import permutation, signed_permutation
from torchrl_sym.representations.regular import regular
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
    "gait_clock",
    "heading",
    "height_map",
    "image",
    "invariant",
    "items",
    "permutation",
    "planar",
    "points",
    "polar",
    "pseudoscalar",
    "quaternion",
    "regular",
    "rotation_6d",
    "rotation_matrix",
    "scalar",
    "signed_permutation",
]
