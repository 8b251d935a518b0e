"""derive finds poses, axes, headings and places; and refuses what no state of a robot makes symmetric."""

import mujoco
import numpy as np
import pytest
import torch

from tests.robots import anymal, mjcf, model
from tests.test_mujoco_derive import image_of, step_residual
from torchrl_sym import PointGroup
from torchrl_sym.mujoco import SymmetryError, audit, derive, symmetrize
from torchrl_sym.mujoco.derive.names import counterparts

X, Y = PointGroup.reflection("x"), PointGroup.reflection("y")
K4, C3, C4 = PointGroup.klein_four(), PointGroup.rotation(3), PointGroup.rotation(4)


def load(world: str, more: str = "", option: str = "") -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(
        f"""<mujoco><compiler angle="radian" autolimits="true"/><option cone="elliptic" {option}/>
        <worldbody>{world}</worldbody>{more}</mujoco>"""
    )


def robot(
    base: str = 'pos="0 0 1"', left: str = "", right: str = "", more: str = "", hip: str = "0"
) -> str:
    """A body with two legs, a little in front of its middle so that it has a front."""

    def leg(name: str, side: int, joint: str) -> str:
        joint = joint or 'range="-1 1"'
        return f"""<body name="{name}" pos="{hip} {0.15 * side} 0" {joint.partition("|")[2]}>
          <joint name="{name}" axis="0 1 0" {joint.partition("|")[0]}/>
          <geom type="capsule" fromto="0 0 0 .1 0 -.3" size=".02" mass="1"/></body>"""

    return f"""<body name="base" {base}><freejoint/>
      <geom type="box" size=".2 .1 .05" mass="5"/><geom size=".04" pos=".2 0 .05" mass=".5"/>
      {leg("left", 1, left)}{leg("right", -1, right)}</body>{more}"""


FLOOR = '<geom name="floor" type="plane" size="5 5 .1"/>'
MOTORS = '<actuator><motor joint="left"/><motor joint="right"/></actuator>'
ARMS = "".join(
    f"""<body name="{n}" pos="0 {0.3 * s} .2"><joint name="{n}" axis="1 0 0"/>
    <geom type="capsule" fromto="0 0 0 0 {-0.2 * s} 0" size=".02" mass="1"/></body>"""
    for n, s in (("left", 1), ("right", -1))
)


def box(name: str, place: str, size: str = ".03 .03 .03", more: str = "") -> str:
    return f"""<body name="{name}" pos="{place}" {more}><freejoint/>
      <geom type="box" size="{size}" mass=".1"/></body>"""


def commutes(compiled: mujoco.MjModel, group: PointGroup, **options) -> float:
    found = derive(compiled, group, **options)
    return max(
        step_residual(compiled, found, g, seed)[0] for g in range(1, group.order) for seed in range(4)
    )


# --- place and heading of a free base


@pytest.mark.parametrize(
    "base",
    [
        'pos="-1 1 .5"',
        'pos="0 3 .5" euler="0 0 .5"',
        'pos="1 2 .5" euler="0 0 -2.2"',
        'pos="9 -7 .5" euler="0 0 1.5707963"',
    ],
)
def test_where_a_free_base_stands_and_looks_is_a_state(base):
    compiled = load(FLOOR + robot(base), MOTORS)
    found = derive(compiled, Y)
    assert found.table("joint", 1) == {"joint 0": "joint 0", "left": "right", "right": "left"}
    assert found.axis == (0.0, 0.0)
    assert ("heading removed" in found.pose) is ("euler" in base)
    assert audit(compiled, Y).exact, str(audit(compiled, Y))
    assert commutes(compiled, Y) <= 1e-9
    # looking along y it has reflect-x as it is, too
    for group in (
        (K4, C3) if "1.57" in base else (X, K4, C3)
    ):  # it has a front and a back, whichever way it looks
        with pytest.raises(SymmetryError, match="has no image"):
            derive(compiled, group)


def test_no_heading_makes_a_robot_symmetric_front_to_back():
    """A quarter of a turn would exchange the two reflections; a turn per element would allow every one."""
    compiled = load(FLOOR + robot(hip=".1"), MOTORS)
    assert audit(compiled, Y).exact
    assert not audit(compiled, X).exact
    assert not audit(compiled, PointGroup.rotation(2)).exact
    crooked = load(FLOOR + robot(right='range="-1 1"|euler=".4 0 0"'), MOTORS)
    with pytest.raises(SymmetryError, match=r"(left|right) has no image under 'reflect-y'"):
        derive(crooked, Y)


