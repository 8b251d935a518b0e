"""Irreducible representations and isotypic coordinates: their mathematics, for every group and builder."""

import math

import pytest
import torch

from tests.point_groups import GROUPS, assert_close, every_group, random
from tests.test_representations import CASES, acted_matrices, build
from torchrl_sym import PointGroup, Representation
from torchrl_sym.modules.coordinates import Coordinates
from torchrl_sym.modules.irreps import irreps
from torchrl_sym.representations import polar, quaternion, regular
from torchrl_sym.testing import assert_representation


def turn(axis, degrees):
    x, y, z = torch.tensor(axis, dtype=torch.float64) / math.hypot(*axis)
    cross = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    angle = math.radians(degrees)
    return (
        torch.eye(3, dtype=torch.float64) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    )


def solid(**generators) -> PointGroup:
    return PointGroup.generate(generators, fixes_vertical=False)


INVERSION = -torch.eye(3, dtype=torch.float64)
LARGE = {
    "T": solid(cycle=turn((1, 1, 1), 120), half=turn((0, 0, 1), 180)),
    "Th": solid(cycle=turn((1, 1, 1), 120), half=turn((0, 0, 1), 180), inversion=INVERSION),
    "Td": solid(cycle=turn((1, 1, 1), 120), rotoreflection=-turn((0, 0, 1), 90)),
    "Oh": solid(cycle=turn((1, 1, 1), 120), quarter=turn((0, 0, 1), 90), inversion=INVERSION),
    "S4": solid(rotoreflection=-turn((0, 0, 1), 90)),
    "S6": solid(rotoreflection=-turn((0, 0, 1), 60)),
    "Ih": solid(cycle=turn((1, 1, 1), 120), fifth=turn((0, 1, (1 + 5**0.5) / 2), 72), inversion=INVERSION),
    "C120": PointGroup.rotation(120),
    "D60": PointGroup.dihedral(60),
}
SOME = ("reflect-y", "C3", "K4", "C4", "D3", "D4", "C5", "cube")
every_group_there_is = pytest.mark.parametrize("group", (GROUPS | LARGE).values(), ids=GROUPS | LARGE)


@every_group_there_is
def test_irreps_are_representations(group):
    for irrep in irreps(group):
        product = torch.einsum("gij,hjk->ghik", irrep.matrices, irrep.matrices)
        assert_close(product, irrep.matrices[group.table], 1e-11)
        eye = torch.eye(irrep.dim, dtype=torch.float64)
        assert_close(irrep.matrices @ irrep.matrices.mT, eye.expand_as(irrep.matrices), 1e-11)


