"""mjlab: the symmetry of an environment, read off its model and the terms of its observations.

mjlab's environments are MuJoCo models, whose symmetry :func:`~torchrl_sym.mujoco.derive` finds; and their
observations are terms, most of which are mjlab's own functions: joints, base velocities, the last action,
the command, height scans, foot contacts. What such a function gives transforms as the model says, by the
names of the joints, sensors, sites and bodies that its settings have. So nothing is left to be declared but
terms of one's own; and what no matrix can map is refused.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from tensordict import NestedKey
from torch import Tensor

from torchrl_sym import checks
from torchrl_sym.bridges.frames import frame_maps, places, rays, refuse_turned_yaw
from torchrl_sym.bridges.terms import (
    Term,
    assemble,
    check_processing,
    given_terms,
    observation_manager,
    terms_of,
)
from torchrl_sym.entries import Exchanged
from torchrl_sym.groups import PointGroup, check_group
from torchrl_sym.mujoco import ModelSymmetry, derive
from torchrl_sym.representations import Representation, items
from torchrl_sym.symmetry import Symmetry

_TOLERANCE = 1e-5  # radians, of default poses; mjlab keeps them in single precision


def symmetry(
    env: Any,
    group: PointGroup,
    *,
    terms: Mapping[str | tuple[str, str], Representation] | None = None,
    action: Representation | None = None,
    others: Mapping[NestedKey | Exchanged, Representation] | None = None,
    keyframe: int | str | None = None,
) -> Symmetry:
    """The symmetry of an mjlab environment: its groups of observations by their names, and ``"action"``.

    Args:
        env: the ``ManagerBasedRlEnv``, or a wrapper of it.
        group: the group to try.
        terms: how one frame of some terms transforms, by name or by ``(group, name)``: for functions of
            your own, and instead of what is read off the model. Others need not be given.
        action: how the action transforms. Defaults to what its terms say, if they act on joints.
        others: entries that the observation manager does not write, such as ``"pixels"``.
        keyframe: a pose that the group keeps, as for :func:`~torchrl_sym.mujoco.derive`.

    Raises:
        SymmetryError: the model does not have the group's symmetry.
        TypeError: no such environment, no group, or no representations.
        KeyError: terms that are not known, or have no image; all are listed, each with the reason.
        ValueError: a term has another size, or is clipped or scaled such that it does not transform.

    Example:
        >>> from mjlab.envs import ManagerBasedRlEnv  # doctest: +SKIP
        >>> from mjlab.tasks.registry import load_env_cfg  # doctest: +SKIP
        >>> env = ManagerBasedRlEnv(load_env_cfg("Mjlab-Velocity-Flat-Unitree-G1"), "cpu")  # doctest: +SKIP
        >>> symmetry(env, PointGroup.reflection("y")).keys()  # doctest: +SKIP
        ['actor', 'critic', 'action']
    """
    check_group(group)
    manager = observation_manager(env)
    base = env if hasattr(env, "sim") else getattr(env, "unwrapped", env)
    if not hasattr(getattr(base, "sim", None), "mj_model"):
        raise TypeError(
            f"env: expected an environment of mjlab, with a compiled model, got {checks.shown(env)}"
        )
    found = terms_of(manager)
    given = given_terms(found, terms or {})
    reader = _Reader(base, derive(base.sim.mj_model, group, keyframe))
    acts = checks.instance("action", reader.action() if action is None else action, Representation)
    reader.last_action = acts

    unknown: dict[str, str] = {}
    representations: dict[Term, Representation] = {}
    for term in found:
        try:
            representations[term] = given[term] if term in given else reader.term(term)
        except (KeyError, ValueError) as error:
            unknown[term.label] = str(error.args[0])
    if unknown:
        reasons = "\n".join(f"  {label}: {reason}" for label, reason in unknown.items())
        raise KeyError(
            f"expected terms that transform, got {len(unknown)} that do not, or are not known:\n{reasons}\n"
            "give their representations by name, terms={'height': scalar(group), ...}, drop them from the "
            "observation, or use a smaller group"
        )
    return assemble(manager, representations, acts, others)


class _Reader:
    """Reads off a model how what mjlab's functions give transforms.

    Attributes:
        last_action: how the whole action transforms, once it is known.
    """

    last_action: Representation

    def __init__(self, env: Any, robot: ModelSymmetry) -> None:
        self.env = env
        self.robot = robot
        self.group = robot.group
        self.known: dict[str, Callable[..., Representation]] = {
            "base_lin_vel": self._polar,
            "base_ang_vel": self._axial,
            "projected_gravity": self._polar,
            "projected_gravity_from_sensor": self._sensor,
            "builtin_sensor": self._sensor,
            "joint_pos_rel": self._joint_positions,
            "joint_vel_rel": self._joint_velocities,
            "last_action": self._last_action,
            "generated_commands": self._command,
            "height_scan": self._scan,
            "foot_height": self._foot_heights,
            "foot_air_time": self._contacts,
            "foot_contact": self._contacts,
            "foot_contact_forces": self._contact_forces,
        }

    def term(self, term: Term) -> Representation:
        """How one frame of a term transforms."""
        function = term.cfg.func
        name = getattr(function, "__name__", type(function).__name__)
        module = getattr(function, "__module__", None) or type(function).__module__
        if name not in self.known or module.split(".")[0] != "mjlab":
            raise ValueError(f"{module}.{name} is not known")
        return self.known[name](**term.cfg.params)

    def action(self) -> Representation:
        """How the action transforms: all its terms, one after the other."""
        manager = self.env.action_manager
        parts = [self._action(name, manager.get_term(name)) for name in manager.active_terms]
        return sum(parts[1:], start=parts[0])

    def _action(self, name: str, term: Any) -> Representation:
        kind = getattr(getattr(term.cfg, "transmission_type", None), "name", None)
        if kind != "JOINT":
            raise ValueError(
                f"action {name!r}: expected one that acts on joints, got {type(term).__name__}; give its "
                "representation, action=..."
            )
        joints = self._joints(term.cfg.entity_name, term.target_names)
        steps = [("scale", lambda x: x * _row(term.scale)), ("offset", lambda x: x + _row(term.offset))]
        if term.cfg.clip is not None:
            low, high = _row(term._clip).unbind(-1)
            steps.append(("clip", lambda x: x.clip(low, high)))
        offset = type(term).__name__ == "JointPositionAction" and term.cfg.use_default_offset
        check_processing(f"action {name!r}", joints, iter(steps[:1] + steps[2:] if offset else steps))
        if offset:  # the default pose, which need not be zero
            self._refuse_moved(term.cfg.entity_name, term.target_names, _row(term.offset), joints)
        return joints

    def _joints(self, entity: str, names: Sequence[str]) -> Representation:
        return self.robot.joints([f"{entity}/{name}" for name in names])

    def _refuse_moved(
        self, entity: str, names: Sequence[str], default: Tensor, joints: Representation
    ) -> None:
        """ValueError if the pose that positions are relative to is not its own image."""
        for g, element in enumerate(self.group.names):
            offsets, table = self.robot.offsets(g), self.robot.table("joint", g)
            landing = {table[source].removeprefix("-"): offset for source, offset in offsets.items()}
            added = torch.tensor([landing.get(f"{entity}/{name}", 0.0) for name in names]).double()
            wrong = (joints(default, g) + added - default).abs()
            if wrong.max() > _TOLERANCE:
                worst = names[int(wrong.argmax())]
                raise ValueError(
                    f"the default pose is not its own image under {element!r}: {worst} is off by "
                    f"{float(wrong.max()):.3g}; make the entity's init_state symmetric"
                )

    def _selected(self, asset_cfg: Any) -> tuple[str, list[str], Any]:
        entity = self.env.scene["robot" if asset_cfg is None else asset_cfg.name]
        ids = slice(None) if asset_cfg is None else asset_cfg.joint_ids
        names = list(entity.joint_names)
        return (
            "robot" if asset_cfg is None else asset_cfg.name,
            names[ids] if isinstance(ids, slice) else [names[int(i)] for i in ids],
            entity.data,
        )

    def _joint_positions(self, asset_cfg: Any = None, biased: bool = False) -> Representation:
        entity, names, data = self._selected(asset_cfg)
        joints = self._joints(entity, names)
        everything = list(self.env.scene[entity].joint_names)
        default = _row(data.default_joint_pos)[[everything.index(name) for name in names]]
        self._refuse_moved(entity, names, default, joints)
        return joints

    def _joint_velocities(self, asset_cfg: Any = None) -> Representation:
        entity, names, _ = self._selected(asset_cfg)
        return self._joints(entity, names)

    def _last_action(self, action_name: str | None = None) -> Representation:
        if action_name is None:
            return self.last_action
        return self._action(action_name, self.env.action_manager.get_term(action_name))

    def _root(self, asset_cfg: Any) -> Tensor:
        """How vectors in the frame of an entity's root transform, ``(N, 3, 3)``."""
        entity = self.env.scene["robot" if asset_cfg is None else asset_cfg.name]
        name = self.robot.model.body(entity.indexing.root_body_id).name
        places(self.robot, [name], self._tables("body"))
        return frame_maps(self.robot, "body", [name])[:, 0]

    def _tables(self, kind: str) -> list[dict[str, str]]:
        return [self.robot.table(kind, g) for g in range(self.group.order)]  # pyright: ignore[reportArgumentType]

    def _polar(self, asset_cfg: Any = None) -> Representation:
        return Representation(self.group, self._root(asset_cfg))

    def _axial(self, asset_cfg: Any = None) -> Representation:
        return Representation(self.group, self.group.det[:, None, None] * self._root(asset_cfg))

    def _sensor(self, sensor_name: str) -> Representation:
        return self.robot.sensors([sensor_name])

    def _command(self, command_name: str) -> Representation:
        command = self.env.command_manager.get_term(command_name)
        if type(command).__name__ != "UniformVelocityCommand":
            raise ValueError(f"the command {type(command).__name__} is not known")
        frame = self._root(_Entity(command.cfg.entity_name))
        if (frame[:, 2, 2] - 1).abs().max() > _TOLERANCE:
            raise ValueError(
                "the robot's base does not have its z axis upwards, so that (vx, vy) has no image"
            )
        turn = self.group.det[:, None, None]  # of the velocity about the vertical axis
        return Representation(self.group, frame[:, :2, :2]) + Representation(self.group, turn)

    def _scan(
        self, sensor_name: str, offset: float = 0.0, miss_value: float | None = None
    ) -> Representation:
        del offset, miss_value  # the same for all rays
        return self._rays(self.env.scene[sensor_name])[1]

    def _foot_heights(self, sensor_name: str) -> Representation:
        sensor = self.env.scene[sensor_name]
        frames, whole = self._rays(sensor)
        if sensor.cfg.reduction == "none":
            return whole.unflatten((frames.dim, whole.dim // frames.dim))
        return frames

    def _rays(self, sensor: Any) -> tuple[Representation, Representation]:
        """How the frames of a ray-cast sensor change places, and how all its rays do."""
        objects = sensor.cfg.frame if isinstance(sensor.cfg.frame, tuple) else (sensor.cfg.frame,)
        kinds = {each.type for each in objects}
        if len(kinds) > 1 or not kinds <= {"body", "site"}:
            raise ValueError(f"expected a sensor on bodies or on sites, got one on {sorted(kinds)}")
        (kind,) = kinds
        names = [f"{each.entity}/{each.name}" if each.entity else each.name for each in objects]
        frames = places(self.robot, names, self._tables(kind))
        if sensor.cfg.ray_alignment == "yaw":
            refuse_turned_yaw(self.robot, kind, names)
        maps = frame_maps(self.robot, kind, names, sensor.cfg.ray_alignment)
        pattern = sensor.cfg.pattern.generate_rays(self.robot.model, "cpu")
        return frames, rays(frames, maps, *pattern)

    def _contacts(self, sensor_name: str) -> Representation:
        """How the bodies that a contact sensor watches change places."""
        sensor = self.env.scene[sensor_name]
        match, model = sensor.cfg.primary, self.robot.model
        if sensor.cfg.num_slots > 1 and sensor.cfg.reduce != "netforce":
            raise ValueError("the order of several contacts of one body is the solver's")
        names = [f"{match.entity}/{name}" if match.entity else name for name in sensor.primary_names]
        if match.mode == "geom":
            names = [model.body(int(model.geom(name).bodyid[0])).name for name in names]
        if len(set(names)) < len(names):
            raise ValueError(f"several geoms of one body are watched: {list(sensor.primary_names)}")
        return places(self.robot, names, self._tables("body"))

    def _contact_forces(self, sensor_name: str) -> Representation:
        """Forces in the world's frame, of which mjlab takes a logarithm, component by component."""
        sensor = self.env.scene[sensor_name]
        if sensor.cfg.reduce != "netforce" and not sensor.cfg.global_frame:
            raise ValueError("forces in the frame of a contact have no image; use reduce='netforce'")
        forces = items(self._contacts(sensor_name), Representation(self.group, self.group.matrices))
        steps = [("logarithm", lambda x: x.sign() * x.abs().log1p())]
        check_processing(f"sensor {sensor_name!r}", forces, iter(steps))
        return forces.flatten()


class _Entity:
    """What stands for settings that name an entity and nothing else."""

    def __init__(self, name: str) -> None:
        self.name = name


def _row(value: Any) -> Tensor:
    """The values of the first environment, in double precision, of numbers or of those of all of them."""
    tensor = torch.as_tensor(value, dtype=torch.float64, device="cpu")
    return tensor[0] if tensor.ndim else tensor
