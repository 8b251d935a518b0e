"""Rigid links of a MuJoCo model at one pose, and how a symmetry moves them onto each other.

A *link* is a body that moves on its own (it has a joint or is a mocap body) together with everything
welded to it; the world is a link too. Links rather than bodies are matched, so that it does not matter how
a modeller split a rigid part into bodies, or where the body frames are.

Matching at a single pose is enough: a kinematic tree is determined by its reference configuration and its
joint axes (the product of exponentials), so if masses, anchors and axes are mapped onto each other at one
pose that the symmetry keeps, the equations of motion are mapped onto each other everywhere.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from torch import Tensor

from torchrl_sym import checks

Array = NDArray[np.float64]
mj: Any = mujoco  # its compiled modules have no type stubs
MjModel: TypeAlias = Any
MjData: TypeAlias = Any

HINGE, SLIDE, BALL, FREE = (
    int(t)
    for t in (
        mj.mjtJoint.mjJNT_HINGE,
        mj.mjtJoint.mjJNT_SLIDE,
        mj.mjtJoint.mjJNT_BALL,
        mj.mjtJoint.mjJNT_FREE,
    )
)
_MISFIT = 1e3  # cost of a pair that cannot be the image of each other; far above any distance


@dataclass
class Link:
    """A rigid part at the reference pose; positions and axes in the world frame."""

    body: int
    parent: int
    bodies: list[int] = field(default_factory=list)
    joints: list[int] = field(default_factory=list)
    children: list[int] = field(default_factory=list)
    mass: float = 0.0
    com: Array = field(default_factory=lambda: np.zeros(3))
    inertia: Array = field(default_factory=lambda: np.zeros((3, 3)))


def name_of(model: MjModel, kind: str, index: int) -> str:
    """Name of an element, or its kind and number."""
    return getattr(model, kind)(index).name or f"{kind} {index}"


@functools.cache
def _numbers() -> list[str]:
    """Names of a model's arrays of real numbers."""
    model = mj.MjSpec().compile()
    fields = (name for name in dir(model) if not name.startswith("_"))
    values = {name: getattr(model, name) for name in fields}
    return [n for n, x in values.items() if isinstance(x, np.ndarray) and x.dtype.kind == "f"]


def check_model(model: MjModel) -> MjModel:
    """A compiled model with anything in it, all of whose numbers are finite.

    Raises:
        TypeError: a specification, a file name, data, ...
        ValueError: nothing but the world, or NaN or infinity in a field; the message names it.
    """
    remedy = "spec.compile(), MjModel.from_xml_path(path) or physics.model.ptr of dm_control give one"
    checks.instance("model", model, mj.MjModel, remedy)
    if model.nbody == 1 and not (model.ngeom or model.nsite):
        raise ValueError("model: expected bodies, got the empty world; is this the file of the robot?")
    for name in _numbers():
        if not np.isfinite(getattr(model, name)).all():
            raise ValueError(f"model: expected finite numbers, got NaN or infinity in {name}")
    return model


def check_mocap(model: MjModel, position: Any, rotation: Any) -> None:
    """ValueError unless these are tensors of poses of the model's mocap bodies."""
    for name, x, size in (("position", position, 3), ("rotation", rotation, 4)):
        if not isinstance(x, Tensor) or x.shape[-2:] != (model.nmocap, size):
            raise ValueError(
                f"{name}: expected a tensor (..., {model.nmocap}, {size}), got {checks.shown(x)}"
            )


def reference_pose(model: MjModel, keyframe: int | str | None) -> MjData:
    """Kinematics at the pose that the group is expected to keep: qpos0, or a keyframe.

    Raises:
        KeyError: no such keyframe; the message lists those there are.
    """
    data = mj.MjData(model)
    if keyframe is not None:
        mj.mj_resetDataKeyframe(model, data, _number_of(model, keyframe))
    mj.mj_kinematics(model, data)
    mj.mj_comPos(model, data)
    return data


def _number_of(model: MjModel, keyframe: int | str) -> int:
    names = [model.key(i).name or None for i in range(model.nkey)]
    try:
        return (
            names.index(keyframe)
            if isinstance(keyframe, str)
            else checks.whole("keyframe", keyframe, 0, model.nkey - 1)
        )
    except ValueError as error:
        raise KeyError(f"no keyframe {keyframe!r}; the model has {names or 'none'}") from error


