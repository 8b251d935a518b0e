"""One element's action on everything in a model."""

from __future__ import annotations

import numpy as np

from torchrl_sym.mujoco.derive.actuators import map_actuators
from torchrl_sym.mujoco.derive.coordinates import CoordinateMap
from torchrl_sym.mujoco.derive.matching import Matcher
from torchrl_sym.mujoco.derive.sites import map_sites
from torchrl_sym.mujoco.derive.tendons import map_tendons


class Action:
    """One element's action on everything in a model.

    Attributes:
        coordinates: that on joints and links, as matrices.
        sites, tendons, actuators: where each goes.
        refusals: of actuators whose image cannot be told, why not.
        ctrl, ctrl_offset: that on controls, zero where it cannot be told.
        act, act_offset: that on the states of actuators.
    """

    def __init__(self, matcher: Matcher, coordinates: CoordinateMap, tolerance: float) -> None:
        self.matcher, self.coordinates, self.tolerance = matcher, coordinates, tolerance
        model = matcher.model
        self.sites = map_sites(model, matcher.data, matcher, coordinates.bodies, tolerance)
        self.tendons = map_tendons(matcher, coordinates, tolerance)
        self.actuators, self.refusals = map_actuators(matcher, coordinates, self.tendons, tolerance)

        self.ctrl, self.ctrl_offset = np.zeros((model.nu, model.nu)), np.zeros(model.nu)
        self.act, self.act_offset = np.zeros((model.na, model.na)), np.zeros(model.na)
        controls = getattr(model, "actuator_ctrladr", np.arange(model.nu))
        numbers = getattr(model, "actuator_ctrlnum", np.ones(model.nu, dtype=int))
        for a, image in self.actuators.items():
            parts = (
                (self.ctrl, self.ctrl_offset, image.offset, controls, numbers),
                (
                    self.act,
                    self.act_offset,
                    image.state_offset,
                    model.actuator_actadr,
                    model.actuator_actnum,
                ),
            )
            for matrix, offsets, offset, addresses, sizes in parts:
                count, start, end = int(sizes[a]), int(addresses[a]), int(addresses[image.index])
                if count == 0:
                    continue
                for b, weight in image.weights.items():
                    place = int(addresses[b])
                    matrix[place : place + count, start : start + count] = weight * np.eye(count)
                offsets[end : end + count] = offset
