"""derive finds where the axis is, and that it does not matter where free objects lie."""

import time

import numpy as np
import pytest
import torch

from tests.robots import text
from tests.test_mujoco_poses import ARMS, C3, C4, FLOOR, MOTORS, X, Y, box, commutes, load, robot
from torchrl_sym.mujoco import SymmetryError, audit, derive

# --- free objects and mocap bodies


@pytest.mark.parametrize(
    "more",
    [
        "",
        'euler="0 0 .5"',
        'euler="1.57079632679 0 .4"',
        'quat=".7 .1 -.5 .3"',
    ],
)
def test_where_an_object_lies_and_how_is_a_state(more):
    compiled = load(FLOOR + ARMS + box("block", ".1 .2 .3", ".02 .03 .05", more))
    found = derive(compiled, Y)
    assert found.table("body", 1) == {"world": "world", "left": "right", "right": "left", "block": "block"}
    assert audit(compiled, Y).exact, str(audit(compiled, Y))
    assert commutes(compiled, Y) <= 1e-9
    compiled.body_inertia[compiled.body("block").id] *= (1.0, 1.3, 0.8)
    assert audit(compiled, Y).exact  # its principal axes are those of its shape


def test_shape_decides_between_objects_that_start_in_mirrored_places():
    ball = '<body name="ball" pos="0 -.2 .03"><freejoint/><geom size=".03" mass=".1"/></body>'
    compiled = load(FLOOR + box("peg", "0 .2 .03", ".06 .02 .02") + ball)
    assert derive(compiled, Y).table("body", 1) == {"world": "world", "peg": "peg", "ball": "ball"}
    assert audit(compiled, Y).exact


def test_names_decide_between_equal_objects_then_places_then_nothing():
    named = load(FLOOR + box("left_cube", ".3 .1 .03") + box("right_cube", "0 .2 .5"))
    found = derive(named, Y)
    assert found.table("body", 1)["left_cube"] == "right_cube"
    assert derive(named, X).table("body", 1)["left_cube"] == "left_cube"
    assert found.ambiguous == ()
    placed = load(FLOOR + box("a", ".3 .1 .03") + box("b", ".3 -.1 .03"))
    assert derive(placed, Y).table("body", 1)["a"] == "b"
    anyhow = load(FLOOR + box("a", ".3 .1 .03") + box("b", ".1 -.1 .03"))
    found = derive(anyhow, Y)
    assert found.table("body", 1)["a"] == "a"
    assert "a, b are alike" in found.ambiguous[0]
    assert "ambiguous: a, b are alike" in str(found)
    for compiled in (named, placed, anyhow):
        assert audit(compiled, Y).exact
        assert commutes(compiled, Y) <= 1e-9


def test_two_free_robots_that_are_images_of_each_other_only():
    """A left and a right hand: neither is symmetric, each is the other's image, wherever they are."""

    def hand(name: str, side: int, place: str) -> str:
        return f"""<body name="{name}" pos="{place}"><freejoint/>
          <geom type="box" size=".1 .05 .02" mass="1"/>
          <body pos=".1 {0.04 * side} 0"><joint name="{name}_thumb" axis="0 0 1"/>
            <geom type="capsule" fromto="0 0 0 .02 {0.06 * side} 0" size=".01" mass=".1"/></body></body>"""

    compiled = load(FLOOR + hand("left", 1, "1 2 .5") + hand("right", -1, "0 0 .7"))
    assert derive(compiled, Y).table("joint", 1)["left_thumb"] == "-right_thumb"
    assert audit(compiled, Y).exact
    assert commutes(compiled, Y) <= 1e-9
    with pytest.raises(SymmetryError, match="has no image"):
        derive(load(FLOOR + hand("left", 1, "1 2 .5") + hand("other", 1, "0 0 .7")), Y)


