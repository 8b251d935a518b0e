"""Representations: the homomorphism for every builder and group, their algebra, their refusals."""

import copy
import functools
import itertools
import re

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.point_groups import GROUPS, ODD, PROPER, VERTICAL, assert_close, every_group, random, scattered
from torchrl_sym import PointGroup, Representation
from torchrl_sym.representations import (
    axial,
    gait_clock,
    heading,
    height_map,
    image,
    invariant,
    items,
    permutation,
    planar,
    points,
    polar,
    pseudoscalar,
    quaternion,
    rotation_6d,
    rotation_matrix,
    scalar,
    signed_permutation,
)

SQUARE = {"trivial", "reflect-x", "reflect-y", "C2", "K4", "C4", "D4"}  # map a square grid to itself
SMALL = set(GROUPS) - {"cube", "D6"}
GRID = torch.linspace(-0.4, 0.4, 5)


def translations(group: PointGroup, signed: bool) -> dict[str, dict[str, str]]:
    """Entries named after the elements: g sends h to g h, with the sign of its determinant."""
    return {
        g: {
            h: "-" * bool(signed and group.det[i] < 0) + group.names[group.table[i, j]]
            for j, h in enumerate(group.names)
        }
        for i, g in enumerate(group.names)
    }


def places(group: PointGroup) -> Representation:
    return permutation(group, group.names, translations(group, signed=False))


def half_a_period(group: PointGroup) -> dict[str, float]:
    """A reflection is half a period ahead, a turn is not."""
    return {name: 0.5 * (group.det[i].item() < 0) for i, name in enumerate(group.names)}


BUILDERS = {  # name: (builder, groups that it admits)
    "scalar": (scalar, set(GROUPS)),
    "pseudoscalar": (pseudoscalar, set(GROUPS)),
    "invariant": (lambda g: invariant(g, 4), set(GROUPS)),
    "polar": (polar, set(GROUPS)),
    "axial": (axial, set(GROUPS)),
    "planar": (planar, VERTICAL),
    "heading": (heading, VERTICAL),
    "matrix-left": (rotation_matrix, PROPER),
    "matrix-conjugate": (lambda g: rotation_matrix(g, "conjugate"), set(GROUPS)),
    "6d-left": (rotation_6d, PROPER),
    "6d-left-rows": (lambda g: rotation_6d(g, layout="rows"), PROPER & VERTICAL),
    "6d-conjugate": (lambda g: rotation_6d(g, "conjugate"), VERTICAL),
    "6d-conjugate-rows": (lambda g: rotation_6d(g, "conjugate", "rows"), VERTICAL),
    "quaternion-left": (quaternion, ODD),
    "quaternion-left-xyzw": (lambda g: quaternion(g, scalar_last=True), ODD),
    "quaternion-conjugate": (lambda g: quaternion(g, "conjugate"), set(GROUPS)),
    "signed_permutation": (
        lambda g: signed_permutation(g, g.names, translations(g, signed=True)),
        set(GROUPS),
    ),
    "permutation": (lambda g: permutation(g, g.names, translations(g, signed=False)), set(GROUPS)),
    "points": (lambda g: points(g, scattered(g)), set(GROUPS)),
    "points-flat": (lambda g: points(g, scattered(g)[:, :2]), VERTICAL),
    "points-of-vectors": (lambda g: points(g, scattered(g), value=axial(g)), set(GROUPS)),
    "height_map": (lambda g: height_map(g, GRID, GRID), SQUARE),
    "items": (lambda g: items(places(g), axial(g)), SMALL),
    "items-that-change-sign": (
        lambda g: items(signed_permutation(g, g.names, translations(g, signed=True)), polar(g)),
        SMALL,
    ),
    "items-of-several-kinds": (
        lambda g: items(places(g) + invariant(g, 2), [axial(g)] * g.order + [polar(g), invariant(g, 3)]),
        SMALL,
    ),
    "frames-of-items": (
        lambda g: items(invariant(g, 2), items(places(g), polar(g))),
        set(GROUPS) - {"cube"},
    ),
    "image": (lambda g: image(g, (4, 4)), SQUARE),
    "image-of-flow": (lambda g: image(g, (3, 3, 2), "HWC", value=planar(g)), SQUARE),
    "image-of-flow-channels-first": (lambda g: image(g, (2, 3, 3), "CHW", value=planar(g)), SQUARE),
    "cameras": (lambda g: items(places(g), image(g, (1, 3), rows="-z", columns="right")), VERTICAL),
    "gait_clock": (lambda g: gait_clock(g, half_a_period(g)), set(GROUPS)),
    "unflatten": (lambda g: (polar(g) * 4).unflatten((2, 6)), set(GROUPS)),
    "sum": (lambda g: polar(g) + pseudoscalar(g) + points(g, scattered(g)) + axial(g), set(GROUPS)),
    "repeat": (lambda g: 2 * (pseudoscalar(g) + axial(g)) * 2, set(GROUPS)),
    "absolute": (
        lambda g: signed_permutation(g, g.names, translations(g, signed=True)).absolute(),
        set(GROUPS),
    ),
    "restrict": (lambda g: polar(PointGroup.dihedral(12)).restrict(g), VERTICAL - {"C5"}),
}
CASES = [(name, group) for name, (_, admitted) in BUILDERS.items() for group in GROUPS if group in admitted]
every_case = pytest.mark.parametrize("name, group", CASES, ids=lambda value: value)


