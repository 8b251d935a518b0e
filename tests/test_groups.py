"""Point groups: the axioms, exact entries, names, subgroups and every refusal."""

import copy
import itertools
import math
import pickle

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.point_groups import CYCLE_AXES, GROUPS, QUARTER_TURN, cube, every_group
from torchrl_sym import PointGroup

ORDERS = dict(zip(GROUPS, [1, 2, 2, 2, 3, 4, 4, 6, 8, 5, 12, 24], strict=True))
INTEGER_ENTRIES = ["trivial", "reflect-x", "reflect-y", "C2", "K4", "C4", "D4", "cube"]


def turn(angle: float) -> torch.Tensor:
    c, s = math.cos(angle), math.sin(angle)
    return torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float64)


# --- axioms


@pytest.mark.parametrize("name", GROUPS)
def test_order(name):
    assert GROUPS[name].order == len(GROUPS[name]) == len(GROUPS[name].matrices) == ORDERS[name]


@every_group
def test_elements_are_distinct(group):
    pairs = itertools.combinations(group.matrices, 2)
    assert all((a - b).abs().max() > 0.1 for a, b in pairs)


@every_group
def test_closure_every_product_is_the_element_in_the_table(group):
    products = torch.einsum("gij,hjk->ghik", group.matrices, group.matrices)
    torch.testing.assert_close(products, group.matrices[group.table], rtol=0, atol=1e-15)


@pytest.mark.parametrize("name", INTEGER_ENTRIES)
def test_products_are_exact_where_entries_are_integers(name):
    group = GROUPS[name]
    products = torch.einsum("gij,hjk->ghik", group.matrices, group.matrices)
    assert torch.equal(products, group.matrices[group.table])


@every_group
def test_associativity(group):
    t = group.table
    g, h, k = torch.meshgrid(*[torch.arange(group.order)] * 3, indexing="ij")
    assert torch.equal(t[t[g, h], k], t[g, t[h, k]])


@every_group
def test_identity_is_first_and_neutral(group):
    everyone = torch.arange(group.order)
    assert torch.equal(group.matrices[0], torch.eye(3, dtype=torch.float64))
    assert torch.equal(group.table[0], everyone)
    assert torch.equal(group.table[:, 0], everyone)


@every_group
def test_inverse_is_two_sided_and_the_transpose(group):
    everyone = torch.arange(group.order)
    assert (group.table[everyone, group.inverse] == 0).all()
    assert (group.table[group.inverse, everyone] == 0).all()
    torch.testing.assert_close(group.matrices[group.inverse], group.matrices.mT, rtol=0, atol=1e-15)


@every_group
def test_each_row_and_column_of_the_table_is_a_permutation(group):
    everyone = torch.arange(group.order).expand(group.order, -1)
    assert torch.equal(group.table.sort(dim=0).values, everyone.T)
    assert torch.equal(group.table.sort(dim=1).values, everyone)


@every_group
def test_determinant_is_a_homomorphism_to_plus_minus_one(group):
    assert set(group.det.tolist()) <= {-1.0, 1.0}
    assert torch.equal(group.det[group.table], group.det[:, None] * group.det)
    torch.testing.assert_close(torch.linalg.det(group.matrices), group.det)


@every_group
def test_element_order_is_the_smallest_power_that_gives_the_identity(group):
    eye = torch.eye(3, dtype=torch.float64)
    for matrix, n in zip(group.matrices, group.element_order, strict=True):
        powers = [torch.linalg.matrix_power(matrix, k) for k in range(1, n + 1)]
        assert [torch.allclose(power, eye, atol=1e-12) for power in powers] == [False] * (n - 1) + [True]


@pytest.mark.parametrize("name", [name for name in GROUPS if name != "cube"])
def test_vertical_axis_is_fixed(name):
    up = torch.tensor([0.0, 0, 1], dtype=torch.float64)
    assert torch.equal(GROUPS[name].matrices @ up, up.expand(ORDERS[name], 3))


# --- exact entries and names


def test_klein_four_has_the_order_of_the_paper():
    group = PointGroup.klein_four()
    signs = torch.tensor([[1.0, 1, 1], [-1, 1, 1], [1, -1, 1], [-1, -1, 1]])
    assert group.names == ("identity", "reflect-x", "reflect-y", "rot-180")
    assert torch.equal(group.matrices, torch.diag_embed(signs).double())


def test_entries_of_multiples_of_30_and_45_degrees_are_exact_to_the_last_bit():
    exact = {s * v for s in (-1, 1) for v in (0, 0.5, math.sqrt(0.5), math.sqrt(0.75), 1)}
    for n in (3, 4, 6, 8, 12):
        assert set(PointGroup.dihedral(n).matrices.flatten().tolist()) <= exact