def test_a_mocap_body_may_be_anywhere_about_an_axis_elsewhere():
    target = """<body name="target" mocap="true" pos=".3 .4 .5">
      <geom size=".02" contype="0" conaffinity="0"/></body>"""
    compiled = load(ARMS.replace("0 0.3 .2", "0 1.3 .2").replace("0 -0.3 .2", "0 .7 .2") + target)
    found = derive(compiled, Y)
    assert found.axis == pytest.approx((0.0, 1.0))
    place, turn = found.map_mocap(torch.tensor([[0.3, 0.4, 0.5]]), torch.tensor([[1.0, 0, 0, 0]]), 1)
    torch.testing.assert_close(place, torch.tensor([[0.3, 1.6, 0.5]]))
    assert turn.abs().tolist() == [[1.0, 0.0, 0.0, 0.0]]


def test_64_cubes_take_less_than_half_a_second():
    cubes = "".join(box(f"c{k}", f"{k % 8 * 0.2} {k // 8 * 0.2} .1") for k in range(64))
    compiled = load(FLOOR + cubes)
    start = time.process_time()
    derive(compiled, Y)
    assert time.process_time() - start < 0.5


# --- where the axis is


def test_the_plane_of_two_arms_on_a_table_is_found():
    world = ARMS.replace("0 0.3 .2", "2 .8 .2").replace("0 -0.3 .2", "2 .2 .2")
    compiled = load(FLOOR + world + box("cube", "0 0 .03"))
    found = derive(compiled, Y)
    assert found.axis == pytest.approx((0.0, 0.5))
    assert found.table("joint", 1) == {"left": "-right", "right": "-left", "joint 2": "joint 2"}
    assert audit(compiled, Y).exact
    assert commutes(compiled, Y) <= 1e-9
    qpos = torch.zeros(9, dtype=torch.float64)
    qpos[2:6] = torch.tensor([0.1, 0.2, 0.3, 1.0])
    assert found.map_qpos(qpos, 1)[2:5].tolist() == pytest.approx([0.1, 0.8, 0.3])
    with pytest.raises(SymmetryError, match=r"has no image under 'reflect-y'.*mm"):
        derive(compiled, Y, axis=(0.0, 0.0))
    assert derive(compiled, Y, axis=(7.0, 0.5)).table("joint", 1)["left"] == "-right"


def test_the_axis_of_three_fingers_is_found():
    turns = [(np.cos(a), np.sin(a)) for a in 2 * np.pi / 3 * np.arange(3)]
    fingers = "".join(
        f"""<body name="f{k}" pos="{text((1 + 0.2 * c, 2 + 0.2 * s, 0.3))}" euler="0 0 {2.0943951 * k}">
        <joint name="f{k}" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 -.1 0 -.1" size=".01"/></body>"""
        for k, (c, s) in enumerate(turns)
    )
    compiled = load(fingers)
    found = derive(compiled, C3)
    assert found.axis == pytest.approx((1.0, 2.0))
    assert found.table("joint", 1) == {"f0": "f1", "f1": "f2", "f2": "f0"}
    assert audit(compiled, C3).exact
    with pytest.raises(SymmetryError):
        derive(compiled, C4)


def test_no_axis_is_found_for_arms_that_are_no_images():
    world = ARMS.replace('fromto="0 0 0 0 0.2 0"', 'fromto="0 0 0 .15 .2 0"')
    assert world != ARMS
    with pytest.raises(SymmetryError, match="has no image"):
        derive(load(world.replace("0 0.3 .2", "0 .8 .2")), Y)


def test_a_leg_is_not_sent_to_itself_because_its_hinge_crosses_the_plane():
    """A hinge's anchor may be anywhere on its axis: the axes of a fixed base at y = 1 cross every plane."""
    legs = robot('pos="0 1 1"').replace("<freejoint/>", "")
    compiled = load(FLOOR + legs, MOTORS)
    with pytest.raises(SymmetryError, match=r"left has no image.*centre of mass \d+\.\d mm beside it"):
        derive(compiled, Y, axis=(0.0, 0.0))
    found = derive(compiled, Y)
    assert found.axis == pytest.approx((0.0, 1.0))
    assert found.table("joint", 1) == {"left": "right", "right": "left"}


@pytest.mark.parametrize(
    ("axis", "error"), [(3.0, TypeError), ((1.0,), ValueError), ((1.0, np.nan), ValueError)]
)
def test_an_axis_is_two_numbers(axis, error):
    with pytest.raises(error, match="axis"):
        derive(load(ARMS), Y, axis=axis)
