"""Images and gait clocks against what they show: flipped arrays, cameras in space, phases."""

import math

import pytest
import torch

from tests.point_groups import GROUPS, assert_close, cube, random
from torchrl_sym import PointGroup
from torchrl_sym.representations import gait_clock, image, items, permutation, planar, pseudoscalar

K4, D4, MIRROR = GROUPS["K4"], GROUPS["D4"], PointGroup.reflection("y")
FLIPS = {  # of an image seen from above, up is forward, left is left
    "reflect-x": lambda x: x.flip(0),
    "reflect-y": lambda x: x.flip(1),
    "rot-180": lambda x: x.flip(0, 1),
    "rot-90": lambda x: x.rot90(1),  # anti-clockwise, seen from above
    "rot-270": lambda x: x.rot90(-1),
}


@pytest.mark.parametrize("element", FLIPS)
@pytest.mark.parametrize("layout", ["HW", "HWC", "CHW"])
def test_image_from_above_is_flipped_and_turned(layout, element):
    x = torch.randint(256, (5, 5, 3), dtype=torch.uint8, generator=torch.Generator().manual_seed(0))
    shown = FLIPS[element](x)
    arranged = {"HW": lambda x: x[..., 0], "HWC": lambda x: x, "CHW": lambda x: x.movedim(-1, 0)}[layout]
    rep = image(D4, arranged(x).shape, layout)
    assert rep.event_shape == arranged(x).shape
    assert torch.equal(rep(arranged(x), element), arranged(shown))


def test_images_need_not_be_square_where_nothing_turns():
    x = torch.arange(2 * 4 * 6).reshape(2, 4, 6)
    for element in ("reflect-x", "reflect-y", "rot-180"):
        expected = torch.stack([FLIPS[element](frame) for frame in x])
        assert torch.equal(image(K4, (4, 6))(x, element), expected)


def test_flow_turns_with_the_image():
    line = torch.arange(4, dtype=torch.float64) - 1.5
    p = -torch.cartesian_prod(line, line).unflatten(0, (4, 4))  # (x, y) of every pixel
    flow = torch.stack([p[..., 1] ** 2 + p[..., 0], p[..., 0].exp() * p[..., 1]], -1)

    def field(q: torch.Tensor) -> torch.Tensor:
        return torch.stack([q[..., 1] ** 2 + q[..., 0], q[..., 0].exp() * q[..., 1]], -1)

    turns = D4.matrices[:, :2, :2]
    moved = torch.stack([field(p @ r) @ r.T for r in turns])  # p @ r is r^-1 p
    assert_close(image(D4, (4, 4, 2), "HWC", value=planar(D4)).orbit(flow), moved)
    channels_first = image(D4, (2, 4, 4), "CHW", value=planar(D4)).orbit(flow.movedim(-1, 0))
    assert_close(channels_first, moved.movedim(-1, 1))


def brightness(direction: torch.Tensor) -> torch.Tensor:
    """Of a scene around the robot, without symmetry."""
    x, y, z = direction.unbind(-1)
    return torch.sin(x + 2 * y) + torch.cos(3 * z - y) + x * z


def seen(forward: tuple[float, float], scene) -> torch.Tensor:
    """What an upright camera shows of a scene, ``(4, 5)``."""
    rows, columns = torch.linspace(-0.6, 0.6, 4).double(), torch.linspace(-0.8, 0.8, 5).double()
    ahead = torch.tensor([*forward, 0.0], dtype=torch.float64)
    right = torch.tensor([forward[1], -forward[0], 0.0], dtype=torch.float64)
    down = torch.tensor([0.0, 0, -1], dtype=torch.float64)
    return scene(ahead + rows[:, None, None] * down + columns[:, None] * right)


def test_a_front_camera_is_flipped_by_left_and_right():
    front = image(MIRROR, (4, 5), rows="-z", columns="-y")
    mirrored = seen((1, 0), lambda d: brightness(d @ MIRROR.matrices[1]))
    assert_close(front(seen((1, 0), brightness), 1), mirrored)
    assert torch.equal(image(MIRROR, (4, 5), rows="-z", columns="right").matrices, front.matrices)