def test_a_third_of_a_turn():
    half, root = 0.5, math.sqrt(0.75)
    expected = [[-half, -root, 0], [root, -half, 0], [0, 0, 1]]
    group = PointGroup.rotation(3)
    assert group.matrices[group.index("rot-120")].tolist() == expected


@pytest.mark.parametrize(
    "group, names",
    [
        (PointGroup.rotation(4), "identity rot-90 rot-180 rot-270"),
        (PointGroup.dihedral(3), "identity reflect-30 reflect-y reflect-150 rot-120 rot-240"),
        (PointGroup.dihedral(2), "identity reflect-x reflect-y rot-180"),
        (PointGroup.rotation(1), "identity"),
    ],
    ids=["C4", "D3", "D2", "C1"],
)
def test_names_say_what_the_elements_do(group, names):
    assert group.names == tuple(names.split())


def test_reflection_is_named_by_its_normal():
    group = PointGroup.dihedral(3)
    a = math.radians(30)
    normal = torch.tensor([math.cos(a), math.sin(a), 0], dtype=torch.float64)
    torch.testing.assert_close(group.matrices[group.index("reflect-30")] @ normal, -normal)


def test_elements_that_move_the_vertical_are_named_after_generators():
    assert {"cycle", "turn*cycle"} <= set(cube().names)


@settings(deadline=None, max_examples=20)
@given(n=st.integers(1, 40), k=st.integers(1, 40))
def test_any_turn_generates_the_cyclic_group_of_its_order(n, k):
    group = PointGroup.generate({"turn": turn(2 * math.pi * k / n)})
    assert group == PointGroup.rotation(n // math.gcd(n, k))


def test_generators_may_come_in_any_order_and_number():
    half_turn = torch.diag(torch.tensor([-1.0, -1, 1]))
    mirror = torch.diag(torch.tensor([1.0, -1, 1]))
    redundant = {"half": half_turn, "mirror": mirror, "same": mirror, "nothing": torch.eye(3)}
    assert PointGroup.generate(redundant) == PointGroup.klein_four()


# --- subgroups, identity of groups


def test_subgroup_keeps_matrices_and_names():
    d4 = PointGroup.dihedral(4)
    sub = d4.subgroup(["reflect-x", "reflect-y"])
    assert sub == PointGroup.klein_four()
    assert all(torch.equal(sub.matrices[sub.index(g)], d4.matrices[d4.index(g)]) for g in sub.names)


@every_group
def test_order_of_a_subgroup_divides_the_order(group):
    orders = [group.subgroup([g]).order for g in group.names]
    assert tuple(orders) == group.element_order
    assert all(group.order % n == 0 for n in orders)


@every_group
def test_all_elements_generate_the_group_itself(group):
    assert group.subgroup(range(group.order)) == group
    assert group.subgroup([]).order == 1


def test_equality_compares_elements():
    assert PointGroup.klein_four() == PointGroup.dihedral(2)
    assert PointGroup.reflection("x") != PointGroup.reflection("y")
    assert PointGroup.rotation(2) != "C2"
    assert len({PointGroup.klein_four(), PointGroup.dihedral(2)}) == 1


@every_group
def test_index_finds_every_element_by_name_and_by_number(group):
    assert [group.index(name) for name in group.names] == list(range(group.order))
    assert [group.index(i) for i in range(group.order)] == list(range(group.order))


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda g: pickle.loads(pickle.dumps(g))])
def test_copies_are_equal(duplicate):
    group = duplicate(PointGroup.dihedral(3))
    assert group == PointGroup.dihedral(3)
    assert torch.equal(group.table, PointGroup.dihedral(3).table)


def test_repr_lists_the_elements():
    assert repr(PointGroup.reflection("y")) == "PointGroup(identity, reflect-y)"


# --- refusals

EYE = torch.eye(3)
NAN = torch.full((3, 3), math.nan)