def test_frames_turned_against_their_robot_are_turned_back():
    """The frame's x axis points 20 degrees to the left of where the robot looks."""
    turned = robot().replace('<body name="base" pos="0 0 1">', "").removesuffix("</body>")
    parts = turned.replace("<freejoint/>", "")
    parts = f'<body name="trunk" euler="0 0 .35">{parts}</body>'
    compiled = load(
        FLOOR + f'<body name="base" pos="1 1 1" euler="0 0 .2"><freejoint/>{parts}</body>', MOTORS
    )
    found = derive(compiled, Y)
    assert found.table("joint", 1)["left"] == "right"
    assert "turned by" in found.pose
    assert commutes(compiled, Y) <= 1e-9


def test_base_whose_frame_is_beside_its_plane_has_tables_but_no_matrix():
    legs = "".join(
        f"""<body name="{n}" pos="0 {y} 0"><joint name="{n}" axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass="1"/></body>"""
        for n, y in (("left", 0.35), ("right", 0.05))
    )
    base = '<body name="base" pos="0 0 1"><freejoint/><geom type="box" pos="0 .2 0" size=".2 .1 .05"/>'
    compiled = load(f"{FLOOR}{base}{legs}</body>", MOTORS)
    found = derive(compiled, Y)
    assert found.table("joint", 1)["left"] == "right"
    assert audit(compiled, Y).exact
    for use in (lambda: found.map_qpos(torch.zeros(9), 1), lambda: found.map_qvel(torch.zeros(8), 1)):
        with pytest.raises(ValueError, match=r"the frame of base is 200 mm beside.*move the frame"):
            use()
    spec = mujoco.MjSpec.from_string(mujoco_xml(f"{FLOOR}{base}{legs}</body>"))
    with pytest.raises(SymmetryError, match="frame of base is 200 mm beside"):
        symmetrize(spec, Y)


def mujoco_xml(world: str) -> str:
    return f'<mujoco><compiler angle="radian"/><worldbody>{world}</worldbody></mujoco>'


def test_symmetrize_leaves_free_bodies_where_they_stand():
    world = FLOOR + robot('pos="-1 1 .5" euler="0 0 .3"', more=box("cube", ".4 .3 .03"))
    spec = mujoco.MjSpec.from_string(mujoco_xml(world))
    spec.body("left").pos[2] += 0.002
    spec.body("left").geoms[0].mass = 1.02
    before = spec.compile()
    assert not audit(before, Y).exact
    after = symmetrize(spec, Y).compile()
    assert audit(after, Y).exact, str(audit(after, Y))
    assert after.qpos0 == pytest.approx(before.qpos0, abs=1e-12)
    assert after.body("base").quat == pytest.approx(before.body("base").quat, abs=1e-12)


# --- poses


def test_the_pose_is_found_and_said():
    keys = '<keyframe><key name="odd" qpos="{b} .4 -.6"/><key name="home" qpos="{b} .4 .4"/></keyframe>'
    raised = robot(right='ref=".7"')
    straight = load(FLOOR + robot(), MOTORS + keys.format(b="0 0 1 1 0 0 0"))
    assert derive(straight, Y).pose == "qpos0"
    assert derive(straight, Y, "home").pose == "keyframe 'home'"
    compiled = load(FLOOR + raised, MOTORS)
    assert derive(compiled, Y).offsets(1) == pytest.approx({"left": 0.7, "right": -0.7})
    bent = load(FLOOR + robot(right='range="-1 1"|euler="0 .5 0"'), MOTORS + keys.format(b="0 0 1 1 0 0 0"))
    with pytest.raises(SymmetryError, match=r"left has no image.*at keyframe 'odd'"):
        derive(bent, Y, "odd")


def test_middle_of_ranges():
    turned = robot(left='range="-1.5 1.5"', right='range="-2.5 .5"|euler="0 1 0"')
    compiled = load(FLOOR + turned, MOTORS)
    found = derive(compiled, Y)
    assert found.pose == "joints at the middle of their ranges"
    assert found.offsets(1) == pytest.approx({"left": -1.0, "right": 1.0})
    assert audit(compiled, Y).exact
    assert commutes(compiled, Y) <= 1e-9
    assert "offsets of positions under reflect-y: left -1, right +1" in str(found)