@functools.cache
def build(name: str, group: str) -> Representation:
    return BUILDERS[name][0](GROUPS[group])


def acted_matrices(rep: Representation) -> torch.Tensor:
    """The matrices as they act: images of the unit vectors, ``(N, d, d)``."""
    eye = torch.eye(rep.dim, dtype=torch.float64).reshape(rep.dim, *rep.event_shape)
    return torch.stack([rep(eye, g).reshape(rep.dim, rep.dim).T for g in range(rep.group.order)])


# --- what makes it a representation: every builder, every group it admits


@every_case
def test_homomorphism(name, group):
    rho = acted_matrices(build(name, group))
    products = torch.einsum("gij,hjk->ghik", rho, rho)
    assert_close(products, rho[GROUPS[group].table])


@every_case
def test_orthogonality(name, group):
    rho = acted_matrices(build(name, group))
    assert_close(rho @ rho.mT, torch.eye(rho.shape[-1], dtype=torch.float64).expand_as(rho))


@every_case
def test_identity_changes_nothing(name, group):
    x = random(5, *build(name, group).event_shape)
    assert_close(build(name, group)(x, 0), x, atol=1e-15)


@every_case
def test_matrices_are_what_acts(name, group):
    assert_close(build(name, group).matrices, acted_matrices(build(name, group)), atol=0)


@every_case
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("shape", [(), (5,), (5, 3)], ids=str)
def test_orbit_and_rows_agree_with_single_elements(name, group, shape, dtype):
    rep, n = build(name, group), GROUPS[group].order
    x = random(*shape, *rep.event_shape, dtype=dtype)
    images = torch.stack([rep(x, g) for g in GROUPS[group].names])
    assert images.shape == (n, *shape, *rep.event_shape) and images.dtype == dtype
    assert_close(rep.orbit(x), images, atol=0)
    g = torch.arange(n).reshape(n, *[1] * len(shape)).expand(n, *shape)
    assert_close(rep(x.expand(n, *x.shape), g), images, atol=1e-6 if dtype == torch.float32 else 1e-14)


@every_case
def test_gradient_is_the_transpose(name, group):
    rep = build(name, group)
    x = random(4, *rep.event_shape).requires_grad_()
    cotangent = random(len(GROUPS[group]), 4, *rep.event_shape, seed=1)
    rep.orbit(x).backward(cotangent)
    expected = torch.einsum("gbi,gij->bj", cotangent.flatten(2), rep.matrices)
    assert_close(x.grad, expected.reshape(x.shape))


@pytest.mark.parametrize(
    "group, generators", [("D3", ["rot-120", "reflect-y"]), ("D4", ["rot-90", "reflect-45"])]
)
def test_maps_of_generators_determine_the_rest(group, generators):
    g = GROUPS[group]
    maps = {name: translations(g, signed=True)[name] for name in generators}
    rep = signed_permutation(g, g.names, maps)
    assert torch.equal(rep.matrices, build("signed_permutation", group).matrices)


# --- algebra


@every_group
def test_direct_sum_is_block_diagonal(group):
    a, b = axial(group), pseudoscalar(group) * 2
    x = random(4, 5)
    assert torch.equal((a + b).orbit(x), torch.cat([a.orbit(x[:, :3]), b.orbit(x[:, 3:])], dim=-1))


@every_group
def test_repeat_acts_on_each_frame_of_a_history(group):
    frames = random(4, 3, 3)
    history = (polar(group) * 3).orbit(frames.flatten(1))
    assert torch.equal(history, polar(group).orbit(frames).flatten(2))


def test_restriction_acts_like_the_larger_group():
    rep, sub = axial(PointGroup.dihedral(6)), PointGroup.dihedral(3)
    x = random(4, 3)
    for name in sub.names:
        assert torch.equal(rep.restrict(sub)(x, name), rep(x, name))
    with pytest.raises(ValueError, match=r"expected a subgroup.* but 'rot-90' is not one of its elements"):
        rep.restrict(PointGroup.rotation(4))


def test_absolute_forgets_the_signs():
    rep = build("signed_permutation", "D4") + polar(GROUPS["D4"])
    assert torch.equal(rep.absolute().matrices, rep.matrices.abs())
    assert (rep.absolute().orbit(random(3, rep.dim).exp()) > 0).all()


def test_absolute_refuses_entries_that_mix():
    with pytest.raises(ValueError, match=r"dense block of size 3.*one shared scale.*invariant\(group, d\)"):
        polar(PointGroup.rotation(3)).absolute()


