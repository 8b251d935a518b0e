"""Events of several dimensions: items that change places, and what is known about them."""

import pytest
import torch

from tests.point_groups import GROUPS, assert_close, random
from tests.test_representations import CASES, build, places
from torchrl_sym import PointGroup, Representation
from torchrl_sym.representations import (
    axial,
    invariant,
    items,
    permutation,
    planar,
    polar,
    pseudoscalar,
    quaternion,
    signed_permutation,
)

MIRROR, C3 = PointGroup.reflection("y"), PointGroup.rotation(3)
FEW = [(name, group) for name, group in CASES if group in {"reflect-y", "C3", "K4", "D4"}]
few_cases = pytest.mark.parametrize("name, group", FEW, ids=lambda value: value)
HANDS = permutation(MIRROR, ["l", "r"], {"reflect-y": {"l": "r", "r": "l"}})
FINGERS = permutation(C3, list("abc"), {"rot-120": dict(zip("abc", "bca", strict=True))})

# --- items against matrices and by hand


LEGS = ["front_left", "back_left", "back_right", "front_right"]
LINKS = ["aux", "hip", "ankle"]


def ant_bodies(group: PointGroup) -> Representation:
    """The torso, and three links of each of four legs, which a quarter of a turn carries on."""
    swap = {"left": "right", "right": "left"}
    goal = {
        "rot-90": dict(zip(LEGS, [*LEGS[1:], LEGS[0]], strict=True)),
        "reflect-y": {leg: f"{leg.split('_')[0]}_{swap[leg.split('_')[1]]}" for leg in LEGS},
    }
    maps = {
        element: {"torso": "torso"} | {f"{leg}_{k}": f"{legs[leg]}_{k}" for leg in LEGS for k in LINKS}
        for element, legs in goal.items()
        if element in group.names
    }
    return permutation(group, ["torso", *(f"{leg}_{k}" for leg in LEGS for k in LINKS)], maps)


@pytest.mark.parametrize("group", ["C4", "reflect-y", "D4"])
def test_contact_forces_of_the_ant(group):
    bodies, wrench = ant_bodies(GROUPS[group]), axial(GROUPS[group]) + polar(GROUPS[group])
    forces = items(bodies, wrench)
    assert forces.event_shape == (13, 6) and forces.is_signed_permutation and len(forces.blocks) == 1
    expected = [torch.kron(*pair) for pair in zip(bodies.matrices, wrench.matrices, strict=True)]
    assert torch.equal(forces.matrices, torch.stack(expected))
    x = random(5, 13, 6)
    by_hand = torch.stack([p @ x @ v.mT for p, v in zip(bodies.matrices, wrench.matrices, strict=True)])
    assert_close(forces.orbit(x), by_hand)


def test_items_that_mix_need_no_large_matrix():
    tips = items(FINGERS * 1000, quaternion(C3) + polar(C3))
    assert tips.event_shape == (3000, 7)
    (block,) = tips.blocks
    assert block.index.shape == (3, 21_000, 2)
    x = random(3000, 7)
    moved = FINGERS.orbit(x.unflatten(0, (1000, 3)).movedim(1, -1)).movedim(-1, 2).flatten(1, 2)
    by_item = torch.stack([(quaternion(C3) + polar(C3))(moved[g], g) for g in range(3)])
    assert_close(tips.orbit(x), by_item)


def test_two_arms_change_places():
    signs = signed_permutation(
        MIRROR, ["yaw", "pitch", "roll"], {1: dict(yaw="-yaw", pitch="pitch", roll="-roll")}
    )
    arms = torch.tensor([[1.0, 2, 3], [4, 5, 6]])
    assert items(HANDS, signs)(arms, 1).tolist() == [[-4, 5, -6], [-1, 2, -3]]
    assert items(HANDS, signs)(arms.expand(2, 2, 3), torch.tensor([1, 0])).tolist() == [
        [[-4, 5, -6], [-1, 2, -3]],
        arms.tolist(),
    ]


def test_each_item_may_have_a_value_of_its_own():
    rep = items(HANDS + invariant(MIRROR, 1), [polar(MIRROR), polar(MIRROR), axial(MIRROR)])
    x = torch.arange(9.0).reshape(3, 3)
    assert rep(x, 1).tolist() == [[3, -4, 5], [0, -1, 2], [-6, 7, -8]]


@pytest.mark.parametrize(
    "value, message",
    [
        ([polar(MIRROR), axial(MIRROR)], r"equal values of items 0 and 1.*under 'reflect-y'"),
        ([polar(MIRROR)], "one for each of 2 items, got 1"),
        ([polar(MIRROR), planar(MIRROR)], r"one event shape, got \(3,\) for item 0 and \(2,\) for item 1"),
        (polar(C3), "a value of the same group"),
        ([polar(MIRROR), polar(C3)], "a value of the same group"),
    ],
)
def test_values_that_cannot_change_places_are_refused(value, message):
    with pytest.raises(ValueError, match=message):
        items(HANDS, value)


