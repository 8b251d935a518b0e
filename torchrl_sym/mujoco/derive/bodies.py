"""Images of bodies that are welded to others: one is mapped by its place on the image of its link."""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment

from torchrl_sym.mujoco.derive.matching import Matcher


def map_bodies(matcher: Matcher, tolerance: float) -> dict[int, int]:
    """Image of every body that has one: of links, and of welded bodies as heavy and in the right place."""
    model, data, image = matcher.model, matcher.data, matcher.image
    images = dict(matcher.images)
    for a, b in matcher.images.items():
        mine, theirs = ([x for x in matcher.links[k].bodies if x != k] for k in (a, b))
        if not mine or not theirs:
            continue
        apart = (data.xipos[mine] @ matcher.matrix.T)[:, None] - image.xipos[theirs]
        cost = np.linalg.norm(apart, axis=-1) / matcher.extent
        masses = np.abs(model.body_mass[mine][:, None] - model.body_mass[theirs])
        # bodies in one place are told apart by their mass and by staying where they are
        ranked = cost + 1e-3 * masses / max(float(model.body_mass.sum()), 1e-12)
        ranked = ranked + 1e-9 * np.not_equal.outer(mine, theirs)
        for r, c in zip(*linear_sum_assignment(ranked), strict=True):
            if cost[r, c] <= tolerance:
                images[mine[r]] = theirs[c]
    return images
