"""Orbit averages of what a model says of its parts, written back into its specification.

Everything is averaged in world axes at the reference pose, about the axis of the group, and written back
into the body frames. The frames keep their rotation; a body's origin follows its first hinge or ball joint.
Free and mocap bodies stay where they stand, which is a state.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import numpy as np

from torchrl_sym import checks
from torchrl_sym.groups import PointGroup
from torchrl_sym.mujoco.derive.derive import derive
from torchrl_sym.mujoco.derive.images import SymmetryError
from torchrl_sym.mujoco.model.links import is_loose
from torchrl_sym.mujoco.model.releases import weld_ids
from torchrl_sym.mujoco.model.rotations import quaternion, rotation
from torchrl_sym.mujoco.model.types import Array, label_of, mj, name_of
from torchrl_sym.mujoco.symmetrize.report import Change, SymmetrizeReport

MjSpec: TypeAlias = Any
Maps: TypeAlias = list[dict[int, int]]  # image of every element, for each g
_UNCHANGED = 1e-12  # a relative change below this is rounding, and is not written


class Averager:
    """Reads averages off the compiled model and writes them into a copy of its specification."""

    def __init__(
        self,
        spec: MjSpec,
        group: PointGroup,
        keyframe: int | str | None,
        tolerance: float,
        carried: Sequence[str],
        axis: tuple[float, float] | None,
    ) -> None:
        remedy = "a specification is what is changed: MjSpec.from_file(path)"
        self.spec = checks.instance("spec", spec, mj.MjSpec, remedy).copy()
        self.spec.compiler.fusestatic = False  # fused bodies have no specification to write to
        self.model = self.spec.compile()
        self.tolerance, self.group = tolerance, group
        symmetry = derive(self.model, group, keyframe, tolerance=tolerance, carried=carried, axis=axis)
        self.actions = symmetry.actions
        self.carried = self.actions[0].matcher.carried
        self.turns = group.matrices.numpy()
        for body, gap in (item for action in self.actions for item in action.coordinates.astray.items()):
            name = label_of(self.model, "body", body)
            raise SymmetryError(
                f"the frame of {name} is {500 * gap:.3g} mm beside where the body is symmetric, and frames "
                "are not moved; set the body's pos onto the plane or axis of symmetry"
            )
        matcher = self.actions[0].matcher
        self.data, self.links = matcher.data, matcher.links
        self.lumps = matcher.skeleton.lumps(self.data)
        self.bodies: Maps = [
            {a: b for a, b in action.coordinates.bodies.items() if a not in self.carried}
            for action in self.actions
        ]
        self.rotation = self.data.xmat.reshape(-1, 3, 3)
        self.extent = matcher.extent
        names = sorted(name_of(self.model, "body", b) for b in self.carried)
        # of every link: the point that its tree is averaged about, and how far its frame is moved
        self.origin = {b: self._origin(b) for b in self.links}
        self.moved = {b: np.zeros(3) for b in self.links}
        self.report = SymmetrizeReport(left=[f"body {name!r} is only carried along" for name in names])

    def _origin(self, link: int) -> Array:
        """Loose trees are averaged about their frame, wherever that is; others about the axis."""
        tree = self.links[link].tree
        return self.data.xpos[tree].copy() if tree and is_loose(self.model, tree) else np.zeros(3)

    def mean(self, maps: Maps, value: Callable[[int, int], Any]) -> dict[int, Array]:
        """Orbit averages of value(g, a), the image under g of element a's quantity."""
        sums: dict[int, Array] = {}
        for g, images in enumerate(maps):
            for a, b in images.items():
                sums[b] = sums.get(b, 0.0) + np.asarray(value(g, a), dtype=float) / len(maps)
        return sums

    def closed(self, maps: Maps, kind: str) -> Maps:
        """The part of the maps on which the group acts; what has no image is noted in the report."""
        table = self.group.table
        owner = weld_ids(self.model)[getattr(self.model, f"{kind}_bodyid")]
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

    def points(self, maps: Maps, points: Array, owner: Callable[[int], int]) -> dict[int, Array]:
        """Averages of world points, taken relative to the origin of the tree that they belong to."""
        means = self.mean(maps, lambda g, a: self.turns[g] @ (points[a] - self.origin[owner(a)]))
        return {b: mean + self.origin[owner(b)] for b, mean in means.items()}

    def write(
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

    def local(self, element: Any, new: Array, old: Array, term: str, name: str) -> Array:
        """Write a position given in the body's frame; returns the one that holds now."""
        place, inner = frame_of(element)
        new_inner, old_inner = inner.T @ (new - place), inner.T @ (old - place)
        if self.write(element, "pos", new_inner, old_inner, term, name, self.extent):
            return new
        return old

    def pose(self, element: Any, place: Array, turn: Array, kind: str, name: str) -> None:
        """Write a pose given in the frame of the body that an element is in."""
        index = element.id
        self.local(element, place, getattr(self.model, f"{kind}_pos")[index], f"{kind} position", name)
        old = rotation(getattr(self.model, f"{kind}_quat")[index])
        if self.write(element, "", turn, old, f"{kind} rotation", name, 1.0):
            element.alt.type = mj.mjtOrientation.mjORIENTATION_QUAT
            element.quat = quaternion(frame_of(element)[1].T @ turn)

    def settle(self, element: Any, kind: str) -> None:
        """Write an element's compiled pose in full, however it was specified."""
        place, turn = frame_of(element)
        pos, quat = (getattr(self.model, f"{kind}_{what}")[element.id] for what in ("pos", "quat"))
        element.alt.type = mj.mjtOrientation.mjORIENTATION_QUAT
        element.pos = (turn.T @ (pos - place)).tolist()
        element.quat = quaternion(turn.T @ rotation(quat)).tolist()

    def in_body(self, body: int, place: Array) -> Array:
        """A world position in the frame of a body, where that ends up."""
        origin = self.data.xpos[body] + self.moved[int(weld_ids(self.model)[body])]
        return self.rotation[body].T @ (place - origin)


def frame_of(element: Any) -> tuple[Array, Array]:
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
