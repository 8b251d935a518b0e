"""Make a nearly symmetric MuJoCo model exactly symmetric, by averaging over the group.

Robots are meant to be symmetric, but their models come from weighing and from drawings with cables in them:
a hip's centre of mass is 0.1 mm off, a battery sits to the left. If sigma_g(a) is the image of element a
under the group element g, and rho_g says how g moves a quantity x (a mass stays, a position becomes R_g x,
an inertia R_g x R_g^T, a joint's range is flipped by its sign and shifted by its offset), then the average

    x'_b = 1/|G| sum over g of rho_g(x_a),   with b = sigma_g(a),

is kept by every element, and equals x if x was kept already.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

import numpy as np
from scipy.optimize import linear_sum_assignment

from torchrl_sym.groups import PointGroup
from torchrl_sym.mujoco.averages import Averager, Maps, MjSpec, SymmetrizeReport
from torchrl_sym.mujoco.links import HINGE, Array, mj, name_of

Move: TypeAlias = Callable[[int, int], tuple[float, float]]  # sign and offset

_GEOM = mj.mjtGeom
_ROUND = (int(_GEOM.mjGEOM_CAPSULE), int(_GEOM.mjGEOM_CYLINDER))
_SPHERE, _PLANE = int(_GEOM.mjGEOM_SPHERE), int(_GEOM.mjGEOM_PLANE)
_SQUARE = (int(_GEOM.mjGEOM_BOX), int(_GEOM.mjGEOM_ELLIPSOID))
_PRIMITIVE = (_SPHERE, *_ROUND, *_SQUARE)
_SAME = ("type", "contype", "conaffinity", "condim")
_SCALAR = tuple(
    int(t) for t in (mj.mjtTrn.mjTRN_JOINT, mj.mjtTrn.mjTRN_JOINTINPARENT, mj.mjtTrn.mjTRN_TENDON)
)
_GEOM_FIELDS = ("friction", "solref", "solimp", "solmix", "margin", "gap")
_JOINT_FIELDS = {"margin": "jnt_margin", "solref_limit": "jnt_solref", "solimp_limit": "jnt_solimp"}
_DOF_FIELDS = {
    "armature": "dof_armature",
    "frictionloss": "dof_frictionloss",
    "solref_friction": "dof_solref",
    "solimp_friction": "dof_solimp",
}


def symmetrize(
    spec: MjSpec,
    group: PointGroup,
    keyframe: int | str | None = None,
    *,
    tolerance: float = 1e-2,
    carried: Sequence[str] = (),
) -> MjSpec:
    """A copy of a model that is exactly symmetric; see :func:`symmetrize_with_report`.

    Example:
        >>> import mujoco
        >>> from torchrl_sym import PointGroup
        >>> spec = mujoco.MjSpec.from_string('''<mujoco><worldbody>
        ...   <body name="left" pos="0 .1 0"><joint axis="1 0 0"/><geom size=".1" mass="1.1"/></body>
        ...   <body name="right" pos="0 -.1 0"><joint axis="1 0 0"/><geom size=".1" mass="0.9"/></body>
        ... </worldbody></mujoco>''')
        >>> symmetrize(spec, PointGroup.reflection("y")).compile().body("left").mass.item()
        1.0
    """
    return symmetrize_with_report(spec, group, keyframe, tolerance=tolerance, carried=carried)[0]


def symmetrize_with_report(
    spec: MjSpec,
    group: PointGroup,
    keyframe: int | str | None = None,
    *,
    tolerance: float = 1e-2,
    carried: Sequence[str] = (),
) -> tuple[MjSpec, SymmetrizeReport]:
    """A copy of a model that is exactly symmetric, and what was changed for it.

    Averaged are masses, centres of mass and inertias; joint anchors, axes, ranges, springs, damping,
    armature and friction losses; gains, biases and ranges of actuators; the places of sites; and the
    places, sizes and contact parameters of spheres, capsules, cylinders, boxes and ellipsoids. Not
    averaged, and listed if the model has any: meshes and other shapes, tendons, equality constraints and
    contact pairs. Bodies and sites keep their rotation. A link of several welded bodies whose inertia
    changes gets it on the body that moves, and the others become massless.

    Compile the result where exactness matters: ``to_xml`` rounds numbers, and a model read back from it is
    symmetric to about five digits.

    Args:
        spec: the model; it is not modified.
        group: the group that the model nearly has, about the vertical through the world's origin.
        keyframe: a pose that the group keeps, by name or number. Defaults to ``qpos0``.
        tolerance: how far joints, sites and geoms may be from their image's, as in
            :func:`~torchrl_sym.mujoco.derive`.
        carried: names of bodies that a turn of the world only carries along, as in
            :func:`~torchrl_sym.mujoco.derive`. They need no symmetry and are left as they are.

    Raises:
        SymmetryError: a joint or actuator has no image, or a body cannot be carried by an element; the
            message names it.
        KeyError: no such keyframe, or no such body to be carried.
    """
    return _Averager(spec, group, keyframe, tolerance, carried).run()


class _Averager(Averager):
    """Adds parameters, sites and geoms."""

    def run(self) -> tuple[MjSpec, SymmetrizeReport]:
        """Places first: everything on a body is written relative to where the body ends up."""
        self._place_trees()
        self._place_joints()
        self._inertials()
        self._joint_parameters()
        self._actuators()
        self._sites()
        self._geoms()
        model = self.model
        others = int((~np.isin(model.geom_type, (*_PRIMITIVE, _PLANE))).sum())
        counts = {"meshes and other shapes": others, "tendons": model.ntendon}
        counts |= {"equality constraints": model.neq, "contact pairs": model.npair}
        self.report.left += [f"{n} {what}" for what, n in counts.items() if n]
        return self.spec, self.report

    # --- parameters

    def _unsigned(self, maps: Maps, kind: str, fields: dict[str, Array]) -> None:
        """Average parameters that move with their element without a sign."""
        for name, values in fields.items():
            for b, mean in self._mean(maps, lambda _, a, v=values: v[a]).items():
                element = getattr(self.spec, f"{kind}s")[b]
                many = np.ndim(getattr(element, name)) > 0 or np.ndim(mean) == 0
                new, old = (mean, values[b]) if many else (mean[0], values[b][0])
                written = self._write(
                    element, name, new, old, f"{kind} {name}", name_of(self.model, kind, b)
                )
                if written and name in ("damping", "stiffness") and kind == "joint":
                    element.springdamper = [0.0, 0.0]

    def _signed(
        self, maps: Maps, kind: str, attribute: str, values: Array, limited: Any, move: Move
    ) -> None:
        """Average intervals (or numbers) that move(g, a) flips by a sign and shifts by an offset."""

        def image(g: int, a: int) -> Array:
            sign, offset = move(g, a)
            return np.sort(sign * values[a] + offset)

        for b, mean in self._mean(maps, image).items():
            element, name = getattr(self.spec, f"{kind}s")[b], name_of(self.model, kind, b)
            on = {bool(limited[m[b]]) for m in maps} if limited is not None else {True}
            if len(on) > 1:
                self.report.left.append(f"{attribute} of {kind} {name!r}: not limited for all its images")
            angle = kind == "joint" and self.model.jnt_type[b] == HINGE and attribute != "actfrcrange"
            unit = 180 / np.pi if angle and element.compiler.degree else 1.0
            if on == {True} and self._write(
                None, "", mean, values[b], f"{kind} {attribute}", name, 1.0 if angle else 0.0
            ):
                value = (mean * unit).tolist()
                setattr(element, attribute, value if len(value) > 1 else value[0])
                if kind == "actuator":
                    element.inheritrange = 0.0

    def _joint_parameters(self) -> None:
        model, dofs = self.model, self.model.jnt_dofadr
        maps = [action.coordinates.joints for action in self.actions]
        fields = {name: getattr(model, at) for name, at in _JOINT_FIELDS.items()}
        fields |= {name: getattr(model, at)[dofs] for name, at in _DOF_FIELDS.items()}
        fields["damping"] = _polynomial(model, "dof_damping")[dofs]
        fields["stiffness"] = _polynomial(model, "jnt_stiffness")
        self._unsigned(maps, "joint", fields)
        on_line = [
            {a: b for a, b in m.items() if a in action.coordinates.signs}
            for m, action in zip(maps, self.actions, strict=True)
        ]

        def affine(g: int, a: int) -> tuple[float, float]:
            return self.actions[g].coordinates.signs[a], self.actions[g].coordinates.offsets[a]

        def linear(g: int, a: int) -> tuple[float, float]:
            return self.actions[g].coordinates.signs[a], 0.0

        springs = model.qpos_spring[model.jnt_qposadr][:, None]
        self._signed(on_line, "joint", "range", model.jnt_range, model.jnt_limited, affine)
        self._signed(on_line, "joint", "springref", springs, None, affine)
        limits, on = model.jnt_actfrcrange, model.jnt_actfrclimited
        self._signed(on_line, "joint", "actfrcrange", limits, on, linear)

    def _actuators(self) -> None:
        """With force f = g u + b0 + b1 l + b2 v, only b0 has a sign and an offset."""
        model = self.model
        maps = [{a: image.index for a, image in action.actuators.items()} for action in self.actions]
        gears, biases = np.array(model.actuator_gear), np.array(model.actuator_biasprm)
        gains = self._mean(maps, lambda _, a: model.actuator_gainprm[a])
        slopes = self._mean(maps, lambda _, a: biases[a])
        for b, size in self._mean(maps, lambda _, a: abs(gears[a, 0])).items():
            kind = int(model.actuator_trntype[b])
            if kind in _SCALAR:
                gears[b, 0] = np.copysign(size, gears[b, 0])
                name = name_of(model, "actuator", b)
                self._write(
                    self.spec.actuators[b], "gear", gears[b], model.actuator_gear[b], "actuator gear", name
                )

        def lengths(g: int, a: int) -> float:
            """Offset of an actuator's length, from that of its joint."""
            on_joint = int(model.actuator_trntype[a]) in _SCALAR[:2]
            joint = int(model.actuator_trnid[a, 0]) if on_joint else -1
            return float(self.actions[g].coordinates.offsets.get(joint, 0.0) * gears[maps[g][a], 0])

        def control(g: int, a: int) -> tuple[float, float]:
            image = self.actions[g].actuators[a]
            return image.sign, lengths(g, a) * (image.offset != 0)

        def linear(g: int, a: int) -> tuple[float, float]:
            return self.actions[g].actuators[a].sign, 0.0

        def bias(g: int, a: int) -> Array:
            (sign, offset), b, out = control(g, a), maps[g][a], biases[a].copy()
            if model.actuator_biastype[a] == int(mj.mjtBias.mjBIAS_AFFINE):
                out[0] = sign * out[0] - gains[b][0] * offset - slopes[b][1] * lengths(g, a)
            return out

        for b, mean in self._mean(maps, bias).items():
            name = name_of(model, "actuator", b)
            self._write(self.spec.actuators[b], "biasprm", mean, biases[b], "actuator biasprm", name)
        self._unsigned(
            maps, "actuator", {n: getattr(model, f"actuator_{n}") for n in ("gainprm", "dynprm")}
        )
        for name, move in (("ctrl", control), ("force", linear), ("act", linear)):
            values, on = (getattr(model, f"actuator_{name}{what}") for what in ("range", "limited"))
            self._signed(maps, "actuator", f"{name}range", values, on, move)

    # --- sites and geoms

    def _sites(self) -> None:
        model = self.model
        maps = self._closed([action.sites for action in self.actions], "site")
        owner = model.body_weldid[model.site_bodyid]
        for b, place in self._points(maps, self.data.site_xpos, lambda s: int(owner[s])).items():
            local = self._in_body(int(model.site_bodyid[b]), place)
            name = name_of(model, "site", b)
            self._local(self.spec.sites[b], local, model.site_pos[b], "site position", name)

    def _geoms(self) -> None:
        model = self.model
        self.frames = self.data.geom_xmat.reshape(-1, 3, 3)
        owner = model.body_weldid[model.geom_bodyid]
        # geoms go along with their links, which have moved to symmetric places in their trees by now
        links = [int(b) for b in owner]
        moved = np.array([self.moved[b] - self.shift[b] for b in links]).reshape(-1, 3)
        self.centers = self.data.geom_xpos + moved
        self.offsets = self.centers - np.array([self.origin[b] for b in links]).reshape(-1, 3)
        maps = self._closed([self._match_geoms(g) for g in range(len(self.turns))], "geom")
        self._unsigned(maps, "geom", {name: getattr(model, f"geom_{name}") for name in _GEOM_FIELDS})
        maps = [{a: b for a, b in m.items() if int(model.geom_type[a]) in _PRIMITIVE} for m in maps]
        places = self._points(maps, self.centers, lambda a: links[a])
        turns = self._mean(maps, lambda g, a: self._alignment(g, a, maps[g][a])[0])
        sizes = self._mean(maps, lambda g, a: self._alignment(g, a, maps[g][a])[1])
        for b, place in places.items():
            geom, name, body = self.spec.geoms[b], name_of(model, "geom", b), int(model.geom_bodyid[b])
            if geom.meshname:
                self.report.left.append(f"geom {name!r} is fitted to a mesh")
                continue
            self._write(None, "", sizes[b], model.geom_size[b], "geom size", name, self.extent)
            left, _, right = np.linalg.svd(turns[b])
            turn = left @ right
            if int(model.geom_type[b]) in _ROUND:
                z = turns[b][:, 2] / np.linalg.norm(turns[b][:, 2])
                turn = _rotate(self.frames[b][:, 2], z) @ self.frames[b]
            turn = self.rotation[body].T @ turn
            self._settle(geom, "geom")
            geom.fromto, geom.size = [np.nan] * 6, sizes[b].tolist()
            self._pose(geom, self._in_body(body, place), turn, "geom", name)

    def _match_geoms(self, g: int) -> dict[int, int]:
        """Image of every geom whose shape is where the element sends it, within tolerance."""
        model, images = self.model, {}
        owner = model.body_weldid[model.geom_bodyid]
        for a, b in self.bodies[g].items():
            mine, theirs = np.flatnonzero(owner == a), np.flatnonzero(owner == b)
            cost = np.array([[self._misfit(g, int(i), int(j)) for j in theirs] for i in mine])
            cost = cost.reshape(len(mine), len(theirs))
            for r, c in zip(*linear_sum_assignment(cost + 1e-9 * (mine[:, None] != theirs)), strict=True):
                if cost[r, c] <= self.tolerance:
                    images[int(mine[r])] = int(theirs[c])
        return images

    def _misfit(self, g: int, a: int, b: int) -> float:
        """Distance of geom a's image from geom b relative to the extent; large if they do not fit."""
        model = self.model
        same = all(getattr(model, f"geom_{n}")[a] == getattr(model, f"geom_{n}")[b] for n in _SAME)
        offset = self.turns[g] @ self.offsets[a] - self.offsets[b]
        if int(model.geom_type[a]) == _PLANE:
            offset = offset @ self.frames[b][:, 2]
        if not same or int(model.geom_type[a]) not in _PRIMITIVE:
            return float(np.linalg.norm(offset)) / self.extent if same else 1e3
        frame, size = self._alignment(g, a, b)
        reach = np.abs(frame - self.frames[b])[:, 2 * (model.geom_type[a] in _ROUND) :].max() * size.max()
        growth = float(np.abs(size - model.geom_size[b]).max())
        return max(float(np.linalg.norm(offset)), float(reach), growth) / self.extent

    def _alignment(self, g: int, a: int, b: int) -> tuple[Array, Array]:
        """Image of a's frame, its axes renamed and turned round to be near those of b; sizes likewise."""
        kind, size, frame = int(self.model.geom_type[b]), self.model.geom_size[a], self.frames[b]
        if kind == _SPHERE:
            return frame, size
        turned = self.turns[g] @ self.frames[a]
        relative = turned.T @ frame
        if kind in _ROUND:
            return turned * np.sign(relative[2, 2]), size
        rename = np.round(relative)
        if not np.allclose(rename @ rename.T, np.eye(3)):
            return np.full((3, 3), 1e3), size
        return turned @ rename, np.abs(rename).T @ size


def _polynomial(model: Any, name: str) -> Array:
    """Coefficients of a damping or stiffness; older releases of MuJoCo have the linear one only."""
    linear = np.asarray(getattr(model, name))[:, None]
    return np.concatenate([linear, getattr(model, f"{name}poly", linear[:, :0])], axis=1)


def _rotate(start: Array, end: Array) -> Array:
    """Smallest rotation that carries one unit vector to another, less than a half turn away."""
    x, y, z = np.cross(start, end)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.eye(3) + cross + cross @ cross / (1 + start @ end)