def test_cameras_all_around_change_places():
    names = ["front", "left", "rear", "right"]
    turn = dict(zip(names, [*names[1:], names[0]], strict=True))
    swap = {"front": "front", "left": "right", "rear": "rear", "right": "left"}
    cameras = permutation(D4, names, {"rot-90": turn, "reflect-y": swap})
    rep = items(cameras, image(D4, (4, 5), rows="-z", columns="right"))
    directions = [(1, 0), (0, 1), (-1, 0), (0, -1)]
    shown = torch.stack([seen(forward, brightness) for forward in directions])
    for g, r in enumerate(D4.matrices):
        moved = torch.stack([seen(forward, lambda d, r=r: brightness(d @ r)) for forward in directions])
        assert_close(rep(shown, g), moved)


@pytest.mark.parametrize(
    "group, arguments, message",
    [
        (
            K4,
            {"rows": "-z", "columns": "-y"},
            r"fixes the x axis, but 'reflect-x' moves it.*items\(cameras",
        ),
        (cube(), {}, "fixes the z axis, but .* moves it"),
        (cube(), {"rows": "-z", "columns": "right"}, "fixes the z axis"),
        (K4, {"rows": "-x", "columns": "right"}, "rows: expected 'z' or '-z'"),
        (K4, {"rows": "x", "columns": "-x"}, "along two axes, got 'x' and '-x'"),
        (GROUPS["C3"], {}, "'rot-120' turns the image by other than right angles"),
        (GROUPS["C4"], {"shape": (4, 6)}, r"'rot-90' turns rows into columns: expected a square.* 4 x 6"),
        (K4, {"shape": (4, 4, 3)}, r"shape: expected 2 sizes, those of 'HW', got \(4, 4, 3\)"),
        (K4, {"shape": (9999, 9999)}, "expected at most 1000000 entries"),
        (K4, {"value": planar(K4)}, "value: expected one of 1 channels"),
        (K4, {"value": pseudoscalar(MIRROR)}, "a value of the same group"),
    ],
)
def test_images_that_an_element_has_no_image_of_are_refused(group, arguments, message):
    with pytest.raises(ValueError, match=message):
        image(group, **{"shape": (4, 4)} | arguments)


# --- clocks


def test_half_a_period_is_a_change_of_sign():
    clock = gait_clock(K4, {"reflect-x": 0.5, "reflect-y": 0.5})
    assert clock.is_signed_permutation
    x = random(3, 2)
    assert torch.equal(clock.orbit(x), torch.stack([x, -x, -x, x]))


@pytest.mark.parametrize("group, n", [("C3", 3), ("C4", 4), ("C5", 5)])
def test_legs_that_step_in_turn_are_a_part_of_the_period_apart(group, n):
    clock = gait_clock(GROUPS[group], {GROUPS[group].names[1]: 1 / n})
    phase = 2 * math.pi * random(7)
    for k in range(n):
        later = phase + 2 * math.pi * k / n
        image_of = clock(torch.stack([phase.sin(), phase.cos()], -1), k)
        assert_close(image_of, torch.stack([later.sin(), later.cos()], -1))


@pytest.mark.parametrize(
    "group, shifts, message",
    [
        ("K4", {"reflect-x": 0.5}, r"the shifts for \['reflect-x'\] do not generate the group"),
        ("K4", {"reflect-x": 0.25, "reflect-y": 0.5}, "a multiple of 1/2 for 'reflect-x'.*got 0.25"),
        ("C3", {"rot-120": 0.33}, "a multiple of 1/3 for 'rot-120'"),
        ("C3", {"rot-120": 1 / 3, "rot-240": 1 / 3}, "shifts contradict one another: expected 1/3"),
        ("D3", {"rot-120": 1 / 3, "reflect-y": 0.5}, "shifts contradict one another"),
        ("K4", {"reflect-x": 0.5, "reflect-y": 0.5, "rot-180": 0.5}, "shifts contradict one another"),
        (
            "C2",
            {"identity": 0.0, "rot-180": float("nan")},
            r"shifts\['rot-180'\]: expected a finite number",
        ),
    ],
)
def test_shifts_that_contradict_are_refused(group, shifts, message):
    with pytest.raises(ValueError, match=message):
        gait_clock(GROUPS[group], shifts)