DERIVE = {
    "sum": lambda rep: rep + polar(rep.group),
    "repeat": lambda rep: rep * 3,
    "restrict": lambda rep: rep.restrict(PointGroup.trivial()),
    "absolute": lambda rep: rep.absolute() if rep.is_signed_permutation else rep,
    "sum in half precision": lambda rep: (rep + rep + scalar(rep.group)).half(),
}


@pytest.mark.parametrize("derive", DERIVE.values(), ids=DERIVE)
@pytest.mark.parametrize("group", ["D3", "D4"])
def test_deriving_leaves_the_original_alone(group, derive):
    rep = polar(GROUPS[group])
    before = copy.deepcopy(rep)
    derive(rep)
    assert rep.dim == before.dim and torch.equal(rep.matrices, before.matrices)
    assert_close(rep.orbit(random(2, 3)), before.orbit(random(2, 3)), atol=0)


def test_representations_of_different_groups_do_not_add():
    with pytest.raises(ValueError, match=r"expected representations of one group.*use restrict"):
        polar(PointGroup.rotation(3)) + polar(PointGroup.rotation(4))
    with pytest.raises(TypeError, match="unsupported operand"):
        polar(PointGroup.rotation(3)) + 1
    with pytest.raises(ValueError, match="expected a value of the same group"):
        points(PointGroup.trivial(), [[0.0, 0.0]], value=polar(PointGroup.rotation(3)))


@pytest.mark.parametrize("times", [0, -1, 1.5])
def test_repetitions_are_a_positive_number(times):
    with pytest.raises(ValueError, match=f"repetitions: expected a whole number from 1 .*, got {times}"):
        scalar(PointGroup.trivial()) * times


# --- refusals of the constructor and of the input

EYE, FLIP = torch.eye(2).double(), torch.diag(torch.tensor([1.0, -1])).double()
TURN = torch.tensor([[0.0, -1], [1, 0]], dtype=torch.float64)


@pytest.mark.parametrize(
    "second, message",
    [
        (2 * FLIP, "expected an orthogonal matrix for 'rot-180', got a residual of 3"),
        (EYE.roll(1, 0)[[0, 0]], "expected an orthogonal matrix for 'rot-180'"),
        (float("nan") * FLIP, "expected an orthogonal matrix for 'rot-180', got a residual of nan"),
        (TURN, r"rho\(rot-180\) rho\(rot-180\) differs from rho\(identity\)"),
        (0.6 * EYE + 0.8 * TURN, r"not a representation: rho\(rot-180\) rho\(rot-180\)"),
    ],
)
def test_wrong_matrices_are_refused(second, message):
    with pytest.raises(ValueError, match=message):
        Representation(PointGroup.rotation(2), torch.stack([EYE, second]))


@pytest.mark.parametrize("shape", [(3, 2, 2), (2, 2, 3), (2, 2)])
def test_one_square_matrix_per_element(shape):
    with pytest.raises(ValueError, match=r"expected one square matrix per element, \(2, d, d\), got"):
        Representation(PointGroup.rotation(2), torch.zeros(shape))


@pytest.mark.parametrize("shape", [(), (4,), (3, 2)])
def test_wrong_size_of_input_is_refused(shape):
    for act in (lambda rep, x: rep(x, 1), Representation.orbit):
        with pytest.raises(ValueError, match="expected a last dimension of 3, got a tensor of shape"):
            act(polar(PointGroup.rotation(3)), torch.zeros(shape))


@pytest.mark.parametrize("dtype", [torch.bool, torch.uint8, torch.int64], ids=str)
def test_numbers_that_cannot_be_mapped_are_refused(dtype):
    rep = polar(PointGroup.rotation(3)) if dtype == torch.int64 else polar(PointGroup.rotation(2))
    with pytest.raises(TypeError, match=f"expected .* got a {dtype} tensor"):
        rep.orbit(torch.ones(3, dtype=dtype))


# --- random signed permutations: accepted if and only if they compose


@st.composite
def signed_permutations(draw, size: int = 3) -> torch.Tensor:
    order = draw(st.permutations(range(size)))
    signs = draw(st.lists(st.sampled_from([-1.0, 1.0]), min_size=size, max_size=size))
    return torch.eye(size)[order] * torch.tensor(signs)[:, None]


@settings(deadline=None, max_examples=200)
@given(x=signed_permutations(), y=signed_permutations())
def test_random_signed_permutations_are_accepted_exactly_if_they_compose(x, y):
    group = PointGroup.klein_four()
    rho = torch.stack([torch.eye(3), x, y, x @ y])
    failing = {
        (group.names[g], group.names[h])
        for g, h in itertools.product(range(4), repeat=2)
        if not torch.equal(rho[g] @ rho[h], rho[group.table[g, h]])
    }
    if not failing:
        assert torch.equal(Representation(group, rho).matrices, rho.double())
        return
    with pytest.raises(ValueError, match="not a representation") as error:
        Representation(group, rho)
    assert re.search(r"rho\((.+?)\) rho\((.+?)\)", str(error.value)).groups() in failing