def test_places_that_mix_are_refused():
    with pytest.raises(ValueError, match="places: expected a signed permutation"):
        items(planar(C3), polar(C3))


# --- shapes


def test_sums_need_vectors():
    arms = items(HANDS, polar(MIRROR))
    for make in (lambda: arms + polar(MIRROR), lambda: polar(MIRROR) + arms, lambda: arms * 2):
        with pytest.raises(ValueError, match=r"events of one dimension.*got \(2, 3\); use flatten\(\)"):
            make()
    assert (arms.flatten() + polar(MIRROR)).event_shape == (9,)


@few_cases
def test_shape_is_nothing_but_a_view(name, group):
    rep = build(name, group)
    flat, x = rep.flatten(), random(2, *rep.event_shape)
    assert flat.event_shape == (rep.dim,)
    assert torch.equal(flat.unflatten(rep.event_shape).orbit(x), rep.orbit(x))
    assert torch.equal(flat.orbit(x.flatten(1)), rep.orbit(x).flatten(2))
    trivial = rep.restrict(PointGroup.trivial())
    assert trivial.event_shape == rep.event_shape and trivial.is_trivial
    if rep.is_signed_permutation:
        assert rep.absolute().event_shape == rep.event_shape


def test_an_event_may_be_a_single_number():
    rate = pseudoscalar(MIRROR).unflatten(())
    assert rate.orbit(torch.tensor([1.0, 2.0])).tolist() == [[1, 2], [-1, -2]]
    assert rate(torch.tensor([1.0, 2.0]), torch.tensor([0, 1])).tolist() == [1, -2]


def test_elements_of_rows_under_vmap():
    x, element = random(4, 2, 3), torch.tensor([0, 1, 1, 0])
    arms = items(HANDS, polar(MIRROR))
    assert torch.equal(torch.vmap(arms)(x, element), arms(x, element))


def test_wrong_shapes_are_refused():
    arms = items(HANDS, polar(MIRROR))
    for x in (torch.zeros(6), torch.zeros(3, 2), torch.zeros(5, 6), torch.zeros(())):
        with pytest.raises(
            ValueError, match=r"expected last dimensions of \(2, 3\), got a tensor of shape"
        ):
            arms(x, 1)
    with pytest.raises(ValueError, match=r"shape: expected sizes that multiply to 6, got \(4, 2\)"):
        arms.unflatten((4, 2))
    with pytest.raises(ValueError, match="expected indices of elements of a shape"):
        arms(torch.zeros(2, 3), torch.tensor([0, 1]))  # one per hand: elements map whole events


# --- what is known about the entries


@few_cases
def test_components_are_what_the_group_connects(name, group):
    rep = build(name, group)
    connected = (rep.matrices.abs() > 1e-9).any(0).double()
    connected = torch.linalg.matrix_power(connected + torch.eye(rep.dim).double(), rep.dim) > 0
    label = rep.components
    assert torch.equal(label[:, None] == label, connected)
    first = torch.stack([(label == value).nonzero()[0, 0] for value in range(int(label.max()) + 1)])
    assert torch.equal(first, first.sort().values)


@few_cases
def test_trivial_is_what_leaves_everything(name, group):
    rep = build(name, group)
    eye = torch.eye(rep.dim).double()
    assert rep.is_trivial == all(torch.equal(matrix, eye) for matrix in rep.matrices)


@pytest.mark.parametrize("group", ["K4", "C3", "D4", "cube"])
def test_leading_dimensions_follow_the_items(group):
    g = GROUPS[group]
    rep = items(places(g), items(invariant(g, 2), axial(g)))
    assert rep.leading(1).event_shape == (g.order,)
    assert torch.equal(rep.leading(1).matrices, places(g).matrices)
    assert torch.equal(rep.leading(2).matrices, items(places(g), invariant(g, 2)).matrices)
    # what is computed from each item by itself changes places as leading() says
    x = random(4, *rep.event_shape)
    assert_close(rep.orbit(x).norm(dim=-1), rep.leading(2).orbit(x.norm(dim=-1)))


def test_all_dimensions_lead_where_entries_do_not_mix():
    rep = items(HANDS, axial(MIRROR))
    assert torch.equal(rep.leading(2).matrices, rep.matrices.abs())
    with pytest.raises(ValueError, match="dense block"):
        items(FINGERS, polar(C3)).leading(2)


def test_items_that_are_taken_apart_lead_nowhere():
    joints = signed_permutation(MIRROR, list("abcd"), {1: dict(a="a", b="c", c="b", d="d")}).unflatten(
        (2, 2)
    )
    with pytest.raises(ValueError, match=r"whole items of the first 1 of .* 'reflect-y' takes item 0 from"):
        joints.leading(1)
    with pytest.raises(ValueError, match="'rot-120' takes item 0 from several"):
        polar(C3).unflatten((3, 1)).leading(1)
