"""What `derive` found: named tables, representations and maps of the full state."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Literal

import numpy as np
from torch import Tensor

from torchrl_sym import checks
from torchrl_sym.groups import PointGroup
from torchrl_sym.mujoco.derive.action import Action
from torchrl_sym.mujoco.derive.bodies import map_bodies
from torchrl_sym.mujoco.derive.images import Image
from torchrl_sym.mujoco.derive.maps import Affine, represent
from torchrl_sym.mujoco.derive.sensors import SensorMap, SensorMapper, sensor_matrices
from torchrl_sym.mujoco.model.types import FREE, MjModel, check_mocap, label_of, name_of
from torchrl_sym.representations import Representation

Kind = Literal["joint", "actuator", "body", "site", "tendon", "sensor"]


class ModelSymmetry:
    """What :func:`derive` found: named tables, representations and full-state maps.

    Attributes:
        model: the model.
        group: the group that acts on it.
        joint_positions: representation of all hinge and slide coordinates, in the model's order,
            relative to a pose that the group keeps.
        joint_velocities: the same for their velocities.
        axis: a point (x, y) of the vertical axis that the group acts about, in the world.
        pose: in words, the pose that the group keeps.
        ambiguous: sentences on parts that nothing tells apart, so that their images were chosen freely.
    """

    def __init__(
        self,
        model: MjModel,
        group: PointGroup,
        actions: Sequence[Action],
        pose: str = "qpos0",
        ambiguous: Sequence[str] = (),
    ) -> None:
        self.model = model
        self.group = group
        self.pose, self.ambiguous = pose, tuple(ambiguous)
        x, y, _ = actions[0].matcher.axis.tolist()
        self.axis: tuple[float, float] = (x, y)
        self.actions = list(actions)
        self._scalar = actions[0].coordinates.scalars
        self.joint_positions = self._joint_representation(self._scalar)
        self.joint_velocities = self.joint_positions
        self._map_qvel = represent(self.group, [action.coordinates.qvel for action in actions])
        positions = represent(self.group, [action.coordinates.qpos for action in actions])
        self._map_qpos = Affine(positions, [action.coordinates.qpos_offset for action in actions])
        places = represent(self.group, [a.coordinates.mocap_position for a in actions])
        self._mocap_position = Affine(places, [a.coordinates.mocap_offset for a in actions])
        self._mocap_rotation = represent(self.group, [a.coordinates.mocap_rotation for a in actions])

    @property
    def qvel(self) -> Representation:
        """Representation of the full velocity; also of ``qacc_warmstart``.

        Raises:
            ValueError: a free body's frame is beside its plane of symmetry.
        """
        self._check_frames(FREE)
        return self._map_qvel

    def _check_frames(self, kind: int) -> None:
        """ValueError if a free (or mocap) body's position has no affine image, as its frame is astray."""
        gaps = [
            (gap, body)
            for action in self.actions
            for body, gap in action.coordinates.astray.items()
            if (self.model.body_mocapid[body] < 0) == (kind == FREE)
        ]
        if gaps:
            gap, body = max(gaps)
            raise ValueError(
                f"the frame of {label_of(self.model, 'body', body)} is {500 * gap:.3g} mm beside where the "
                "body is symmetric: the image of its position depends on its rotation, and no matrix maps "
                "it; move the frame's origin (the body's pos) onto the plane or axis of symmetry"
            )

    @functools.cached_property
    def actuators(self) -> Representation:
        """Representation of the controls, relative to a pose that the group keeps.

        Raises:
            ValueError: the image of what an actuator drives cannot be told; the message names it.
        """
        self._check_actuators()
        return represent(self.group, [action.ctrl for action in self.actions])

    @functools.cached_property
    def _map_ctrl(self) -> Affine:
        return Affine(self.actuators, [action.ctrl_offset for action in self.actions])

    @functools.cached_property
    def _map_act(self) -> Affine:
        self._check_actuators()
        states = represent(self.group, [action.act for action in self.actions])
        return Affine(states, [action.act_offset for action in self.actions])

    def _check_actuators(self) -> None:
        for action, element in zip(self.actions, self.group.names, strict=True):
            for a, reason in action.refusals.items():
                raise ValueError(
                    f"controls have no image under {element!r}: that of actuator "
                    f"{label_of(self.model, 'actuator', a)!r} cannot be told, as {reason}"
                )

    def _joint_representation(self, joints: list[int]) -> Representation:
        place, matrices = {j: i for i, j in enumerate(joints)}, []
        for element, action in zip(self.group.names, self.actions, strict=True):
            matrix = np.zeros((len(joints), len(joints)))
            for j in joints:
                for image, weight in action.coordinates.weights(j).items():
                    if image not in place:
                        raise ValueError(
                            f"{element!r} sends {name_of(self.model, 'joint', j)} to "
                            f"{name_of(self.model, 'joint', image)}, which is not among the joints asked "
                            "for; add it"
                        )
                    matrix[place[image], place[j]] = weight
            matrices.append(matrix)
        return represent(self.group, matrices)

    def joints(self, names: Sequence[str], *, relative: bool = False) -> Representation:
        """Representation of some hinge and slide joints, in the order of their names.

        Args:
            names: of the joints.
            relative: whether it is for velocities or torques, or for positions relative to a pose that the
                group keeps. Positions as such may need an offset, which no representation has.

        Raises:
            KeyError: no such joint.
            ValueError: an element sends one of them to a joint that is not among them, or positions of one
                need an offset and are not relative.
        """
        known = {name_of(self.model, "joint", j): j for j in self._scalar}
        missing = [name for name in checks.names("joints", names, least=0) if name not in known]
        if missing:
            raise KeyError(f"no hinge or slide joints {missing}; the model has {list(known)}")
        shifted = {n: o for g in self.group.names for n, o in self.offsets(g).items() if n in names}
        if shifted and not relative:
            name, offset = max(shifted.items(), key=lambda item: abs(item[1]))
            raise ValueError(
                f"positions of {list(shifted)} have an offset ({name!r}: {offset:.4g}), as the model's "
                "zero is not symmetric; use map_qpos, or relative=True for positions relative to a "
                "symmetric pose"
            )
        return self._joint_representation([known[name] for name in names])

    @functools.cached_property
    def _sensors(self) -> list[SensorMap]:
        return [SensorMapper(action).map() for action in self.actions]

    @functools.cached_property
    def sensordata(self) -> Representation:
        """Representation of all sensor readings, ``mjData.sensordata``; quaternions up to their sign.

        Raises:
            ValueError: a sensor's reading has no linear image; the message names it and says why.
        """
        return self._sensor_representation(range(self.model.nsensor))

    def sensors(self, names: Sequence[str]) -> Representation:
        """Representation of the readings of some sensors, in the order of their names.

        Raises:
            KeyError: no such sensor.
            ValueError: a reading has no linear image, or an element sends a sensor to one not named.
        """
        known = {name_of(self.model, "sensor", i): i for i in range(self.model.nsensor)}
        missing = [name for name in checks.names("sensors", names, least=0) if name not in known]
        if missing:
            raise KeyError(f"no sensors {missing}; the model has {list(known)}")
        return self._sensor_representation([known[name] for name in names])

    def _sensor_representation(self, sensors: Sequence[int]) -> Representation:
        return represent(self.group, sensor_matrices(self.model, self._sensors, sensors, self.group.names))

    def table(self, kind: Kind, g: int | str) -> dict[str, str]:
        """Where each named element goes: ``{"left": "-right"}`` reads "left's value becomes minus right's".

        What is mixed goes to a sum, ``"-0.5 x + 0.866 y"``; what has no image, to ``"(no image)"``.

        Args:
            kind: ``"joint"``, ``"actuator"``, ``"body"``, ``"site"``, ``"tendon"`` or ``"sensor"``.
            g: element by index or name.
        """
        index = self.group.index(g)
        action, model = self.actions[index], self.model
        map_ = action.coordinates
        tables = {
            "joint": lambda: {
                a: Image(b, map_.signs.get(a, 1.0), mixture=map_.mixed.get(a, {}))
                for a, b in map_.joints.items()
            },
            "actuator": lambda: action.actuators,
            "body": lambda: _plain(map_bodies(action.matcher, action.tolerance)),
            "site": lambda: _plain(action.sites),
            "tendon": lambda: action.tendons,
            "sensor": lambda: self._sensors[index].images,
        }
        images = tables[checks.one_of("kind", kind, tables)]()
        counts = {
            "joint": model.njnt,
            "actuator": getattr(model, "nactuator", model.nu),
            "body": model.nbody,
            "site": model.nsite,
            "tendon": model.ntendon,
            "sensor": model.nsensor,
        }
        names = [name_of(model, kind, a) for a in range(counts[kind])]
        return {
            name: images[a].text(names.__getitem__) if a in images else "(no image)"
            for a, name in enumerate(names)
        }

    def offsets(self, g: int | str) -> dict[str, float]:
        """Joints whose coordinate gets an offset, ``q' = sign q + offset``, by the name of the source."""
        action = self.actions[self.group.index(g)]
        return {
            name_of(self.model, "joint", j): offset
            for j, offset in action.coordinates.offsets.items()
            if abs(offset) > 1e-12
        }

    def map_qpos(self, qpos: Tensor, g: int | str | Tensor) -> Tensor:
        """Image of positions under one element, or under one per row.

        Args:
            qpos: ``(..., nq)``, in the units of the model.
            g: an element by index or name, or integer indices of the leading dimensions' shape.

        Raises:
            KeyError: no such element.
            ValueError: a last dimension other than nq, indices of another shape, or a free body whose frame
                is beside its plane of symmetry.

        Example:
            >>> import mujoco
            >>> import torch
            >>> from torchrl_sym.mujoco.derive.derive import derive
            >>> model = mujoco.MjModel.from_xml_string('''<mujoco><worldbody>
            ...   <body><joint type="slide" axis="0 1 0"/><geom size=".1"/></body>
            ... </worldbody></mujoco>''')
            >>> robot = derive(model, PointGroup.reflection("y"))
            >>> robot.map_qpos(torch.tensor([[1.0], [2.0]]), torch.tensor([0, 1])).tolist()
            [[1.0], [-2.0]]
        """
        self._check_frames(FREE)
        return self._map_qpos(qpos, g)

    def map_qvel(self, qvel: Tensor, g: int | str | Tensor) -> Tensor:
        """Image of velocities (or of ``qacc_warmstart``) ``(..., nv)``; ``g`` as in :meth:`map_qpos`."""
        return self.qvel(qvel, g)

    def map_ctrl(self, ctrl: Tensor, g: int | str | Tensor) -> Tensor:
        """Image of controls ``(..., nu)``, in the units of the actuators.

        Raises:
            ValueError: the image of what an actuator drives cannot be told; the message names it.
        """
        return self._map_ctrl(ctrl, g)

    def map_act(self, act: Tensor, g: int | str | Tensor) -> Tensor:
        """Image of actuator states ``(..., na)``."""
        return self._map_act(act, g)

    def map_mocap(self, position: Tensor, rotation: Tensor, g: int | str | Tensor) -> tuple[Tensor, Tensor]:
        """Image of mocap poses ``(..., nmocap, 3)`` and ``(..., nmocap, 4)``."""
        check_mocap(self.model, position, rotation)
        self._check_frames(-1)
        images = (
            image(x.flatten(-2), g).unflatten(-1, x.shape[-2:])
            for image, x in ((self._mocap_position, position), (self._mocap_rotation, rotation))
        )
        return next(images), next(images)

    def __str__(self) -> str:
        x, y = self.axis
        at = f" about ({x:.4g}, {y:.4g})" if x or y else ""
        lines = [f"symmetry of {self.model.nbody - 1} bodies under {self.group!r}{at}, at {self.pose}"]
        for kind in ("joint", "actuator"):
            tables = [self.table(kind, g) for g in range(self.group.order)]
            if not tables[0]:
                continue
            header = [kind, *self.group.names[1:]]
            rows = [[name, *(table[name] for table in tables[1:])] for name in tables[0]]
            widths = [max(map(len, column)) for column in zip(header, *rows, strict=True)]
            lines.append("")
            for row in (header, *rows):
                lines.append("  ".join(f"{c:<{w}s}" for c, w in zip(row, widths, strict=True)).rstrip())
        for name in self.group.names[1:]:
            shifted = ", ".join(f"{joint} {offset:+.4g}" for joint, offset in self.offsets(name).items())
            lines += [f"offsets of positions under {name}: {shifted}"] * bool(shifted)
        lines += [f"ambiguous: {sentence}" for sentence in self.ambiguous]
        return "\n".join(lines)


def _plain(images: dict[int, int]) -> dict[int, Image]:
    return {a: Image(b) for a, b in images.items()}
