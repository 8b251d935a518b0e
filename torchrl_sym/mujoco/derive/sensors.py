"""Finds the image of every sensor, from the images of all it may measure.

Sensors are matched directly, by link and place rather than through images of their objects: two range
finders at one place that look in different directions are told apart, and every duplicate has an image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from torchrl_sym.mujoco.derive.action import Action
from torchrl_sym.mujoco.derive.images import Image, assign
from torchrl_sym.mujoco.derive.measurements import Measurements
from torchrl_sym.mujoco.derive.sensor_blocks import NotLinear, SensorBlocks
from torchrl_sym.mujoco.derive.sensor_rules import RULES
from torchrl_sym.mujoco.model.types import Array, MjModel, label_of, mj, name_of


@dataclass
class SensorMap:
    """One element's action: images and, by (sensor, image), blocks; and why other sensors have none."""

    images: dict[int, Image] = field(default_factory=dict)
    blocks: dict[tuple[int, int], Array] = field(default_factory=dict)
    refusals: dict[int, str] = field(default_factory=dict)


def sensor_matrices(
    model: MjModel, maps: Sequence[SensorMap], sensors: Sequence[int], elements: Sequence[str]
) -> list[Array]:
    """One matrix per element on the readings of some sensors, in the order given.

    Raises:
        ValueError: a sensor has no linear image, or one that is not among those asked for.
    """
    sizes = [int(model.sensor_dim[s]) for s in sensors]
    start = dict(zip(sensors, np.cumsum([0, *sizes[:-1]]), strict=True)) if sensors else {}
    matrices = []
    for map_, element in zip(maps, elements, strict=True):
        matrix = np.zeros((sum(sizes), sum(sizes)))
        for s, size in zip(sensors, sizes, strict=True):
            name = name_of(model, "sensor", s)
            if s in map_.refusals:
                raise ValueError(
                    f"sensor {name!r} has no representation under {element!r}: {map_.refusals[s]}"
                    "; or select other sensors with sensors(names)"
                )
            for image in map_.images[s].weights:
                if image not in start:
                    raise ValueError(
                        f"{element!r} sends sensor {name!r} to {name_of(model, 'sensor', image)!r}, "
                        "which is not among the sensors asked for; add it"
                    )
                rows = slice(start[image], start[image] + size)
                matrix[rows, start[s] : start[s] + size] = map_.blocks[s, image]
        matrices.append(matrix)
    return matrices


class SensorMapper:
    """Finds the image of every sensor under one element, from the images of all it may measure."""

    def __init__(self, action: Action) -> None:
        self.matcher, self.model, self.tolerance = action.matcher, action.matcher.model, action.tolerance
        self.what = Measurements(action)
        self.blocks = SensorBlocks(self.what)

    def map(self) -> SensorMap:
        """Image and block of every sensor that has them; never an error."""
        out, count = SensorMap(), self.model.nsensor
        if np.array_equal(self.matcher.matrix, np.eye(3)):
            out.images = {s: Image(s) for s in range(count)}
            out.blocks = {(s, s): np.eye(int(self.model.sensor_dim[s])) for s in range(count)}
            return out
        mj.mj_camlight(self.model, self.matcher.data)  # cameras' frames, which only sensors need
        mj.mj_camlight(self.model, self.matcher.image)
        classes: dict[tuple, list[int]] = {}
        for s in range(count):
            reason = self.what.unsupported(s)
            if reason:
                out.refusals[s] = reason
            else:
                classes.setdefault(self.what.signature(s), []).append(s)
        for members in classes.values():
            mixed = [s for s in members if self.what.mixture(s)]
            for s in mixed:
                self._add_mixed(out, s, members)
            self._add_class(out, [s for s in members if s not in mixed])
        return out

    def _add_class(self, out: SensorMap, members: list[int]) -> None:
        misfit = np.array([[self.what.misfit(s, t) for t in members] for s in members])
        for i, j in assign(misfit):
            s, t = members[i], members[j]
            if misfit[i, j] > self.tolerance:
                out.refusals[s] = self._too_far(s, members, misfit[i])
                continue
            try:
                block, offset = self.blocks.block(s, t)
            except NotLinear as error:
                out.refusals[s] = str(error)
                continue
            sign = float(block[0, 0]) if block.size == 1 else 1.0
            out.images[s] = Image(t, sign, offset, misfit=float(misfit[i, j]))
            out.blocks[s, t] = block
            self._check_offset(out, s, offset)

    def _add_mixed(self, out: SensorMap, s: int, members: list[int]) -> None:
        """Image of what measures a slide, tendon or motor that an element mixes with others."""
        where, measures = RULES[self.what.kind(s)]
        if measures != "signed":
            out.refusals[s] = (
                f"the element mixes the {where} that it measures with others, and limits do not mix"
            )
            return
        rank = [t for t in members if self.what.object(t) == self.what.object(s)].index(s)
        weights = {}
        for target, weight in self.what.mixture(s).items():
            there = [t for t in members if self.what.object(t)[1] == target]
            if rank >= len(there):
                name = label_of(self.model, where, target)
                out.refusals[s] = (
                    f"the element mixes its {where} with {name}, which no sensor of its kind measures"
                )
                return
            weights[there[rank]] = weight
        best = max(weights, key=lambda t: abs(weights[t]))
        _, offset = self.blocks.signed(s)
        out.images[s] = Image(best, offset=offset, mixture=weights)
        out.blocks |= {(s, t): np.full((1, 1), weight) for t, weight in weights.items()}
        self._check_offset(out, s, offset if self.what.kind(s).endswith("POS") else 0.0)

    @staticmethod
    def _check_offset(out: SensorMap, s: int, offset: float) -> None:
        if abs(offset) > 1e-9:
            out.refusals[s] = (
                f"its reading is mapped with an offset of {offset:.6g}, as the pose that the group keeps "
                "is not at zero; use joint_positions or map_qpos"
            )

    def _too_far(self, s: int, members: list[int], misfit: Array) -> str:
        """Why no sensor measures the image of what one does, with the nearest and how far it is."""
        nearest = int(misfit.argmin())
        where, remedy = RULES[self.what.kind(s)][0], "add the missing one or use a smaller group"
        if misfit[nearest] < 1 and where.split()[-1] in ("place", "volume"):
            kind, index = self.what.object(members[nearest])
            away = 1e3 * float(misfit[nearest]) * self.matcher.size(self.what.places.link(kind, index))
            name = name_of(self.model, "sensor", members[nearest])
            return (
                "no sensor of its kind, cutoff and timing measures the image of what it measures: the "
                f"nearest, {name!r}, is {away:.1f} mm away; move it, {remedy}"
            )
        return f"no sensor of its kind, cutoff and timing measures the image of what it measures; {remedy}"
