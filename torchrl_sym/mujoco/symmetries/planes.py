"""Vertical planes in which a model may be mirrored.

A mirror plane that carries link a to link b is the one half way between them: its normal points from the
centre of mass of one to that of the other. A link that the mirror carries to itself has its centre of mass
in the plane, and its horizontal hinge axes in it or across it. So the links of a model propose all planes
that it can have, and the more links propose one, the likelier it is.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from torchrl_sym.mujoco.model.links import Skeleton
from torchrl_sym.mujoco.model.types import HINGE, SLIDE, Array, MjData, MjModel

_STEP = 0.05  # degrees; planes nearer than this are one
_MOST = 24  # planes that are tried
_ALIKE = 0.2  # links of which one weighs so much more than the other are no pair


def candidate_planes(model: MjModel, data: MjData) -> list[float]:
    """Angles in [0, 180) of the normals of planes that links propose, the likeliest first; degrees.

    Those of x and y, in which most models are symmetric, come before all others.

    Example:
        >>> import mujoco
        >>> model = mujoco.MjModel.from_xml_string('''<mujoco><worldbody>
        ...   <body pos="1 0 0"><joint axis="0 0 1"/><geom size=".1"/></body>
        ...   <body pos="0 1 0"><joint axis="0 0 1"/><geom size=".1"/></body>
        ... </worldbody></mujoco>''')
        >>> data = mujoco.MjData(model)
        >>> mujoco.mj_kinematics(model, data)
        >>> [round(angle) for angle in candidate_planes(model, data)]
        [0, 90, 135]
    """
    found: dict[int, list[tuple[float, float]]] = {}  # angles and their weights, by place on a grid
    for direction, weight in _proposals(model, data):
        if np.linalg.norm(direction[:2]) > 1e-6:
            angle = float(np.degrees(np.arctan2(direction[1], direction[0]))) % 180
            found.setdefault(round(angle / _STEP) % round(180 / _STEP), []).append((angle, weight))
    usual = {0: 0.0, round(90 / _STEP): 90.0}
    votes = {key: sum(weight for _, weight in angles) for key, angles in found.items() if key not in usual}
    ranked = sorted(votes, key=lambda key: -votes[key])[: _MOST - len(usual)]
    return [*usual.values(), *(max(found[key], key=lambda pair: pair[1])[0] for key in ranked)]


def _proposals(model: MjModel, data: MjData) -> Iterator[tuple[Array, float]]:
    """Normals of planes, with weights."""
    skeleton = Skeleton(model)
    links, centers = skeleton.links, skeleton.lumps(data).centers
    vertical = np.array([0.0, 0.0, 1.0])
    for link in links.values():
        children = [links[c] for c in link.children]
        for i, one in enumerate(children):
            apart = centers[one.body] - data.xpos[link.body]
            yield np.cross(vertical, apart), 0.5  # it is carried to itself
            for other in children[:i]:
                if abs(one.mass - other.mass) <= _ALIKE * max(one.mass, other.mass):
                    yield centers[one.body] - centers[other.body], 1.0
        for j in link.joints:
            if int(model.jnt_type[j]) in (HINGE, SLIDE):
                yield data.xaxis[j], 0.1
                yield np.cross(vertical, data.xaxis[j]), 0.1
