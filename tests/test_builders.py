"""Builders of representations against physics: vectors, fields, orientations and named joints."""

import pytest
import torch

from tests.point_groups import (
    GROUPS,
    ODD,
    PROPER,
    VERTICAL,
    assert_close,
    cube,
    every_group,
    every_vertical_group,
    random,
    scattered,
)
from torchrl_sym import PointGroup
from torchrl_sym.representations import (
    axial,
    heading,
    height_map,
    invariant,
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

# --- vectors and scalars against geometry


@every_group
def test_cross_product_of_polar_vectors_is_axial(group):
    a, b = random(2, 6, 3)
    a_image, b_image = polar(group).orbit(a), polar(group).orbit(b)
    assert_close(torch.linalg.cross(a_image, b_image), axial(group).orbit(torch.linalg.cross(a, b)))


@every_group
def test_triple_product_of_polar_vectors_is_a_pseudoscalar(group):
    triple = random(6, 3, 3)
    volume = torch.linalg.det(polar(group).orbit(triple))
    assert_close(volume, pseudoscalar(group).orbit(torch.linalg.det(triple)[:, None])[..., 0])


@every_group
def test_length_is_a_scalar(group):
    v = random(6, 3)
    length = v.norm(dim=-1, keepdim=True)
    assert_close(polar(group).orbit(v).norm(dim=-1, keepdim=True), scalar(group).orbit(length))
    assert torch.equal(invariant(group, 3).orbit(v), v.expand(len(group), 6, 3))


@every_vertical_group
def test_planar_is_the_horizontal_part_of_polar(group):
    v = random(6, 3)
    assert torch.equal(planar(group).orbit(v[:, :2]), polar(group).orbit(v)[..., :2])


def cos_sin(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """(cos, sin) of the angle from a to b, up to their lengths."""
    return torch.stack([(a * b).sum(-1), a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]], -1)


@every_vertical_group
def test_heading_is_the_angle_between_two_mapped_directions(group):
    forward, goal = random(2, 6, 2)
    mapped = cos_sin(planar(group).orbit(forward), planar(group).orbit(goal))
    assert_close(heading(group).orbit(cos_sin(forward, goal)), mapped)


@pytest.mark.parametrize("builder", [planar, heading, rotation_6d])
def test_horizontal_builders_refuse_groups_that_move_the_vertical(builder):
    arguments = ["conjugate"] if builder is rotation_6d else []
    with pytest.raises(
        ValueError, match=r"a group that fixes the vertical axis, but .* moves it; use polar"
    ):
        builder(cube(), *arguments)


# --- fields: (g f)(p) = f(g^-1 p)


def height(p: torch.Tensor) -> torch.Tensor:
    return torch.sin(3 * p[..., 0] + 1) + torch.cos(2 * p[..., 1] + 0.5) * p[..., 0]


def flow(p: torch.Tensor) -> torch.Tensor:
    return torch.stack([p[..., 1] ** 2, torch.exp(p[..., 0]), p[..., 0] * p[..., 1]], dim=-1)


@every_group
def test_points_sample_the_field_of_the_moved_world(group):
    p = scattered(group)
    moved = torch.stack([height(p @ matrix) for matrix in group.matrices])  # p @ R is R^-1 p
    assert_close(points(group, p).orbit(height(p)), moved)


@every_group
@pytest.mark.parametrize("vector", [polar, axial])
def test_points_carry_vectors_along(group, vector):
    p, rho = scattered(group), vector(group).matrices
    moved = torch.stack([flow(p @ matrix) @ r.T for matrix, r in zip(group.matrices, rho, strict=True)])
    assert_close(points(group, p, value=vector(group)).orbit(flow(p).flatten()), moved.flatten(1))


def test_height_map_of_the_climbing_task_is_closed_under_klein_four():
    x, y = torch.linspace(-1, 1, 21).double(), torch.linspace(-0.5, 0.5, 11).double()
    rep = height_map(PointGroup.klein_four(), x, y)
    terrain = height(torch.cartesian_prod(x, y))
    assert rep.dim == 231
    signs = [(1, 1), (-1, 1), (1, -1), (-1, -1)]
    moved = [height(torch.cartesian_prod(sx * x, sy * y)) for sx, sy in signs]
    assert_close(rep.orbit(terrain), torch.stack(moved), atol=1e-6)


def ring(count: int, radius: float = 0.5) -> torch.Tensor:
    angle = 2 * torch.pi * torch.arange(count, dtype=torch.float64) / count
    return radius * torch.stack([angle.cos(), angle.sin()], dim=-1)


def test_a_ring_is_closed_under_thirds_of_a_turn():
    samples = torch.arange(6.0)
    assert points(PointGroup.rotation(3), ring(6))(samples, "rot-120").tolist() == [4, 5, 0, 1, 2, 3]


@pytest.mark.parametrize(
    "layout, group, message",
    [
        (ring(4), "C3", r"not closed under 'rot-120': point 0 at \(0.5, 0\) is sent to \(-0.25, 0.433\)"),
        (ring(5) + 0.1, "reflect-y", "not closed under 'reflect-y'.*center the layout on the axis"),
        ([[0.1, 0.2], [0.1, 0.2]], "trivial", "expected distinct points, got two within 1e-06 m"),
        ([[0.1, float("nan")]], "trivial", "positions: expected finite numbers, got NaN or infinity"),
        ([[0.1]], "trivial", r"expected positions of shape \(P, 2\) or \(P, 3\), got \(1, 1\)"),
        (torch.zeros(0, 2), "trivial", r"expected positions of shape .* got \(0, 2\)"),
        (ring(4), "cube", "a group that fixes the vertical axis"),
    ],
)
def test_bad_layouts_are_refused(layout, group, message):
    with pytest.raises(ValueError, match=message):
        points(GROUPS[group], layout)


def test_height_map_that_looks_ahead_has_no_fore_aft_symmetry():
    with pytest.raises(ValueError, match=r"point 0 at \(-0.2, -0.1\) is sent to \(0.2, -0.1\)"):
        height_map(PointGroup.reflection("x"), x=[-0.2, 0.5], y=[-0.1, 0.0, 0.1])


# --- orientations against explicit rotations


def rotations(count: int = 8) -> torch.Tensor:
    """Uniformly random rotation matrices, ``(count, 3, 3)``."""
    q, r = torch.linalg.qr(random(count, 3, 3, seed=3))
    q = q * r.diagonal(dim1=-2, dim2=-1).sign()[:, None]
    return q * torch.linalg.det(q)[:, None, None]


def matrix_of(q: torch.Tensor) -> torch.Tensor:
    """Rotation matrix of unit quaternions (w, x, y, z), by the textbook formula."""
    w, x, y, z = q.unbind(-1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def turned(group: PointGroup, action: str, x: torch.Tensor) -> torch.Tensor:
    """R X or R X R^T for every element R: ``(N, ..., 3, 3)``."""
    r = group.matrices[:, None]
    return r @ x if action == "left" else r @ x @ r.mT


LEFT = [("left", name) for name in GROUPS if name in PROPER]
CONJUGATE = [("conjugate", name) for name in GROUPS]


@pytest.mark.parametrize("action, group", LEFT + CONJUGATE)
def test_rotation_matrices_turn(action, group):
    x = rotations()
    image = rotation_matrix(GROUPS[group], action).orbit(x.flatten(-2))
    assert_close(image, turned(GROUPS[group], action, x).flatten(-2))


@pytest.mark.parametrize("action, group", [*LEFT, *(case for case in CONJUGATE if case[1] in VERTICAL)])
def test_pairs_of_columns_turn(action, group):
    x = rotations()
    image = rotation_6d(GROUPS[group], action).orbit(x[..., :2].mT.flatten(-2))
    assert_close(image, turned(GROUPS[group], action, x)[..., :2].mT.flatten(-2))


@pytest.mark.parametrize("action, group", [case for case in LEFT + CONJUGATE if case[1] in VERTICAL])
def test_pairs_of_rows_turn(action, group):
    x = rotations()
    image = rotation_6d(GROUPS[group], action, layout="rows").orbit(x[..., :2, :].flatten(-2))
    assert_close(image, turned(GROUPS[group], action, x)[..., :2, :].flatten(-2))


@pytest.mark.parametrize("scalar_last", [False, True])
@pytest.mark.parametrize("action, group", [*(case for case in LEFT if case[1] in ODD), *CONJUGATE])
def test_quaternions_turn(action, group, scalar_last):
    q = torch.nn.functional.normalize(random(8, 4), dim=-1)  # (w, x, y, z)
    entries = q.roll(-1, -1) if scalar_last else q
    image = quaternion(GROUPS[group], action, scalar_last=scalar_last).orbit(entries)
    image = image.roll(1, -1) if scalar_last else image
    assert_close(matrix_of(image), turned(GROUPS[group], action, matrix_of(q)))


def test_three_turns_of_a_third_bring_a_quaternion_back():
    rho = quaternion(PointGroup.rotation(3)).matrices[1]
    assert_close(torch.linalg.matrix_power(rho, 3), torch.eye(4, dtype=torch.float64))
    lift = torch.tensor([-0.5, 0, 0, -(0.75**0.5)], dtype=torch.float64)  # -q of 120 degrees
    assert_close(rho[:, 0], lift)


@pytest.mark.parametrize("group, order", [("C2", 4), ("C4", 8)])
def test_quaternion_of_an_even_turn_has_no_lift(group, order):
    remedy = (
        rf"has order {order} with either sign.*rotation_matrix or rotation_6d, or use action='conjugate'"
    )
    with pytest.raises(ValueError, match=remedy):
        quaternion(GROUPS[group])


def test_klein_four_conjugation_is_a_sign_per_entry():
    expected = torch.tensor([[1, 1, 1, 1], [1, 1, -1, -1], [1, -1, 1, -1], [1, -1, -1, 1]])
    rep = quaternion(PointGroup.klein_four(), "conjugate")
    assert rep.is_signed_permutation
    assert torch.equal(rep.matrices, torch.diag_embed(expected).double())


@pytest.mark.parametrize("builder", [rotation_matrix, rotation_6d, quaternion])
def test_reflections_refuse_to_act_from_the_left(builder):
    with pytest.raises(ValueError, match=rf"'reflect-y' is a reflection.*{builder.__name__}.*'conjugate'"):
        builder(PointGroup.reflection("y"))


@pytest.mark.parametrize("builder", [rotation_matrix, rotation_6d, quaternion])
def test_action_is_left_or_conjugate(builder):
    with pytest.raises(ValueError, match=r"action: expected one of \['left', 'conjugate'\], got 'right'"):
        builder(PointGroup.rotation(3), "right")


# --- named entries

LEGS = ("LF", "RF", "LH", "RH")
JOINTS = [f"{leg}_{joint}" for leg in LEGS for joint in ("HAA", "HFE", "KFE")]


def leg_swap(first: str, second: str, flipped: tuple[str, ...]) -> dict[str, str]:
    """Exchange two letters in the names of the legs and flip the sign of some joints."""
    swap = str.maketrans(first + second, second + first)
    targets = {name: name[:2].translate(swap) + name[2:] for name in JOINTS}
    return {name: ("-" if name.endswith(flipped) else "") + target for name, target in targets.items()}


def test_joints_of_anymal():
    maps = {"reflect-x": leg_swap("F", "H", ("HFE", "KFE")), "reflect-y": leg_swap("L", "R", ("HAA",))}
    rep = signed_permutation(PointGroup.klein_four(), JOINTS, maps)
    q = torch.arange(12) + 100
    left_right = torch.tensor([3, 4, 5, 0, 1, 2, 9, 10, 11, 6, 7, 8])
    front_back = torch.tensor([6, 7, 8, 9, 10, 11, 0, 1, 2, 3, 4, 5])
    assert torch.equal(rep(q, "reflect-y"), q[left_right] * torch.tensor([-1, 1, 1] * 4))
    assert torch.equal(rep(q, "reflect-x"), q[front_back] * torch.tensor([1, -1, -1] * 4))
    assert torch.equal(rep(q, "rot-180"), -q[left_right][front_back])


def test_fingers_take_turns():
    fingers = ["f0", "f120", "f240"]
    turn = {"f0": "f120", "f120": "f240", "f240": "f0"}
    rep = permutation(PointGroup.rotation(3), fingers, {"rot-120": turn})
    assert rep.orbit(torch.arange(3)).tolist() == [[0, 1, 2], [2, 0, 1], [1, 2, 0]]


SWAP = {"a": "-b", "b": "-a"}
KEEP = {"a": "a", "b": "b"}


@pytest.mark.parametrize(
    "group, maps, message",
    [
        (
            "C2",
            {"rot-180": {"a": "c", "b": "a"}},
            r"'rot-180' maps the unknown entry 'c'; there are \['a', 'b'\]",
        ),
        ("C2", {"rot-180": {**KEEP, "c": "a"}}, "'rot-180' maps the unknown entry 'c'"),
        ("C2", {"rot-180": {"a": "b", "b": "-b"}}, "two entries are sent to 'b', one is 'b'"),
        ("C2", {"rot-180": {"a": "a"}}, r"'rot-180' does not say where \['b'\] go"),
        ("C2", {}, r"do not generate the group: no map for \['rot-180'\]; add theirs"),
        ("K4", {"reflect-x": SWAP}, r"no map for \['reflect-y', 'rot-180'\]"),
        (
            "C2",
            {"rot-180": {"a": "b", "b": "-a"}},
            r"rho\(rot-180\) rho\(rot-180\) differs from rho\(identity\)",
        ),
        (
            "C2",
            {"rot-180": SWAP, "identity": SWAP},
            r"not a representation: rho\(identity\) rho\(identity\)",
        ),
        ("K4", dict.fromkeys(["reflect-x", "reflect-y", "rot-180"], SWAP), "not a representation"),
    ],
)
def test_bad_maps_are_refused(group, maps, message):
    with pytest.raises(ValueError, match=message):
        signed_permutation(GROUPS[group], ["a", "b"], maps)


def test_names_are_distinct_and_elements_known():
    with pytest.raises(ValueError, match=r"expected distinct names, got \['a', 'a'\]"):
        signed_permutation(PointGroup.rotation(2), ["a", "a"], {})
    with pytest.raises(KeyError, match="no element 'rot-90'"):
        signed_permutation(PointGroup.rotation(2), ["a", "b"], {"rot-90": SWAP})
    with pytest.raises(ValueError, match="'rot-180' sends 'a' to '-b': expected no sign"):
        permutation(PointGroup.rotation(2), ["a", "b"], {"rot-180": SWAP})
