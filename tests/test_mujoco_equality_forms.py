"""Constraints that are written in another way on the other side, and shapes that lie in one place."""

import mujoco
import pytest

from torchrl_sym import PointGroup
from torchrl_sym.mujoco import audit, derive

_FINGERS = """<mujoco><worldbody><body pos="0 0 .5"><freejoint/><geom type="box" size=".1 .2 .05" mass="5"/>
  {fingers}</body></worldbody><tendon>{tendon}</tendon><equality>{equality}</equality>
  <actuator>{actuator}</actuator></mujoco>"""
_PLACES = {"a": (0.1, 0.15), "b": (-0.1, 0.15), "c": (0.1, -0.15), "d": (-0.1, -0.15)}


def _hand(equality="", tendon="", actuator=""):
    fingers = "".join(
        f'<body name="{n}" pos="{x} {y} 0"><joint name="{n}" axis="{1 if y > 0 else -1} 0 0"/>'
        f'<geom type="capsule" fromto="0 0 0 0 0 .1" size=".01" mass=".2"/></body>'
        for n, (x, y) in _PLACES.items()
    )
    return mujoco.MjModel.from_xml_string(
        _FINGERS.format(fingers=fingers, equality=equality, tendon=tendon, actuator=actuator)
    )


def _outcome(model):
    return audit(model, PointGroup.reflection("y")).outcome


def _joint(one, other, slope=1):
    return f'<joint joint1="{one}" joint2="{other}" polycoef="0 {slope} 0 0 0"/>'


@pytest.mark.parametrize("pairs", ["ba cb dc", "ba ca da", "dc ad bd"])
def test_a_chain_of_equalities_nearly_has_its_image(pairs):
    equality = "".join(_joint(one, other) for one, other in pairs.split())
    model = _hand(equality, actuator='<position name="grip" joint="a" kp="5"/>')
    assert _outcome(model) == "approximate"
    assert derive(model, PointGroup.reflection("y")).table("actuator", 1) == {"grip": "grip"}


def test_a_chain_that_says_something_else_has_none():
    assert _outcome(_hand(_joint("b", "a") + _joint("c", "b", slope=0.5) + _joint("d", "c"))) == "no"
    assert _outcome(_hand(_joint("b", "a") + _joint("c", "b"))) == "no"


def test_a_tendon_that_is_held_at_a_length_may_change_its_sign():
    tendon = '<fixed name="t"><joint joint="a" coef="1"/><joint joint="c" coef="-1"/></fixed>'
    assert _outcome(_hand('<tendon tendon1="t"/>', tendon)) == "exact"
    assert _outcome(_hand('<tendon tendon1="t" polycoef=".3 0 0 0 0"/>', tendon)) == "no"


def test_a_weld_asks_for_one_pose_from_either_end():
    assert _outcome(_hand('<weld body1="a" body2="c"/>')) == "approximate"
    assert _outcome(_hand('<weld body1="a" body2="c" relpose=".1 -.3 0 1 0 0 0"/>')) == "no"
    assert _outcome(_hand('<weld body1="a" body2="d"/>')) == "no"


def test_of_shapes_in_one_place_those_that_touch_alike_are_paired():
    xml = """<mujoco><worldbody><geom type="plane" size="5 5 .1"/><body pos="0 0 .5"><freejoint/>
      <geom type="box" size=".2 .1 .05"/>
      <geom size=".03" pos="0 .2 -.1"/><geom size=".03" pos="0 .2 -.1" friction="{0}"/>
      <geom size=".03" pos="0 -.2 -.1" friction="2"/><geom size=".03" pos="0 -.2 -.1"/>
      </body></worldbody></mujoco>"""
    assert _outcome(mujoco.MjModel.from_xml_string(xml.format(2))) == "exact"
    assert _outcome(mujoco.MjModel.from_xml_string(xml.format(0.2))) == "no"


def test_mirrored_objects_that_lie_anyhow_change_places():
    def shoe(name, side, euler):
        return f"""<body name="{name}" pos="0 1 1" euler="{euler}"><freejoint/>
          <geom type="box" size=".06 .02 .02"/>
          <geom type="box" size=".02 .06 .02" pos=".06 {side * 0.04} 0"/>
          <geom type="box" size=".01 .01 .06" pos="-.06 0 .05"/></body>"""

    def outcome(side):
        pair = shoe("one", 1, "30 0 40") + shoe("other", side, "0 50 10")
        return _outcome(mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{pair}</worldbody></mujoco>"))

    assert outcome(-1) == "exact" and outcome(1) == "no"


def test_a_small_object_is_judged_by_its_own_size():
    xml = """<mujoco><worldbody><body pos="0 0 2"><freejoint/><geom size="1"/></body>
      <body name="cube" pos="2 1 .1"><freejoint/><geom type="box" size=".03 .03 .03"/></body>
      </worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    assert audit(model, PointGroup.rotation(3)).outcome == "no"
    assert audit(model, PointGroup.rotation(4)).outcome == "exact"
