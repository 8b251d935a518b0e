"""Outer forces and sensor readings as if anything touched anywhere.

Contact forces stay zero until something touches, and the upper side of a robot hardly ever does: entries
that never change say nothing. So an observation may also be asked for with random numbers added to what
MuJoCo computed of contact (``cfrc_ext``, ``sensordata``), of which the images are known: forces are polar
and torques axial vectors on bodies that change places, sensors are mapped by `derive`.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrl_sym.mujoco.derive import ModelSymmetry
from torchrl_sym.mujoco.model.types import Array, MjModel, mj
from torchrl_sym.representations import Representation

_CLOSE = 1e-2  # of the model's extent: how far a body's image may be from where its place goes
_SAME = 1e-5  # m: bodies no farther apart are at one place
_SIZE = 0.5  # largest number that is added: environments clip forces at 1


class Disturbances:
    """Random additions to forces and readings, and their images.

    Args:
        robot: the symmetry of the model.
        poses: states in which bodies are told apart, at least one, with their images by element.
    """

    def __init__(self, robot: ModelSymmetry, pose: Any, transform: Callable[[Any, int], Any]) -> None:
        self.robot, self.group = robot, robot.group
        self.bodies = _body_images(robot, pose, transform)
        try:
            self.sensors: Representation | None = robot.sensordata if robot.model.nsensor else None
        except ValueError:  # some reading has no linear image
            self.sensors = None

    def draw(self, generator: torch.Generator) -> dict[str, Tensor]:
        """Additions to ``cfrc_ext`` and ``sensordata``, by these names, a row each."""
        model = self.robot.model
        force = _SIZE * (2 * torch.rand(1, model.nbody, 6, generator=generator, dtype=torch.float64) - 1)
        force[:, (self.bodies < 0).any(axis=0)] = 0.0
        out = {"cfrc_ext": force}
        if self.sensors is not None:
            size = (1, model.nsensordata)
            out["sensordata"] = _SIZE * torch.rand(size, generator=generator, dtype=torch.float64)
        return out

    @staticmethod
    def anything(model: MjModel, generator: torch.Generator) -> dict[str, Tensor]:
        """Additions to everything, whether or not their images are known."""
        sizes = {"cfrc_ext": (1, model.nbody, 6), "sensordata": (1, model.nsensordata)}
        draws = {k: torch.rand(x, generator=generator, dtype=torch.float64) for k, x in sizes.items()}
        return {name: _SIZE * (0.5 + draw) for name, draw in draws.items()}

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


def _places(model: MjModel, state: Any) -> Array:
    """Places of frame and centre of mass of every body, ``(nbody, 6)``."""
    from torchrl_sym.mujoco.verify.states import write_state

    data = mj.MjData(model)
    write_state(data, state)
    mj.mj_kinematics(model, data)
    return np.concatenate([data.xpos, data.xipos], axis=1)


def _body_images(robot: ModelSymmetry, pose: Any, transform: Callable[[Any, int], Any]) -> Array:
    """Image of every body under every element, ``(N, nbody)``; -1 where it is not clear."""
    model, group = robot.model, robot.group
    here = _places(model, pose)
    out = np.full((group.order, model.nbody), -1)
    axis = np.array([*getattr(robot, "axis", (0.0, 0.0)), 0.0])
    for g in range(group.order):
        turn = group.matrices[g].numpy()
        there = _places(model, transform(pose, g))
        moved = np.concatenate([(x - axis) @ turn.T + axis for x in (here[:, :3], here[:, 3:])], axis=1)
        off = np.linalg.norm(moved[:, None] - there, axis=2)
        nearest = off.min(axis=1, keepdims=True)
        near = (off <= nearest + _SAME) & (nearest < _CLOSE * float(model.stat.extent))
        near &= np.abs(model.body_mass[:, None] - model.body_mass) <= 0.1 * model.body_mass.max() + 1e-9
        # several bodies at one place: the k-th of them goes to the k-th
        for places, bodies in itertools.groupby(range(model.nbody), key=lambda b: near[b].tobytes()):
            mine, theirs = list(bodies), np.flatnonzero(np.frombuffer(places, dtype=bool))
            if len(mine) == len(theirs):
                out[g, mine] = theirs
    out[0] = np.arange(model.nbody)
    while True:  # bodies are known if all that they are exchanged with are
        known = (out >= 0).all(axis=0)
        for row in out:
            known &= known[row] & (np.bincount(row[row >= 0], minlength=model.nbody)[row] == 1)
        if known[(out >= 0).all(axis=0)].all():
            return out
        out[:, ~known] = -1