@pytest.mark.parametrize(
    "matrices, message",
    [
        (torch.eye(3), r"expected matrices of shape \(N, 3, 3\), got \(3, 3\)"),
        (torch.eye(2)[None], r"expected matrices of shape \(N, 3, 3\), got \(1, 2, 2\)"),
        (torch.zeros(0, 3, 3), r"expected 1 to 120 elements, got 0; list the identity"),
        (torch.stack([EYE, 2 * EYE]), "expected orthogonal matrices, got element 1"),
        (torch.stack([EYE, NAN]), "expected orthogonal matrices, got element 1 = .*nan"),
        (torch.stack([QUARTER_TURN, EYE]), "expected the identity as element 0; list it first"),
        (torch.stack([EYE, EYE]), "distinct names.* is an element listed twice"),
        (torch.stack([EYE, QUARTER_TURN]), "closed set, but rot-90 after rot-90 is not in it"),
    ],
    ids=["matrix", "size", "empty", "scaled", "nan", "identity-last", "duplicate", "not-closed"],
)
def test_bad_elements_are_refused(matrices, message):
    with pytest.raises(ValueError, match=message):
        PointGroup(matrices)


@pytest.mark.parametrize("names", [["e"], ["e", "e"], ["e", "f", "g"]])
def test_names_must_be_distinct_and_one_per_element(names):
    mirror = torch.diag(torch.tensor([-1.0, 1, 1]))
    with pytest.raises(ValueError, match=r"expected (2 )?distinct names"):
        PointGroup(torch.stack([EYE, mirror]), names)


def test_an_element_listed_twice_under_two_names_is_refused():
    with pytest.raises(ValueError, match="'a' and 'b' are the same"):
        PointGroup(torch.stack([EYE, EYE]), ["a", "b"])


@pytest.mark.parametrize(
    "generator, message",
    [
        (0.5 * EYE, "generator 'g': expected an orthogonal 3 x 3 matrix"),
        (NAN, "generator 'g': expected an orthogonal 3 x 3 matrix, got .*nan"),
        (torch.eye(2), "generator 'g': expected an orthogonal 3 x 3 matrix"),
        (CYCLE_AXES, "generator 'g' moves the vertical axis.*pass fixes_vertical=False"),
        (-EYE, "generator 'g' moves the vertical axis"),
        (turn(1.0), r"\['g'\] do not close to a finite group of at most 120 elements"),
        (turn(2 * math.pi / 121), "do not close to a finite group.*a divisor of 360 degrees"),
    ],
    ids=["scaled", "nan", "size", "cycle", "inversion", "one-radian", "too-many"],
)
def test_bad_generators_are_refused(generator, message):
    with pytest.raises(ValueError, match=message):
        PointGroup.generate({"g": generator})


@pytest.mark.parametrize(("degrees", "name"), [(0, "reflect-x"), (90.0, "reflect-y"), (-30, "reflect-150")])
def test_reflection_takes_the_angle_of_its_normal(degrees, name):
    group = PointGroup.reflection(degrees)
    assert group.names == ("identity", name)
    angle = math.radians(degrees)
    normal = torch.tensor([math.cos(angle), math.sin(angle), 0.0], dtype=torch.float64)
    torch.testing.assert_close(group.matrices[1] @ normal, -normal)


@pytest.mark.parametrize("group", [PointGroup.dihedral(3), PointGroup.klein_four(), PointGroup.rotation(5)])
def test_turned_groups_are_conjugate(group):
    moved, turn = group.turned(20.0), PointGroup.generate({"t": PointGroup.rotation(18).matrices[1]})
    expected = {
        tuple((turn.matrices[1] @ m @ turn.matrices[1].mT).flatten().tolist()) for m in group.matrices
    }
    for matrix in moved.matrices:
        nearest = min(
            max(abs(a - b) for a, b in zip(matrix.flatten().tolist(), m, strict=True)) for m in expected
        )
        assert nearest < 1e-12
    assert moved.turned(-20.0) == group


@pytest.mark.parametrize("axis", ["z", "X", None])
def test_reflection_takes_a_horizontal_axis(axis):
    with pytest.raises(
        ValueError, match=r"expected axis 'x' or 'y', or its angle.*got.*PointGroup.generate"
    ):
        PointGroup.reflection(axis)


@pytest.mark.parametrize("build", [PointGroup.rotation, PointGroup.dihedral])
@pytest.mark.parametrize("n", [0, -3, 2.5])
def test_number_of_turns_is_positive(build, n):
    with pytest.raises(ValueError, match=f"n: expected a whole number from 1 to .*, got {n}"):
        build(n)


@pytest.mark.parametrize("element", [4, -1])
def test_index_out_of_range_is_refused(element):
    with pytest.raises(KeyError, match=rf"element index in \[0, 4\), got {element}"):
        PointGroup.klein_four().index(element)


@pytest.mark.parametrize("use", [PointGroup.index, lambda group, e: group.subgroup([e])])
def test_unknown_element_lists_the_known_ones(use):
    with pytest.raises(KeyError, match=r"no element 'rot-90' in this group.*'rot-180'"):
        use(PointGroup.klein_four(), "rot-90")
