"""Verdicts that a roboticist would give: what is much, what is the same thing written in another way."""

import mujoco
import pytest

from torchrl_sym import PointGroup
from torchrl_sym.mujoco import audit, derive

MIRROR = PointGroup.reflection("y")
PENDULUM = """<mujoco><option gravity="{gravity}"/><worldbody>
  <body name="pole"><joint name="hinge" axis="0 1 0"/>
  <geom type="capsule" fromto="0 0 0 0 0 .5" size=".02"/></body></worldbody></mujoco>"""


def test_a_hair_of_tilt_is_approximate_and_a_slope_is_none():
    tilted = mujoco.MjModel.from_xml_string(PENDULUM.format(gravity="1e-5 0 -9.81"))
    report = audit(tilted, PointGroup.reflection("x"))
    assert report.outcome == "approximate"
    assert (report.worst.term, report.worst.residual) == ("gravity", pytest.approx(2e-5 / 9.81))
    slope = mujoco.MjModel.from_xml_string(PENDULUM.format(gravity="1 0 -9.81"))
    assert audit(slope, PointGroup.reflection("x")).outcome == "no"


def test_what_cannot_move_is_not_compared():
    stone = """<mujoco><worldbody><body name="drone"><geom type="box" size=".1 .05 .02"/>{}</body>
      </worldbody></mujoco>"""
    still, free = (
        audit(mujoco.MjModel.from_xml_string(stone.format(x)), MIRROR) for x in ("", "<freejoint/>")
    )
    assert still.outcome == "nothing" and not still.exact
    assert still.verdict.startswith("nothing to compare (")
    assert free.outcome == "exact"


FINGERS = """<mujoco><compiler autolimits="true"/><worldbody><body name="palm" pos="0 0 .2">
  <joint name="lift" type="slide" axis="0 0 1"/><geom type="box" size=".03 .06 .02" mass="1"/>
  <body name="left" pos="0 .03 .05"><joint name="left" type="slide" axis="0 {a} 0" range="{left}"
    {more_left}/>
    <geom type="box" size=".01 .005 .03" mass=".1"/></body>
  <body name="right" pos="0 -.03 .05"><joint name="right" type="slide" axis="0 -1 0" range="0 .03"
    {more_right}/>
    <geom type="box" size=".01 .005 .03" mass=".1"/></body></body></worldbody>
  <equality>{equality}</equality></mujoco>"""


def fingers(equality, a=1, left="0 .03", **more):
    more = {"more_left": "", "more_right": ""} | more
    return mujoco.MjModel.from_xml_string(FINGERS.format(a=a, left=left, equality=equality, **more))


@pytest.mark.parametrize(
    ("equality", "a", "left", "outcome"),
    [
        ('<joint joint1="left" joint2="right"/>', 1, "0 .03", "exact"),
        ('<joint joint1="left" joint2="right" polycoef="0 -1 0 0 0"/>', -1, "-.03 0", "exact"),
        ('<joint joint1="left" joint2="right" polycoef=".01 1 0 0 0"/>', 1, "0 .03", "approximate"),
        ('<joint joint1="left" joint2="right" polycoef="0 2 0 0 0"/>', 1, "0 .03", "no"),
        ('<joint joint1="left" joint2="right" polycoef="0 1 .5 0 0"/>', 1, "0 .03", "no"),
        ('<joint joint1="left"/>', 1, "0 .03", "no"),
    ],
)
def test_a_linear_constraint_may_be_written_either_way(equality, a, left, outcome):
    assert audit(fingers(equality, a, left), MIRROR).outcome == outcome


def test_only_the_sum_of_what_a_constraint_makes_one_counts():
    losses = {"more_left": 'damping="2" armature=".5"', "more_right": 'damping=".1" armature=".01"'}
    tied = audit(fingers('<joint joint1="left" joint2="right"/>', **losses), MIRROR)
    assert tied.outcome == "approximate"
    loose = audit(
        fingers('<joint joint1="left" joint2="right" active="false"/>', **losses),
        MIRROR,
    )
    assert loose.outcome == "no"


def rods(*places):
    """Two four-bar linkages, each closed by two connects somewhere along the axis of its last hinge."""
    bars = "".join(
        f'''<body name="{side}" pos="0 {y} 0"><joint axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 .2 0 -.1" size=".02" mass="1" contype="0"
          conaffinity="0"/></body>
        <body name="{side}_rod" pos=".4 {y} 0"><joint axis="0 1 0"/>
        <geom type="capsule" fromto="0 0 0 -.2 0 -.1" size=".02" mass="1" contype="0"
          conaffinity="0"/></body>'''
        for side, y in (("left", 0.15), ("right", -0.15))
    )
    connects = "".join(
        f'<connect body1="{side}" body2="{side}_rod" anchor="{x} {y} {z}"/>'
        for side, pins in zip(("left", "right"), (places[:2], places[2:]), strict=True)
        for x, y, z in pins
    )
    return mujoco.MjModel.from_xml_string(
        f"""<mujoco><worldbody>
        <body name="base"><freejoint/><geom type="box" size=".2 .1 .05"/>{bars}</body>
        </worldbody><equality>{connects}</equality></mujoco>"""
    )


