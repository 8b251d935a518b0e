"""Scans of many points: found without comparing all pairs, in the order that the sensor has."""

import time

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torchrl.data import Bounded

from tests.point_groups import GROUPS, assert_close, random
from torchrl_sym import PointGroup
from torchrl_sym.environments.specs import check_box
from torchrl_sym.representations import axial, height_map, invariant, items, points, polar, pseudoscalar
from torchrl_sym.representations.nearest import nearest
from torchrl_sym.testing import assert_representation

K4, D4 = GROUPS["K4"], GROUPS["D4"]


class Largest(TorchDispatchMode):
    """The size of the largest tensor that anything computes."""

    size = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        out = func(*args, **kwargs or {})
        for tensor in out if isinstance(out, tuple | list) else [out]:
            if isinstance(tensor, torch.Tensor):
                self.size = max(self.size, tensor.untyped_storage().nbytes() // tensor.element_size())
        return out


def lines(count: int) -> torch.Tensor:
    return (torch.arange(count) - (count - 1) / 2) * 0.05


@pytest.mark.parametrize("size, group", [(128, "K4"), (64, "D4")])
def test_a_large_scan_costs_its_own_size(size, group):
    g, start = GROUPS[group], time.process_time()
    with Largest() as largest:
        scan = height_map(g, lines(size), lines(size))
        check_box("scan", Bounded(-1, 1, (size * size,)), scan)
        assert_representation(scan)
        frames = items(invariant(g, 2), scan + polar(g))
        assert frames.leading(1).is_trivial and not scan.is_trivial
        assert len(scan.components.unique()) == size * (size + 2 * (group == "D4")) / (
            8 if group == "D4" else 4
        )
    assert largest.size <= 4 * 2 * g.order * (size * size + 3)
    assert time.process_time() - start < 4  # it is 0.5
    heights = random(size, size)
    assert torch.equal(scan(heights.flatten(), "reflect-x"), heights.flip(0).flatten())
    assert torch.equal(scan(heights.flatten(), "reflect-y"), heights.flip(1).flatten())


def test_forces_at_many_points_cost_their_own_size():
    with Largest() as largest:
        tips = points(K4, torch.cartesian_prod(lines(32), lines(32), torch.ones(1)), value=axial(K4))
    assert tips.dim == 3 * 32**2 and largest.size <= 4 * 9 * 32**2


def field(p: torch.Tensor) -> torch.Tensor:
    return torch.sin(3 * p[:, 0]) + p[:, 1] + p[:, 0] * p[:, 1]


@pytest.mark.parametrize("order, indexing", [("xy", "xy"), ("yx", "ij")])
def test_order_of_the_axes(order, indexing):
    x, y = torch.linspace(-0.8, 0.8, 17), torch.linspace(-0.5, 0.5, 11)
    p = torch.stack([each.flatten() for each in torch.meshgrid(x, y, indexing=indexing)], -1)
    scan = height_map(K4, x, y, order=order)
    for g, signs in enumerate([(1, 1), (-1, 1), (1, -1), (-1, -1)]):
        assert_close(scan(field(p), g), field(p * torch.tensor(signs)), atol=1e-6)
    other = height_map(K4, x, y, order={"xy": "yx", "yx": "xy"}[order])
    assert (other(field(p), "reflect-y") - field(p * torch.tensor([1, -1]))).abs().max() > 1


@pytest.mark.parametrize("dims", [2, 3])
@pytest.mark.parametrize("tolerance", [0.0, 1e-6, 0.01, 0.1, 5.0])
def test_nearest_is_what_comparing_all_pairs_finds(dims, tolerance):
    known = random(200, dims).round(decimals=1).unique(dim=0)  # several to a cell, many on its edges
    shift = random(len(known), dims, seed=1) * tolerance
    places = torch.cat([known, known + shift, known + tolerance, random(100, dims, seed=2)])
    pairs = torch.cdist(places, known, compute_mode="donot_use_mm_for_euclid_dist")
    distance = pairs.amin(1)
    found = nearest(places, known, tolerance)
    clear = (distance - tolerance).abs() > 1e-12  # at the limit itself rounding decides
    clear |= distance == 0
    assert torch.equal(found[clear] >= 0, (distance <= tolerance)[clear])
    hit = found >= 0
    assert_close((places - known[found])[hit].norm(dim=-1), distance[hit])


def test_points_that_are_nearly_closed_are_found_within_the_tolerance():
    p = torch.cartesian_prod(lines(6), lines(6)) + 1e-3 * random(36, 2)
    exact = points(D4, torch.cartesian_prod(lines(6), lines(6)))
    assert torch.equal(points(D4, p, tolerance=0.02).matrices, exact.matrices)
    with pytest.raises(ValueError, match=r"not closed under .*where there is none; center the layout"):
        points(D4, p)


@pytest.mark.parametrize("count", [2, 20_000])
def test_points_that_coincide_are_refused_at_once(count):
    with pytest.raises(ValueError, match="expected distinct points"):
        points(PointGroup.trivial(), torch.ones(count, 2))


def test_an_off_centre_scan_is_refused():
    with pytest.raises(ValueError, match=r"not closed under 'reflect-x'.*center the layout on the axis"):
        height_map(K4, lines(128) + 0.3, lines(128))


@pytest.mark.parametrize("group", ["K4", "C3"])
def test_image_of_a_box_is_that_of_its_corners(group):
    g = GROUPS[group]
    rep = items(invariant(g, 2), polar(g) + pseudoscalar(g))
    low, high = -random(2, 4).abs(), random(2, 4, seed=1).abs()
    corners = torch.where(torch.rand(2000, 2, 4, dtype=torch.float64) < 0.5, low, high)
    images = rep.orbit(corners)
    image_low, image_high = rep.image_of_box(low, high)
    assert_close(images.amin(1), image_low)
    assert_close(images.amax(1), image_high)


def test_unbounded_entries_do_not_spoil_their_neighbours():
    low = torch.tensor([-1.0, -1.0, -torch.inf])
    image_low, image_high = polar(GROUPS["C3"]).image_of_box(low, -low)
    reach = 0.5 + 0.75**0.5
    expected = torch.tensor([[1.0, 1, torch.inf]] + [[reach, reach, torch.inf]] * 2, dtype=torch.float64)
    assert torch.allclose(image_high, expected) and torch.equal(image_low, -image_high)


def test_boxes_and_sizes_of_events_of_several_dimensions():
    forces = items(invariant(K4, 5), polar(K4))
    check_box("forces", Bounded(-1, 1, (7, 5, 3)), forces)
    low = -torch.ones(7, 5, 3)
    low[3, 2, 1] = -2
    with pytest.raises(ValueError, match=r"'forces': the box of entry 7, \[-2, 1\].*'reflect-y'"):
        check_box("forces", Bounded(low, torch.ones(7, 5, 3)), forces)
