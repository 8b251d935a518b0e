"""One element's action on everything in a model."""

from __future__ import annotations

import numpy as np

from torchrl_sym.mujoco.derive.actuators import map_actuators
from torchrl_sym.mujoco.derive.coordinates import CoordinateMap
from torchrl_sym.mujoco.derive.images import Image
from torchrl_sym.mujoco.derive.matching import Matcher
from torchrl_sym.mujoco.derive.sites import map_sites
from torchrl_sym.mujoco.derive.tendons import map_tendons
from torchrl_sym.mujoco.model.types import Array, MjModel


class Action:
    """One element's action on everything in a model."""

    def __init__(
        self, model: MjModel, matcher: Matcher, coordinates: CoordinateMap, tolerance: float
    ) -> None:
        self.matcher, data = matcher, matcher.data
        self.tolerance = tolerance
        self.coordinates = coordinates
        self.sites = map_sites(model, data, matcher, coordinates.bodies, tolerance)
        self.tendons = map_tendons(model, coordinates, self.sites)
        self.actuators = map_actuators(matcher, coordinates, self.sites, self.tendons)
        self.ctrl, self.ctrl_offset = _scatter(self.actuators, model.nu)
        self.act = np.zeros((model.na, model.na))
        for a, image in self.actuators.items():
            count = int(model.actuator_actnum[a])
            if count > 0:
                i, j = int(model.actuator_actadr[a]), int(model.actuator_actadr[image.index])
                self.act[j : j + count, i : i + count] = image.sign * np.eye(count)


def _scatter(images: dict[int, Image], size: int) -> tuple[Array, Array]:
    matrix, offset = np.zeros((size, size)), np.zeros(size)
    for a, image in images.items():
        matrix[image.index, a] = image.sign
        offset[image.index] = image.offset
    return matrix, offset
