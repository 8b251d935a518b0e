"""Masses and inertias of links, and the drag of a fluid on them."""

from __future__ import annotations

import numpy as np

from torchrl_sym.mujoco.audit.comparison import Comparison
from torchrl_sym.mujoco.model.types import name_of


def compare_links(c: Comparison) -> None:
    """Masses, centres of mass, inertias and gravity compensation."""
    model, turn = c.model, c.matcher.matrix
    moving = {body: link for body, link in c.links.items() if body}  # the world's own mass does not matter
    trees = {body: int(model.body_rootid[body]) for body in moving}  # an object is judged beside no robot
    here, there = (c.matcher.skeleton.lumps(pose) for pose in (c.data, c.image))
    masses, inertias = dict.fromkeys(trees.values(), 1e-12), dict.fromkeys(trees.values(), 1e-12)
    for body, link in moving.items():
        masses[trees[body]] += link.mass
        lever = float(np.linalg.norm(here.centers[body] - c.data.xpos[body]))
        felt = float(np.abs(here.inertias[body]).max()) + link.mass * lever**2  # about where it is held
        inertias[trees[body]] = max(inertias[trees[body]], felt)

    for a, b in c.map.bodies.items():
        if a == 0:
            continue
        one, other, name = c.links[a], c.links[b], c.name("body", a, b)
        total = masses[trees[a]]
        c.add("mass", abs(one.mass - other.mass) / total, name)
        if min(one.mass, other.mass) > 0:
            offset = float(np.linalg.norm(turn @ here.centers[a] - there.centers[b]))
            c.add("centre of mass", offset / c.matcher.size(a), name, amount=f"{1e3 * offset:.2g} mm")
        quaternions = [
            float(np.abs(np.linalg.norm(model.body_quat[x.bodies], axis=1) - 1).max()) for x in (one, other)
        ]
        c.add("body rotation", abs(quaternions[0] - quaternions[1]), name)
        image = turn @ here.inertias[a] @ turn.T
        c.add("inertia", float(np.abs(image - there.inertias[b]).max()) / inertias[trees[a]], name)
        if model.body_gravcomp.any():
            lift = [model.body_mass[x.bodies] @ model.body_gravcomp[x.bodies] for x in (one, other)]
            c.add("gravity compensation", abs(float(lift[0] - lift[1])) / total, name)


def compare_gravity(c: Comparison) -> None:
    """A small tilt, relative to gravity itself."""
    gravity = c.model.opt.gravity
    if gravity.any():
        tilt = float(np.linalg.norm(c.matcher.matrix @ gravity - gravity) / np.linalg.norm(gravity))
        c.add("gravity", tilt if tilt > 1e-15 else 0.0, "gravity", amount=f"{np.degrees(tilt):.2g} deg")


def compare_fluid(c: Comparison) -> None:
    """Drag acts on each body's inertia box, so that its axes matter, and wind."""
    model, turn = c.model, c.matcher.matrix
    if not (model.opt.density > 0 or model.opt.viscosity > 0):
        return
    wind = model.opt.wind
    if wind.any():
        gap = float(np.linalg.norm(turn @ wind - wind) / np.linalg.norm(wind))
        c.add("wind", min(gap, 1.0), "wind")
    for a, b in c.map.bodies.items():
        one, other = ([x for x in c.links[k].bodies if model.body_mass[x] > 0] for k in (a, b))
        if a and len(one) == len(other) == 1:
            ends = ((c.data, one), (c.image, other))
            axes = [pose.ximat[body[0]].reshape(3, 3) for pose, body in ends]
            turned = axes[1].T @ turn @ axes[0]
            c.add("drag", float(np.abs(turned - turned.round()).max()), c.name("body", a, b))
        elif a and one:
            c.unchecked.append(f"drag on {name_of(model, 'body', a)!r}, a link of several bodies")
