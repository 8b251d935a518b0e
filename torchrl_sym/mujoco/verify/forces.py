"""Outer forces and sensor readings as if anything touched anywhere.

Contact forces stay zero until something touches, and the upper side of a robot hardly ever does: entries
that never change say nothing. So an observation may also be asked for with random numbers added to what
MuJoCo computed of contact (``cfrc_ext``, ``sensordata``), of which the images are known: forces are polar
and torques axial vectors on bodies that change places, sensors are mapped by `derive`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrl_sym.mujoco.derive import ModelSymmetry
from torchrl_sym.mujoco.model.types import Array, MjModel, mj, name_of
from torchrl_sym.representations import Representation

_KINDS = ("TOUCH", "FORCE", "TORQUE", "CONTACT", "TACTILE")
_CONTACT = [kind for name in _KINDS if (kind := getattr(mj.mjtSensor, f"mjSENS_{name}", None)) is not None]
_SIZE = 0.5  # largest number that is added: environments clip forces at 1


class Disturbances:
    """Random additions to forces and readings, and their images.

    Args:
        robot: the symmetry of the model.
    """

    def __init__(self, robot: ModelSymmetry) -> None:
        self.robot, self.group = robot, robot.group
        self.bodies = _body_images(robot)
        try:
            self.sensors: Representation | None = robot.sensordata if robot.model.nsensor else None
        except ValueError:  # some reading has no linear image
            self.sensors = None

    def draw(self, generator: torch.Generator) -> dict[str, Tensor]:
        """Additions to ``cfrc_ext`` and ``sensordata``, by these names, a row each."""
        model = self.robot.model
        force = _SIZE * (2 * torch.rand(1, model.nbody, 6, generator=generator, dtype=torch.float64) - 1)
        force[:, np.flatnonzero((self.bodies < 0).any(axis=0))] = 0.0
        out = {"cfrc_ext": force}
        if self.sensors is not None:
            size = (1, model.nsensordata)
            out["sensordata"] = _SIZE * torch.rand(size, generator=generator, dtype=torch.float64)
        return out

    @staticmethod
    def anything(model: MjModel, generator: torch.Generator) -> dict[str, Tensor]:
        """Additions to all that contact makes, whether or not their images are known."""
        sizes = {"cfrc_ext": (1, model.nbody, 6), "sensordata": (1, model.nsensordata)}
        draws = {k: torch.rand(x, generator=generator, dtype=torch.float64) for k, x in sizes.items()}
        out = {name: _SIZE * (0.5 + draw) for name, draw in draws.items()}
        felt = np.isin(model.sensor_type, [int(kind) for kind in _CONTACT])
        out["sensordata"] *= torch.as_tensor(np.repeat(felt, model.sensor_dim))
        return out

    def image(self, added: dict[str, Tensor], g: int) -> dict[str, Tensor]:
        """Images of what was drawn."""
        out = {}
        if "cfrc_ext" in added:
            force = added["cfrc_ext"]
            turn, det = self.group.matrices[g], self.group.det[g]
            turned = torch.cat([det * force[..., :3] @ turn.T, force[..., 3:] @ turn.T], -1)
            out["cfrc_ext"] = torch.zeros_like(force)
            known = torch.as_tensor(np.flatnonzero((self.bodies >= 0).all(axis=0)))
            out["cfrc_ext"][:, torch.as_tensor(self.bodies[g])[known]] = turned[:, known]
        if "sensordata" in added and self.sensors is not None:
            out["sensordata"] = self.sensors(added["sensordata"], g)
        return out

    @staticmethod
    def add(data: Any, added: dict[str, Tensor]) -> None:
        """Add them to what was computed."""
        for name, values in added.items():
            getattr(data, name)[:] += values[0].numpy()


def _body_images(robot: ModelSymmetry) -> Array:
    """Image of every body under every element, ``(N, nbody)``; -1 where there is none."""
    model = robot.model
    number = {name_of(model, "body", b): b for b in range(model.nbody)}
    tables = [robot.table("body", g) for g in range(robot.group.order)]
    return np.array([[number.get(table[name], -1) for name in number] for table in tables])