def links_of(model: MjModel, data: MjData) -> dict[int, Link]:
    """Links by the number of the body that moves them, the world (0) first."""
    links: dict[int, Link] = {}
    for body in range(model.nbody):
        root = int(model.body_weldid[body])
        if root == body:
            parent = int(model.body_weldid[model.body_parentid[body]]) if body else -1
            start, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
            links[body] = Link(body, parent, joints=list(range(start, start + count)))
            if body:
                links[parent].children.append(body)
        links[root].bodies.append(body)
    for link in links.values():
        _lump(model, data, link)
    return links


def carried_bodies(model: MjModel, names: Sequence[str]) -> frozenset[int]:
    """Numbers of the bodies that are only carried along by a turn of the world.

    Raises:
        KeyError: no such body; the message lists those that qualify.
        ValueError: a body that is neither free nor mocap, or that moving bodies hang on.
    """
    kinds = model.jnt_type[model.body_jntadr] if model.njnt else np.full(model.nbody, -1)
    loose = ((model.body_jntnum > 0) & (kinds == FREE)) | (model.body_mocapid >= 0)
    known = {name_of(model, "body", b): b for b in range(model.nbody)}
    found = set()
    names = [names] if isinstance(names, str) else checks.sequence("carried", names)
    for name in names:
        if not isinstance(name, str) or name not in known:
            choice = [n for n, b in known.items() if loose[b]]
            raise KeyError(f"no body {name!r} to be carried; free and mocap bodies are {choice}")
        body = known[name]
        if not loose[body]:
            raise ValueError(
                f"{name!r} cannot be carried: it is neither a free body (one free joint) nor a mocap body; "
                "what hangs on a robot or is fixed is mapped with it"
            )
        below = np.flatnonzero((model.body_rootid == body) & (model.body_weldid != body))
        if len(below):
            raise ValueError(
                f"{name!r} cannot be carried: {name_of(model, 'body', int(below[0]))!r} moves on it, and "
                "only rigid bodies are carried along"
            )
        found.add(body)
    return frozenset(found)


def _lump(model: MjModel, data: MjData, link: Link) -> None:
    """Mass, centre of mass and inertia about it of all bodies of a link."""
    masses = model.body_mass[link.bodies]
    link.mass = float(masses.sum())
    centers = data.xipos[link.bodies]
    link.com = masses @ centers / link.mass if link.mass > 0 else data.xpos[link.body].copy()
    for body, mass, center in zip(link.bodies, masses, centers, strict=True):
        axes = data.ximat[body].reshape(3, 3)
        r = center - link.com
        link.inertia += axes @ np.diag(model.body_inertia[body]) @ axes.T
        link.inertia += mass * (r @ r * np.eye(3) - np.outer(r, r))