def test_two_connects_close_a_hinge_wherever_along_its_axis_they_are():
    left = (0.2, 0.0, -0.1), (0.2, 0.1, -0.1)
    for right, outcome in (
        (((0.2, 0.0, -0.1), (0.2, -0.1, -0.1)), "exact"),
        (((0.2, 0.3, -0.1), (0.2, -0.2, -0.1)), "approximate"),
        (((0.2, 0.0, 0.1), (0.2, -0.1, 0.1)), "no"),
    ):
        assert audit(rods(*left, *right), MIRROR).outcome == outcome


def test_one_mismatch_does_not_decide_alone_in_silence():
    model = fingers('<joint joint1="left"/>', more_left='damping=".01"')
    verdict = audit(model, MIRROR).verdict
    assert verdict.startswith("not a symmetry (1: equality constraints")
    assert "; without it: approximate (largest residual" in verdict


def test_friction_is_compared_with_what_the_joint_can_do():
    pair = """<mujoco><worldbody>
      <body name="base" pos="0 0 1"><freejoint/><geom size=".1" mass="5"/>{}</body>
      </worldbody></mujoco>"""
    leg = """<body name="{0}" pos="0 {1} 0"><joint name="{0}" axis="0 1 0" frictionloss="{2}" {3}/>
      <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass="1"/></body>"""
    residuals = []
    for limit in (
        'actuatorfrcrange="-40 40"',
        'actuatorfrcrange="-2 2"',
        "",
        'actuatorfrcrange="-1e9 1e9"',
    ):
        legs = leg.format("left", 0.15, 0.1, limit) + leg.format("right", -0.15, 0.2, limit)
        report = audit(mujoco.MjModel.from_xml_string(pair.format(legs)), MIRROR)
        assert report.worst.term == "frictionloss"
        residuals.append(report.worst.residual)
    weight = 9.81 * 1 * 0.15
    assert residuals[:3] == pytest.approx([0.1 / 40, 0.1 / 2, 0.1 / weight])
    assert residuals[3] == pytest.approx(0.5e-3), "no motor makes a difference of friction vanish"


WHEELS = """<mujoco><worldbody>
  <body name="left" pos="0 .2 1"><joint name="left" axis="0 1 0"/><geom size=".1" pos=".1 0 0"/></body>
  <body name="right" pos="0 -.2 1"><joint name="right" axis="0 -1 0"/><geom size=".1" pos=".1 0 0"/></body>
  </worldbody><actuator>{left}{right}</actuator></mujoco>"""


@pytest.mark.parametrize(
    ("actuator", "image", "outcome"),
    [
        ('<damper joint="{0}" name="{0}" kv="2" ctrlrange="0 1"/>', "right", "exact"),
        ('<motor joint="{0}" name="{0}" ctrlrange="-1 1"/>', "-right", "exact"),
        ('<motor joint="{0}" name="{0}" ctrlrange="0 1"/>', "-right", "no"),
    ],
)
def test_a_damper_keeps_the_sign_of_its_control(actuator, image, outcome):
    text = WHEELS.format(left=actuator.format("left"), right=actuator.format("right"))
    model = mujoco.MjModel.from_xml_string(text)
    assert derive(model, MIRROR).table("joint", 1)["left"] == "-right"
    assert derive(model, MIRROR).table("actuator", 1)["left"] == image
    assert audit(model, MIRROR).outcome == outcome


@pytest.mark.parametrize(("spin", "outcome"), [(-1, "exact"), (1, "no")])
def test_rotors_of_a_drone_turn_against_each_other(spin, outcome):
    rotor = '<motor name="{0}" site="{0}" gear="0 0 1 0 0 {1}"/>'
    rotors = rotor.format("left", 0.02) + rotor.format("right", spin * 0.02)
    model = mujoco.MjModel.from_xml_string(f"""<mujoco><worldbody>
      <body name="drone" pos="0 0 1"><freejoint/><geom type="box" size=".2 .2 .05"/>
        <site name="left" pos="0 .2 0"/><site name="right" pos="0 -.2 0"/></body>
      </worldbody><actuator>{rotors}</actuator></mujoco>""")
    assert audit(model, MIRROR).outcome == outcome