@pytest.mark.parametrize("ends", [False, True])
def test_a_pose_is_solved_for_from_the_root_to_the_leaves(ends):
    """No pose in the file is symmetric, and no range says what is meant: two joints per leg are off."""

    def leg(name: str, side: int, hip: float, knee: float) -> str:
        tip = '<geom size=".02" pos="0 0 -.2" mass=".2"/>' if ends else ""
        return f"""<body name="{name}" pos="0 {0.15 * side} 0" euler="0 {hip} 0">
          <joint name="{name}" axis="0 1 0"/>
          <geom type="capsule" fromto="0 0 0 0 0 -.2" size=".02" mass="1"/>
          <body name="{name}_shin" pos="0 0 -.2" euler="{side * knee} 0 0">
          <joint name="{name}_shin" axis="1 0 0"/>
          <geom type="capsule" fromto="0 0 0 0 {0.05 * side} -.2" size=".02" mass=".7"/>{tip}
          </body></body>"""

    trunk = '<body name="base" pos="0 0 1"><freejoint/><geom type="box" size=".2 .1 .05" mass="5"/>'
    compiled = load(f"{trunk}{leg('left', 1, 0.0, 0.0)}{leg('right', -1, 0.9, -0.6)}</body>")
    found = derive(compiled, Y)
    assert "joints moved" in found.pose
    assert found.table("joint", 1)["left"] == "right"
    assert found.table("joint", 1)["left_shin"] == "-right_shin"
    assert found.offsets(1)["left"] == pytest.approx(-0.9)
    assert audit(compiled, Y).exact, str(audit(compiled, Y))
    assert commutes(compiled, Y) <= 1e-9


def test_solving_does_not_turn_limited_joints_out_of_their_ranges():
    compiled = load(FLOOR + robot(right='range="-1 1"|euler="0 .9 0"'), MOTORS)
    with pytest.raises(SymmetryError, match="has no image"):
        derive(compiled, Y)


def test_keyframes_that_are_symmetric_to_a_thousandth_leave_no_offsets():
    key = '<keyframe><key name="home" qpos="0 0 1 .9999 .002 .001 .003 .4 .4045"/></keyframe>'
    compiled = load(FLOOR + robot(), MOTORS + key)
    found = derive(compiled, Y, "home")
    assert found.offsets(1) == {}
    assert audit(compiled, Y, "home").exact, str(audit(compiled, Y, "home"))
    assert commutes(compiled, Y, keyframe="home") <= 1e-9
    real = load(FLOOR + robot(right='range="-.995 1.005"|euler="0 -.005 0"'), MOTORS)
    assert derive(real, Y).offsets(1) == pytest.approx({"left": 0.005, "right": -0.005})


def test_positions_with_an_offset_are_not_handed_out_in_silence():
    compiled = load(FLOOR + robot(right='range="-2 0"|euler="0 1 0"'), MOTORS)
    found = derive(compiled, Y)
    with pytest.raises(ValueError, match=r"\['left', 'right'\] have an offset.*relative=True"):
        found.joints(["left", "right"])
    assert found.joints(["left", "right"], relative=True)(torch.tensor([1.0, 2.0]), 1).tolist() == [
        2.0,
        1.0,
    ]


# --- ties, names, messages


@pytest.mark.parametrize("named", [True, False])
def test_fingers_of_a_closed_gripper_change_places(named):
    """Closed, both lie in the plane: names tell them apart, or else ranges."""
    names = ("finger_left", "finger_right") if named else ("a", "b")
    limits = "" if named else 'range="0 .03"'
    fingers = "".join(
        f"""<body name="{n}" pos="0 0 .05"><joint name="{n}" type="slide" axis="0 {s} 0" {limits}/>
        <geom type="box" size=".01 .005 .03" mass="{0.1 + 0.001 * s}"/></body>"""
        for n, s in zip(names, (1, -1), strict=True)
    )
    palm = '<body name="palm" pos="0 0 .2"><joint name="lift" type="slide" axis="0 0 1"/><geom size=".05"/>'
    found = derive(load(f"{palm}{fingers}</body>"), Y)
    assert found.table("joint", 1)[names[0]] == names[1]
    assert found.ambiguous == ()


