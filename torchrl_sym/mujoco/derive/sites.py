"""Images of sites: a site is mapped by its place on the link."""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment

from torchrl_sym.mujoco.derive.matching import Matcher
from torchrl_sym.mujoco.model.releases import weld_ids
from torchrl_sym.mujoco.model.types import Array, MjData, MjModel


def map_sites(
    model: MjModel, data: MjData, matcher: Matcher, bodies: dict[int, int], tolerance: float
) -> dict[int, int]:
    """Image of every site that has one: on the image link, where R sends it."""
    images: dict[int, int] = {}
    on_link: dict[int, list[int]] = {}
    for site, link in enumerate(weld_ids(model)[model.site_bodyid].tolist()):
        on_link.setdefault(link, []).append(site)
    for a, b in bodies.items():
        if a not in on_link or b not in on_link:
            continue
        mine, theirs = np.array(on_link[a]), np.array(on_link[b])
        moved = data.site_xpos[mine] @ matcher.matrix.T
        cost = np.linalg.norm(moved[:, None] - matcher.image.site_xpos[theirs], axis=-1) / matcher.extent
        # sites in one place are told apart by their size and by staying where they are
        sizes = np.abs(model.site_size[mine][:, None] - model.site_size[theirs]).sum(-1)
        cost = cost + 1e-3 * sizes / matcher.extent + 1e-9 * (mine[:, None] != theirs)
        for r, c in zip(*linear_sum_assignment(cost), strict=True):
            if cost[r, c] <= tolerance:
                images[int(mine[r])] = int(theirs[c])
    return images


def site_gap(matcher: Matcher, a: int, b: int) -> float:
    """Distance of site b from the image of site a, relative to what moves; infinite on another link."""
    owners = weld_ids(matcher.model)[matcher.model.site_bodyid[[a, b]]]
    if matcher.images.get(int(owners[0])) != int(owners[1]):
        return np.inf
    gap = matcher.matrix @ matcher.data.site_xpos[a] - matcher.image.site_xpos[b]
    return float(np.linalg.norm(gap)) / matcher.size(int(owners[1]))


def site_frame(matcher: Matcher, a: int, b: int) -> Array:
    """V of a site: how a polar vector in the frame of site a becomes one in the frame of its image b."""
    one, other = matcher.data.site_xmat[a].reshape(3, 3), matcher.image.site_xmat[b].reshape(3, 3)
    return other.T @ matcher.matrix @ one