@every_group_there_is
def test_irreps_are_all_and_distinct(group):
    found = irreps(group)
    assert torch.equal(found[0].matrices, torch.ones(group.order, 1, 1, dtype=torch.float64))
    # as much of the regular representation as there is: d / c copies of each
    assert sum(irrep.dim**2 // irrep.numbers for irrep in found) == group.order
    characters = torch.stack([each.matrices.diagonal(dim1=1, dim2=2).sum(-1) for each in found])
    # Schur: orthogonal, and the dimension of what commutes, which is never 4 (quaternionic)
    commutants = torch.tensor([float(irrep.numbers) for irrep in found], dtype=torch.float64)
    assert_close(characters @ characters.T / group.order, commutants.diag(), 1e-9)
    quarter = torch.tensor([[0.0, -1.0], [1.0, 0.0]], dtype=torch.float64)
    for irrep in found:
        if irrep.is_complex:
            assert_close(irrep.matrices @ quarter, quarter @ irrep.matrices, 1e-12)


def test_irreps_do_not_depend_on_how_eigenvectors_come(monkeypatch):
    group = PointGroup.dihedral(6)
    before = irreps.__wrapped__(group)
    exact = torch.linalg.eigh

    def another(matrix):
        values, vectors = exact(matrix)
        start = 0
        for stop in [*((values.diff() > 1e-8).nonzero().flatten() + 1).tolist(), len(values)]:
            mixed = torch.linalg.qr(random(stop - start, stop - start, seed=start))[0]
            vectors[:, start:stop] = vectors[:, start:stop] @ mixed
            start = stop
        return values, vectors

    monkeypatch.setattr(torch.linalg, "eigh", another)
    for one, other in zip(before, irreps.__wrapped__(group), strict=True):
        assert_close(one.matrices, other.matrices, 1e-12)


def basis(coordinates: Coordinates) -> torch.Tensor:
    """The change of basis, without the rows that only fill up, ``(dim, dim)``."""
    parts = own_rows(coordinates, coordinates.split(torch.eye(coordinates.dim, dtype=torch.float64)))
    return torch.cat([part.flatten(0, 1) for part in parts])


def own_rows(coordinates: Coordinates, parts: list[torch.Tensor]) -> list[torch.Tensor]:
    """Coordinates by irreducible representation, each ``(d, copies, B)``."""
    return [
        part[member, :, : coordinates.multiplicity[i]]
        for kind, part in zip(coordinates.kinds, parts, strict=True)
        for member, i in enumerate(kind.members)
    ]


def check(rep: Representation, tolerance: float = 1e-12) -> None:
    """z[i, :, a] -> D_i(g) z[i, :, a], by an orthogonal matrix, and back."""
    coordinates = Coordinates(rep)
    q = basis(coordinates)
    assert_close(q.T @ q, torch.eye(rep.dim, dtype=torch.float64), tolerance)
    x = random(rep.dim, 3)
    assert_close(coordinates.join(coordinates.split(x)), x, tolerance)
    parts = own_rows(coordinates, coordinates.split(x))
    in_order = [irreps(rep.group)[i] for kind in coordinates.kinds for i in kind.members]
    for g, rho in enumerate(acted_matrices(rep)):
        images = own_rows(coordinates, coordinates.split(rho @ x))
        for irrep, part, image in zip(in_order, parts, images, strict=True):
            assert_close(image, torch.einsum("ij,jmb->imb", irrep.matrices[g], part), tolerance)


@pytest.mark.parametrize("name, group", [case for case in CASES if case[1] in SOME], ids=lambda v: v)
def test_coordinates_turn_as_irreps_do(name, group):
    check(build(name, group))


@pytest.mark.parametrize("group", LARGE)
def test_coordinates_under_large_groups(group):
    rep = polar(LARGE[group]) * 2 + regular(LARGE[group])
    check(rep, 1e-11)


def test_coordinates_of_a_representation_in_general_position():
    """Nothing sparse, nothing rounded: all irreducible representations mixed by a random rotation."""
    group = GROUPS["D4"]
    rep = regular(group) + polar(group) * 2
    mixed = torch.linalg.qr(random(rep.dim, rep.dim))[0]
    check(Representation(group, mixed @ rep.matrices @ mixed.T))
    check(quaternion(GROUPS["C3"]) + polar(GROUPS["C3"]))


@pytest.mark.parametrize("group", ["C2", "K4", "reflect-y"])
def test_entries_of_c2_and_k4_are_exact(group):
    q = basis(Coordinates(regular(GROUPS[group])))
    assert len(q.abs().unique()) == 1
    assert_close(q.abs().unique()[0], torch.tensor(len(q) ** -0.5, dtype=torch.float64), 1e-16)


@every_group
def test_the_regular_representation_is_permuted_by_the_group(group):
    rep = regular(group, 3)
    assert_representation(rep)
    x = random(group.order * 3).unflatten(0, (group.order, 3))
    for g in range(group.order):
        image = rep(x.flatten(), g).unflatten(0, (group.order, 3))
        for h in range(group.order):
            assert torch.equal(image[h], x[group.table[group.inverse[g], h]])


@every_group
def test_the_regular_representation_has_every_irrep(group):
    coordinates = Coordinates(regular(group, 5))
    assert coordinates.multiplicity == [5 * irrep.dim // irrep.numbers for irrep in irreps(group)]


def test_large_events_cost_their_own_size():
    group = PointGroup.klein_four()
    rep = regular(group, 5000)
    coordinates = Coordinates(rep)
    x = random(rep.dim, 1)
    assert_close(coordinates.join(coordinates.split(x)), x)