def test_what_nothing_tells_apart_is_said():
    twins = "".join(
        f'<body name="{n}" pos=".1 0 0"><joint name="{n}" axis="0 1 0"/><geom size=".05"/></body>'
        for n in "ab"
    )
    found = derive(load(twins), Y)
    assert found.table("joint", 1) == {"a": "a", "b": "b"}
    assert found.ambiguous == ("a and b are alike and in one place",)


@pytest.mark.parametrize(
    ("name", "image"),
    [
        ("left_hip", "right_hip"),
        ("LF_KFE", "RF_KFE"),
        ("FL_hip", "FR_hip"),
        ("RR_thigh", "RL_thigh"),
        ("LeftKnee", "RightKnee"),
        ("arm_R", "arm_L"),
        ("l_arm", "r_arm"),
    ],
)
def test_names_of_the_other_side(name, image):
    assert counterparts(name, sides=True, ends=False) == (image,)
    assert name in counterparts(image, sides=True, ends=False)
    assert counterparts("torso_roller", sides=True, ends=True) == ()


def test_messages_say_degrees_and_millimetres_and_where_unnamed_bodies_are():
    base = anymal()
    limbs = list(base.children)
    limbs[0] = limbs[0].__class__(**{**limbs[0].__dict__, "pos": limbs[0].pos + np.array([0.0, 0.0, 0.04])})
    crooked = base.__class__(**{**base.__dict__, "children": tuple(limbs)})
    with pytest.raises(SymmetryError, match=r"LF_HAA.* misses it by 0 degrees and 40 mm"):
        derive(model(crooked), Y)
    unnamed = (
        mjcf(crooked)
        .replace('<joint name="LF_HAA"', "<joint")
        .replace('<position name="LF_HAA" joint="LF_HAA" kp="80" kv="2"/>', "")
    )
    with pytest.raises(SymmetryError, match=r"joint 1 in 'LF_HAA' has no image"):
        derive(mujoco.MjModel.from_xml_string(unnamed), Y)


def test_welded_bodies_are_in_the_table():
    feet = robot()
    for name, y in (("left", 0.0), ("right", 0.0)):
        end = 'size=".02" mass="1"/></body>'
        foot = f"""size=".02" mass="1"/><body name="{name}_foot" pos=".1 {y} -.3">
          <geom size=".03"/></body></body>"""
        feet = feet.replace(end, foot, 1) if name == "left" else foot.join(feet.rsplit(end, 1))
    table = derive(load(FLOOR + feet, MOTORS), Y).table("body", 1)
    assert table["left_foot"] == "right_foot"
    assert table["right_foot"] == "left_foot"


# --- gravity and scale


def test_gravity_may_lean_by_a_hair():
    pole = """<body name="pole"><joint axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 .5" size=".02"/></body>"""
    assert derive(load(pole, option='gravity="1e-5 0 -9.81"'), X).table("body", 1)["pole"] == "pole"
    with pytest.raises(ValueError, match="tilts gravity"):
        derive(load(pole, option='gravity="1 0 -9.81"'), X)


@pytest.mark.parametrize("wall", ["", '<geom type="box" pos="60 0 1" size=".1 60 1"/>'])
def test_walls_do_not_change_the_scale(wall):
    compiled = load(FLOOR + wall + robot(), MOTORS)
    assert derive(compiled, Y).actions[1].matcher.extent == pytest.approx(0.44, abs=0.05)
    with pytest.raises(SymmetryError):
        derive(load(FLOOR + wall + robot(right='range="-1 1"|euler=".2 0 0"'), MOTORS), Y)


def test_image_of_a_state_keeps_the_distance_between_free_bodies():
    compiled = load(FLOOR + robot('pos="-1 1 .5"') + box("cube", ".3 .2 .1"), MOTORS)
    found = derive(compiled, Y)
    data = mujoco.MjData(compiled)
    image = image_of(compiled, found, data, 1)
    for each in (data, image):
        mujoco.mj_forward(compiled, each)
    gap = [each.body("base").xpos - each.body("cube").xpos for each in (data, image)]
    assert gap[1] == pytest.approx(np.array([1.0, -1.0, 1.0]) * gap[0])
