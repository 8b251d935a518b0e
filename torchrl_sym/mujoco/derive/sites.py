"""Images of sites: a site is mapped by its place on the link."""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment

from torchrl_sym.mujoco.derive.matching import Matcher
from torchrl_sym.mujoco.model.releases import weld_ids
from torchrl_sym.mujoco.model.types import MjData, MjModel


def map_sites(
    model: MjModel, data: MjData, matcher: Matcher, bodies: dict[int, int], tolerance: float
) -> dict[int, int]:
    """Image of every site that has one: on the image link, where R sends it."""
    images: dict[int, int] = {}
    owner = weld_ids(model)[model.site_bodyid]
    for a, b in bodies.items():
        mine, theirs = np.flatnonzero(owner == a), np.flatnonzero(owner == b)
        if not len(mine) or not len(theirs):
            continue
        moved = data.site_xpos[mine] @ matcher.matrix.T
        cost = np.linalg.norm(moved[:, None] - matcher.image.site_xpos[theirs], axis=-1) / matcher.extent
        # sites in one place are told apart by their size and by staying where they are
        sizes = np.abs(model.site_size[mine][:, None] - model.site_size[theirs]).sum(-1)
        cost = cost + 1e-3 * sizes / matcher.extent + 1e-9 * (mine[:, None] != theirs)
        for r, c in zip(*linear_sum_assignment(cost), strict=True):
            if cost[r, c] <= tolerance:
                images[int(mine[r])] = int(theirs[c])
    return images