class Matcher:
    """Finds the image of every link and joint under one isometry.

    Args:
        model: the compiled model.
        data: kinematics at the reference pose.
        links: from :func:`links_of`.
        matrix: the isometry R, ``(3, 3)``; it acts about the origin of the world.
        lift: quaternion of R, or of -R for a reflection.
        carried: bodies that are only carried along, so that their frames turn with the world.

    Attributes:
        image: kinematics where images are looked for: the reference pose, carried bodies turned by R.
    """

    def __init__(
        self,
        model: MjModel,
        data: MjData,
        links: dict[int, Link],
        matrix: Array,
        lift: Array,
        carried: frozenset[int] = frozenset(),
    ) -> None:
        self.model, self.data, self.links = model, data, links
        self.matrix, self.lift, self.carried = matrix, lift, carried
        self.image = self._carry() if carried else data
        self.det = round(float(np.linalg.det(matrix)))
        self.extent = max(float(model.stat.extent), 1e-6)
        self.total_mass = max(sum(link.mass for link in links.values()), 1e-12)
        self.total_inertia = max(max(np.trace(link.inertia) for link in links.values()), 1e-12)
        self._pairs: dict[tuple[int, int], tuple[float, list[tuple[int, int]]]] = {}

    def _carry(self) -> MjData:
        model, data, image = self.model, self.data, mj.MjData(self.model)
        image.qpos[:], image.mocap_pos[:], image.mocap_quat[:] = data.qpos, data.mocap_pos, data.mocap_quat
        for body in self.carried:
            turned = np.zeros(4)
            mj.mju_mulQuat(turned, self.lift, data.xquat[body])
            mocap = int(model.body_mocapid[body])
            if mocap >= 0:
                image.mocap_pos[mocap], image.mocap_quat[mocap] = self.matrix @ data.xpos[body], turned
            else:
                start = int(model.jnt_qposadr[model.body_jntadr[body]])
                image.qpos[start : start + 3] = self.matrix @ data.xpos[body]
                image.qpos[start + 3 : start + 7] = turned
        mj.mj_kinematics(model, image)
        mj.mj_comPos(model, image)
        return image

    def links_to(self) -> dict[int, int]:
        """Image of every link, as a map of body numbers."""
        images: dict[int, int] = {}
        stack = [(0, 0)]
        while stack:
            a, b = stack.pop()
            images[a] = b
            stack += self._pair(a, b)[1]
        return images

    def joints_to(self, a: int, b: int) -> dict[int, int]:
        """Image among the joints of link b of every joint of link a; empty if their numbers differ."""
        mine, theirs = self.links[a].joints, self.links[b].joints
        if len(mine) != len(theirs) or not mine:
            return {}
        cost = np.array([[self.joint_cost(i, j) for j in theirs] for i in mine])
        rows, columns = linear_sum_assignment(cost)
        return {mine[r]: theirs[c] for r, c in zip(rows, columns, strict=True)}

    def joint_cost(self, i: int, j: int) -> float:
        """How far joint i's image is from joint j: type, axis up to sign, and anchor."""
        model, data = self.model, self.data
        kind = int(model.jnt_type[i])
        if kind != int(model.jnt_type[j]):
            return _MISFIT
        if kind == FREE:
            return 0.0
        offset = self.matrix @ data.xanchor[i] - data.xanchor[j]
        if kind == BALL:
            return float(np.linalg.norm(offset)) / self.extent
        axis = data.xaxis[j]
        misaligned = 1 - abs(float(self.matrix @ data.xaxis[i] @ axis))
        if kind == SLIDE:
            return misaligned  # a slide's anchor does not matter
        offset -= (offset @ axis) * axis  # a hinge's anchor may be anywhere on its axis
        return misaligned + float(np.linalg.norm(offset)) / self.extent

    def _pair(self, a: int, b: int) -> tuple[float, list[tuple[int, int]]]:
        if (a, b) not in self._pairs:  # not functools.cache, which does not pickle
            self._pairs[a, b] = self._pair_of_links(a, b)
        return self._pairs[a, b]

    def _pair_of_links(self, a: int, b: int) -> tuple[float, list[tuple[int, int]]]:
        """Cost of mapping subtree a onto subtree b, and the best pairs of children."""
        one, other = self.links[a], self.links[b]
        cost = float(np.linalg.norm(self.matrix @ one.com - other.com)) / self.extent
        cost += abs(one.mass - other.mass) / self.total_mass
        image = self.matrix @ one.inertia @ self.matrix.T
        cost += float(np.abs(image - other.inertia).max()) / self.total_inertia
        cost += 1e-9 * (a != b)  # links at one place stay where they are
        is_mocap = self.model.body_mocapid[[a, b]] >= 0
        cost += _MISFIT * bool(is_mocap[0] != is_mocap[1])
        joints = self.joints_to(a, b)
        if len(joints) != len(one.joints) or len(one.joints) != len(other.joints):
            cost += _MISFIT
        cost += sum(self.joint_cost(i, j) for i, j in joints.items())
        own = [(c, c) for c in one.children if c in self.carried and a == b]
        mine, theirs = ([c for c in link.children if c not in self.carried] for link in (one, other))
        if not mine or not theirs:
            return cost + _MISFIT * (len(mine) != len(theirs)), own
        table = np.array([[self._pair(c, d)[0] for d in theirs] for c in mine])
        rows, columns = linear_sum_assignment(table)
        cost += float(table[rows, columns].sum())
        cost += _MISFIT * abs(len(mine) - len(theirs))
        return cost, own + [(mine[r], theirs[c]) for r, c in zip(rows, columns, strict=True)]
