"""Forces that an element would have to turn or change in sign: what is linear does, the rest is refused."""

import mujoco
import pytest

from torchrl_sym import PointGroup
from torchrl_sym.mujoco import audit, derive

_SLIDES = """<mujoco><worldbody><body pos="0 0 .5">
  <joint name="x" type="slide" axis="1 0 0" {joint}/><joint name="y" type="slide" axis="0 1 0" {joint}/>
  <joint axis="0 0 1"/><geom size=".1" mass="1"/></body></worldbody>
  <tendon><fixed name="a" {a}><joint joint="x" coef="1"/></fixed>
  <fixed name="b" {b}><joint joint="y" coef="1"/></fixed></tendon>
  <actuator>{x}{y}</actuator><equality>{equality}</equality></mujoco>"""
_LEGS = """<mujoco><worldbody><body pos="0 0 .5"><freejoint/><geom type="box" size=".2 .1 .05" mass="5"/>
  <body pos="0 .15 0"><joint name="l" axis="{axis}" range="-60 60" {left}/>
  <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass="1"/></body>
  <body pos="0 -.15 0"><joint name="r" axis="{axis}" range="-60 60" {right}/>
  <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass="1"/></body></body></worldbody>
  <tendon><fixed name="tl" {tl}><joint joint="l" coef="1"/></fixed>
  <fixed name="tr" {tr}><joint joint="r" coef="1"/></fixed></tendon>
  <actuator>{actuators}</actuator></mujoco>"""


def _slides(joint="", a="", b="", actuator="", equality=""):
    x, y = (actuator.format(joint=j) for j in "xy")
    return mujoco.MjModel.from_xml_string(
        _SLIDES.format(joint=joint, a=a, b=b, x=x, y=y, equality=equality)
    )


def _legs(actuators="", axis="1 0 0", **more):
    parts = {"left": "", "right": "", "tl": "", "tr": ""} | more
    return mujoco.MjModel.from_xml_string(_LEGS.format(axis=axis, actuators=actuators, **parts))


def _outcome(model, group=None):
    return audit(model, group or PointGroup.reflection("y")).outcome


@pytest.mark.parametrize(
    "parts",
    [
        {"joint": 'damping="1" stiffness="2"'},
        {"a": 'damping="1" stiffness="2"', "b": 'damping="1" stiffness="2"'},
        {"actuator": '<motor joint="{joint}"/>'},
        {"actuator": '<position joint="{joint}" kp="2" kv="1"/>'},
    ],
    ids=str,
)
def test_linear_forces_mix(parts):
    assert _outcome(_slides(**parts), PointGroup.rotation(3)) == "exact"


@pytest.mark.parametrize(
    "parts",
    [
        {"joint": 'frictionloss="5"'},
        {"joint": 'damping="1 5"'},
        {"joint": 'stiffness="1 5"'},
        {"a": 'frictionloss="5"', "b": 'frictionloss="5"'},
        {"a": 'stiffness="5"', "b": 'stiffness="9"'},
        {"a": 'stiffness="5" springlength="-.1 .1"', "b": 'stiffness="5" springlength="-.1 .1"'},
        {"a": 'stiffness="5" springlength=".1"', "b": 'stiffness="5" springlength=".1"'},
        {"equality": '<tendon tendon1="a" tendon2="b"/>'},
        {"actuator": '<muscle joint="{joint}" lengthrange="-1 1"/>'},
        {"actuator": '<general joint="{joint}" gaintype="affine" gainprm="0 0 -2"/>'},
        {"actuator": '<general joint="{joint}" biastype="affine" biasprm="1 0 0"/>'},
        {"actuator": '<motor joint="{joint}" damping="1 .5"/>'},
    ],
    ids=str,
)
def test_what_is_not_linear_does_not(parts):
    assert _outcome(_slides(**parts), PointGroup.rotation(3)) in ("no", "approximate")


def test_a_dampers_control_keeps_its_sign():
    model = _legs("".join(f'<damper name="{j}" joint="{j}" kv="2" ctrlrange="0 1"/>' for j in "lr"))
    assert _outcome(model) == "exact"
    robot = derive(model, PointGroup.reflection("y"))
    assert robot.table("actuator", 1) == {"l": "r", "r": "l"}
    assert robot.table("joint", 1)["l"] == "-r"


@pytest.mark.parametrize(
    "kind", ['muscle lengthrange="-1 1"', 'motor ctrlrange="0 1"', 'motor ctrlrange="-.2 1"']
)
def test_antagonists_change_places(kind):
    model = _legs(
        "".join(f'<{kind} name="{j}{s}" joint="{j}" gear="{s}1"/>' for j in "lr" for s in ("", "-"))
    )
    assert _outcome(model) == "exact"
    assert derive(model, PointGroup.reflection("y")).table("actuator", 1)["l"] == "r-"


def test_the_small_torque_of_a_rotor_counts():
    corners = {"fl": (1, 1), "fr": (1, -1), "rl": (-1, 1), "rr": (-1, -1)}
    sites = "".join(f'<site name="{n}" pos="{x / 10} {y / 10} 0"/>' for n, (x, y) in corners.items())
    rotors = "".join(
        f'<motor name="{n}" site="{n}" gear="0 0 1 0 0 {0.02 * x * y}"/>' for n, (x, y) in corners.items()
    )
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><worldbody><body pos="0 0 1"><freejoint/><geom size=".1"/>{sites}</body>'
        f"</worldbody><actuator>{rotors}</actuator></mujoco>"
    )
    assert _outcome(model, PointGroup.klein_four()) == "exact"
    assert _outcome(model, PointGroup.rotation(4)) == "no"


def test_polynomial_damping_of_motors_is_compared():
    model = _legs('<motor joint="l" damping="1 .5"/><motor joint="r" damping="1 .9"/>')
    assert _outcome(model) == "no"


def test_only_muscles_ask_for_a_range_of_lengths():
    ranges = '<{0} joint="l" lengthrange="0 1"/><{0} joint="r" lengthrange="0 2"/>'
    assert _outcome(_legs(ranges.format("motor"))) == "exact"
    assert _outcome(_legs(ranges.format("muscle"), axis="0 1 0")) == "no"


@pytest.mark.parametrize("loss", ["damping", "frictionloss", "stiffness", "armature"])
@pytest.mark.parametrize("where", [("left", "right"), ("tl", "tr")])
def test_identified_losses_are_judged_by_what_they_meet(loss, where):
    kinds = {"left": "joint", "tl": "tendon"}[where[0]], (("l", "r"), ("tl", "tr"))[where[0] == "tl"]
    motors = "".join(f'<motor {kinds[0]}="{name}" ctrlrange="-40 40"/>' for name in kinds[1])
    small = {"armature": 0.01}.get(loss, 0.3)
    some = {w: f'{loss}="{small * f}"' for w, f in zip(where, (1.0, 1.2), strict=True)}
    assert _outcome(_legs(motors, axis="0 1 0", **some)) == "approximate"
    much = {w: f'{loss}="{100 * small * f}"' for w, f in zip(where, (1.0, 2.0), strict=True)}
    assert _outcome(_legs(motors, axis="0 1 0", **much)) == "no"
