"""Orbit averages of where the parts of a robot are and how heavy, written back into its specification.

Everything is averaged in world axes at the reference pose and written back into the body frames. The
frames keep their rotation; a body's origin follows its first hinge or ball joint. An anchor moves across
its hinge's axis only, as its place along it is free. :mod:`torchrl_sym.mujoco.symmetrize` adds parameters
and shapes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeAlias

import numpy as np

from torchrl_sym import checks
from torchrl_sym.groups import PointGroup
from torchrl_sym.mujoco.coordinates import quaternion, rotation
from torchrl_sym.mujoco.derive import derive
from torchrl_sym.mujoco.links import BALL, FREE, HINGE, SLIDE, Array, links_of, mj, name_of, reference_pose

MjSpec: TypeAlias = Any
Maps: TypeAlias = list[dict[int, int]]  # image of every element, for each g

_UNCHANGED = 1e-12  # a relative change below this is rounding, and is not written


@dataclass(frozen=True)
class Change:
    """One quantity of one element: the largest change of an entry, absolute (SI units) and relative."""

    term: str
    name: str
    amount: float
    relative: float


@dataclass
class SymmetrizeReport:
    """What :func:`symmetrize` changed, and what it left alone.

    Attributes:
        changes: every change. Lengths are relative to the model's extent, inertias to their
            trace, angles to a radian, everything else to its own size.
        left: elements that were not averaged, with the reason.
    """

    changes: list[Change] = field(default_factory=list)
    left: list[str] = field(default_factory=list)

    @property
    def largest(self) -> Change | None:
        """The largest relative change, None if nothing changed."""
        return max(self.changes, key=lambda change: change.relative, default=None)

    def __str__(self) -> str:
        rows = [("changed", "elements", "largest", "relative", "at")]
        for term in dict.fromkeys(change.term for change in self.changes):
            of_term = [change for change in self.changes if change.term == term]
            worst = max(of_term, key=lambda change: change.relative)
            rows.append(
                (term, str(len(of_term)), f"{worst.amount:.2g}", f"{worst.relative:.2g}", worst.name)
            )
        widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
        lines = ["  ".join(f"{c:<{w}s}" for c, w in zip(row, widths, strict=True)).rstrip() for row in rows]
        head = lines if self.changes else ["nothing changed"]
        return "\n".join([*head, *(f"left alone: {what}" for what in self.left)])


class Averager:
    """Reads averages off the compiled model and writes them into a copy of its specification."""

    def __init__(
        self,
        spec: MjSpec,
        group: PointGroup,
        keyframe: int | str | None,
        tolerance: float,
        carried: Sequence[str],
    ) -> None:
        remedy = "a specification is what is changed: MjSpec.from_file(path)"
        self.spec = checks.instance("spec", spec, mj.MjSpec, remedy).copy()
        self.spec.compiler.fusestatic = False  # fused bodies have no specification to write to
        self.model = self.spec.compile()
        self.tolerance, self.keyframe, self.group = tolerance, keyframe, group
        symmetry = derive(self.model, group, keyframe, tolerance=tolerance, carried=carried)
        self.actions = symmetry._actions
        self.carried = self.actions[0].matcher.carried
        self.turns = group.matrices.numpy()
        self.data = reference_pose(self.model, keyframe)
        self.links = links_of(self.model, self.data)
        self.bodies: Maps = [
            {a: b for a, b in action.coordinates.bodies.items() if a not in self.carried}
            for action in self.actions
        ]
        self.rotation = self.data.xmat.reshape(-1, 3, 3)
        self.extent = max(float(self.model.stat.extent), 1e-6)
        names = sorted(name_of(self.model, "body", b) for b in self.carried)
        self.report = SymmetrizeReport(left=[f"body {name!r} is only carried along" for name in names])

    def _mean(self, maps: Maps, value: Callable[[int, int], Any]) -> dict[int, Array]:
        """Orbit averages of value(g, a), the image under g of element a's quantity."""
        sums: dict[int, Array] = {}
        for g, images in enumerate(maps):
            for a, b in images.items():
                sums[b] = sums.get(b, 0.0) + np.asarray(value(g, a), dtype=float) / len(maps)
        return sums

    def _closed(self, maps: Maps, kind: str) -> Maps:
        """The part of the maps on which the group acts; what has no image is noted in the report."""
        table = self.group.table
        owner = self.model.body_weldid[getattr(self.model, f"{kind}_bodyid")]
        own = {a for a, body in enumerate(owner) if int(body) in self.carried}
        everything = set().union(*maps) - own
        good = {
            a
            for a in everything
            if all(a in m and m[a] in n for m in maps for n in maps)
            and all(
                maps[g][maps[h][a]] == maps[int(table[g, h])][a]
                for g in range(len(maps))
                for h in range(len(maps))
            )
        }
        good = {a for a in good if all(m[a] in good for m in maps)}
        missing = sorted(set(range(len(owner))) - good - own)
        self.report.left += [f"{kind} {name_of(self.model, kind, a)!r} has no image" for a in missing]
        return [{a: m[a] for a in sorted(good)} for m in maps]

    def _points(self, maps: Maps, points: Array, owner: Callable[[int], int]) -> dict[int, Array]:
        """Averages of world points, taken relative to the origin of the tree that they belong to."""
        means = self._mean(maps, lambda g, a: self.turns[g] @ (points[a] - self.origin[owner(a)]))
        return {b: mean + self.origin[owner(b)] + self.shift[owner(b)] for b, mean in means.items()}

    def _write(
        self, element: Any, attribute: str, new: Any, old: Any, term: str, name: str, scale: float = 0.0
    ) -> bool:
        """Set an attribute if its compiled value changes; True if it did."""
        new, old = np.asarray(new, dtype=float), np.asarray(old, dtype=float)
        amount = float(np.abs(new - old).max(initial=0.0))
        scale = scale or float(max(np.abs(old).max(initial=0.0), np.abs(new).max(initial=0.0))) or 1.0
        if amount <= _UNCHANGED * scale:
            return False
        self.report.changes.append(Change(term, name, amount, amount / scale))
        if attribute:
            setattr(element, attribute, new.tolist())
        return True

    # --- places

    def _place_trees(self) -> None:
        """Free and mocap bodies carry a tree: centre it if it is nearly centred, else leave it in place."""
        model, data = self.model, self.data
        self.origin = {b: np.zeros(3) for b in self.links}
        self.shift = {b: np.zeros(3) for b in self.links}
        means = self._mean(self.bodies, lambda g, a: self.turns[g] @ data.xpos[a])
        for b, link in self.links.items():
            free = bool(link.joints) and int(model.jnt_type[link.joints[0]]) == FREE
            mocap = model.body_mocapid[b] >= 0
            if free or mocap:
                self.origin[b] = data.xpos[b].copy()
                moved = means.get(b, data.xpos[b]) - data.xpos[b]
                if np.linalg.norm(moved) <= self.tolerance * self.extent and self.keyframe is None:
                    self.shift[b] = moved
            elif b:
                self.origin[b], self.shift[b] = self.origin[link.parent], self.shift[link.parent]

    def _place_joints(self) -> None:
        model, data = self.model, self.data
        maps = [action.coordinates.joints for action in self.actions]
        owner = [int(b) for b in model.jnt_bodyid]
        anchors = self._points(maps, data.xanchor, lambda j: owner[j])
        axes = {}
        for b in range(model.njnt):
            turned = [self.turns[g] @ data.xaxis[a] for g, m in enumerate(maps) for a in m if m[a] == b]
            total = sum(axis * np.sign(axis @ data.xaxis[b]) for axis in turned)
            axes[b] = total / np.linalg.norm(total)
            if int(model.jnt_type[b]) == HINGE:
                along = axes[b] @ (anchors[b] - data.xanchor[b] - self.shift[owner[b]])
                anchors[b] = anchors[b] - along * axes[b]
        self.moved = dict(self.shift)  # displacement of the frame of every link
        for body, link in self.links.items():
            turning = [j for j in link.joints if int(model.jnt_type[j]) in (HINGE, BALL)]
            if turning:
                self.moved[body] = anchors[turning[0]] - data.xanchor[turning[0]]
        for body, link in self.links.items():
            if body and body not in self.carried:
                self._write_body(body, link.joints, anchors, axes)

    def _write_body(self, body: int, joints: list[int], anchors: dict, axes: dict) -> None:
        """Undo the joints one by one, from the new world pose to the pose in the parent's frame."""
        model, data = self.model, self.data
        turn, place = self.rotation[body], data.xpos[body] + self.moved[body]
        name = name_of(model, "body", body)
        for j in reversed(joints):
            kind, joint = int(model.jnt_type[j]), self.spec.joints[j]
            if kind == FREE:
                break
            label = name_of(model, "joint", j)
            axis, at = turn.T @ axes[j], turn.T @ (anchors[j] - place)
            angle = float(data.qpos[model.jnt_qposadr[j]] - model.qpos0[model.jnt_qposadr[j]])
            if kind != SLIDE:
                at = self._local(joint, at, model.jnt_pos[j], "joint anchor", label)
            if kind != BALL:
                inner = _frame(joint)[1].T
                self._write(
                    joint, "axis", inner @ axis, inner @ model.jnt_axis[j], "joint axis", label, 1.0
                )
            if kind == SLIDE:
                place = place - angle * axes[j]
                continue
            q = np.zeros(4)
            mj.mju_axisAngle2Quat(q, axis, angle)
            if kind == BALL:
                start = int(model.jnt_qposadr[j])
                q = data.qpos[start : start + 4] / np.linalg.norm(data.qpos[start : start + 4])
            turn = turn @ rotation(q).T
            place = anchors[j] - turn @ at
        parent = int(model.body_parentid[body])
        base = data.xpos[parent] + self.moved[int(model.body_weldid[parent])]
        outer = self.rotation[parent]
        self._pose(self.spec.bodies[body], outer.T @ (place - base), outer.T @ turn, "body", name)

    def _local(self, element: Any, new: Array, old: Array, term: str, name: str) -> Array:
        """Write a position given in the body's frame; returns the one that holds now."""
        place, inner = _frame(element)
        new_inner, old_inner = inner.T @ (new - place), inner.T @ (old - place)
        if self._write(element, "pos", new_inner, old_inner, term, name, self.extent):
            return new
        return old

    def _pose(self, element: Any, place: Array, turn: Array, kind: str, name: str) -> None:
        """Write a pose given in the frame of the body that an element is in."""
        index = element.id
        self._local(element, place, getattr(self.model, f"{kind}_pos")[index], f"{kind} position", name)
        old = rotation(getattr(self.model, f"{kind}_quat")[index])
        if self._write(element, "", turn, old, f"{kind} rotation", name, 1.0):
            element.alt.type = mj.mjtOrientation.mjORIENTATION_QUAT
            element.quat = quaternion(_frame(element)[1].T @ turn)

    def _settle(self, element: Any, kind: str) -> None:
        """Write an element's compiled pose in full, however it was specified."""
        place, turn = _frame(element)
        pos, quat = (getattr(self.model, f"{kind}_{what}")[element.id] for what in ("pos", "quat"))
        element.alt.type = mj.mjtOrientation.mjORIENTATION_QUAT
        element.pos = (turn.T @ (pos - place)).tolist()
        element.quat = quaternion(turn.T @ rotation(quat)).tolist()

    def _in_body(self, body: int, place: Array) -> Array:
        """A world position in the frame of a body, where that ends up."""
        origin = self.data.xpos[body] + self.moved[int(self.model.body_weldid[body])]
        return self.rotation[body].T @ (place - origin)

    # --- inertials

    def _inertials(self) -> None:
        model, turns, links = self.model, self.turns, self.links
        masses = self._mean(self.bodies, lambda _, a: links[a].mass)
        coms = np.array([links[b].com if b in links else np.zeros(3) for b in range(model.nbody)])
        centers = self._points(self.bodies, coms, int)
        inertias = self._mean(self.bodies, lambda g, a: turns[g] @ links[a].inertia @ turns[g].T)
        for b in range(1, model.nbody):  # what the compiler found, as it shall not look at the geoms again
            found = (getattr(model, f"body_{name}")[b] for name in ("mass", "ipos", "iquat", "inertia"))
            _set_inertial(self.spec.bodies[b], *found)
        compiler = self.spec.compiler
        compiler.inertiafromgeom = mj.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
        compiler.boundmass = compiler.boundinertia = 0.0
        if getattr(compiler, "settotalmass", -1.0) > 0:  # deprecated since MuJoCo 3.17
            compiler.settotalmass = -1.0
        compiler.balanceinertia = False
        for b in self.links.keys() - {0} - self.carried:
            link, name, turn = links[b], name_of(model, "body", b), self.rotation[b]
            if not masses[b] > 0:
                continue
            # the centre may have stayed in the world while the frame moved, which is no change of the robot
            new, size = self._in_body(b, centers[b]), float(np.trace(link.inertia)) or 1.0
            old = turn.T @ (link.com - self.data.xpos[b])
            changed = [
                self._write(None, "", masses[b], link.mass, "mass", name),
                self._write(None, "", new, old, "centre of mass", name, self.extent),
                self._write(None, "", inertias[b], link.inertia, "inertia", name, size),
            ]
            if any(changed):
                moments, axes = np.linalg.eigh(turn.T @ inertias[b] @ turn)
                axes[:, 0] *= np.linalg.det(axes)
                _set_inertial(self.spec.bodies[b], float(masses[b]), new, quaternion(axes), moments)
                for welded in set(link.bodies) - {b}:
                    _set_inertial(self.spec.bodies[welded], 0.0, np.zeros(3), np.eye(4)[0], np.zeros(3))


def _set_inertial(body: Any, mass: float, place: Array, turn: Array, moments: Array) -> None:
    body.explicitinertial, body.mass = True, float(mass)
    body.ipos, body.iquat, body.inertia = place.tolist(), turn.tolist(), moments.tolist()
    body.ialt.type = mj.mjtOrientation.mjORIENTATION_QUAT
    body.fullinertia = [np.nan] * 6


def _frame(element: Any) -> tuple[Array, Array]:
    """Position and rotation of the MJCF frames around an element, in its body."""
    place, turn, frame = np.zeros(3), np.eye(3), element.frame
    while frame is not None:
        resolved = frame.quat
        if frame.alt.type != mj.mjtOrientation.mjORIENTATION_QUAT:
            order = frame.compiler.eulerseq
            resolved = mj.MjSpec.resolve_orientation(
                degree=frame.compiler.degree, sequence=order, orientation=frame.alt
            )
        outer = rotation(np.array(resolved) / np.linalg.norm(resolved))
        place, turn, frame = np.array(frame.pos) + outer @ place, outer @ turn, frame.frame
    return place, turn
