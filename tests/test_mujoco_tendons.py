"""Tendons around geoms, with side sites and pulleys: mirrored steps decide what is an image."""

import mujoco
import numpy as np
import pytest

from tests.test_mujoco_derive import step_residual
from torchrl_sym import PointGroup
from torchrl_sym.mujoco import SymmetryError, derive

MIRROR = PointGroup.reflection("y")


def legs(
    right: str = "",
    wrap: str = "cylinder",
    side: str = ".08 {y} .3",
    paths: tuple[str, str] | None = None,
    rest: str | None = None,
) -> mujoco.MjModel:
    """Two swinging legs, whose tendons run over a pulley beside them.

    Args:
        right: place of the right side site; that of the left one mirrored by default.
        wrap: type of the geoms that the tendons wrap around.
        side: place of the left side site.
        paths: other paths of the tendons.
        rest: actuators, a motor on each tendon by default, and constraints.
    """
    size = {"cylinder": 'size=".05 .03" euler="90 0 0"', "sphere": 'size=".05"'}[wrap]
    leg = """<site name="top_{n}" pos="0 {y} .6"/><site name="side_{n}" pos="{place}"/>
      <body name="{n}" pos="0 {y} .3"><joint name="{n}" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.25" size=".01" mass="1" contype="0" conaffinity="0"/>
      <geom name="pulley_{n}" type="{wrap}" {size} mass=".1" contype="0" conaffinity="0"/>
      <site name="tip_{n}" pos="0 0 -.2"/><site name="mid_{n}" pos="-.05 0 -.1"/></body>"""
    bodies = "".join(
        leg.format(n=n, y=y, place=place.format(y=y), wrap=wrap, size=size)
        for n, y, place in (("left", 0.2, side), ("right", -0.2, right or side))
    )
    one, other = paths or (PATH, PATH)
    tendons = f'<spatial name="left">{one.format(n="left")}</spatial>'
    tendons += f'<spatial name="right">{other.format(n="right")}</spatial>'
    return mujoco.MjModel.from_xml_string(f"""<mujoco><option integrator="implicitfast" timestep=".002"/>
      <worldbody>{bodies}</worldbody><tendon>{tendons}</tendon>{rest or MOTORS}</mujoco>""")


MOTORS = """<actuator><motor name="left" tendon="left" gear="5"/>
  <motor name="right" tendon="right" gear="5"/></actuator>"""
PATH = '<site site="top_{n}"/><geom geom="pulley_{n}" sidesite="side_{n}"/><site site="tip_{n}"/>'
BACK = '<site site="tip_{n}"/><geom geom="pulley_{n}" sidesite="side_{n}"/><site site="top_{n}"/>'
SHORT = '<site site="top_{n}"/><geom geom="pulley_{n}"/><site site="tip_{n}"/>'


def worst_step(model: mujoco.MjModel) -> float:
    robot = derive(model, MIRROR)
    return max(step_residual(model, robot, 1, seed, steps=3)[0] for seed in range(6))


@pytest.mark.parametrize("wrap", ["cylinder", "sphere"])
def test_a_tendon_passes_on_the_side_of_its_side_site(wrap):
    assert worst_step(legs(wrap=wrap)) <= 1e-9
    assert worst_step(legs(".16 {y} .3", wrap)) <= 1e-9  # only its direction matters
    with pytest.raises(SymmetryError, match="side site side_right is not on the side of pulley_right that"):
        derive(legs("-.08 {y} .3", wrap), MIRROR)


def test_a_side_site_a_little_aside_is_told_to_the_audit():
    model = legs(".08 {y} .302")
    image = derive(model, MIRROR).actions[1].tendons[0]
    assert image.misfit == pytest.approx(np.sin(np.arctan(0.002 / 0.08) / 2), rel=1e-3)


def test_inside_is_another_way_than_outside():
    inside = ".01 {y} .31"
    assert worst_step(legs(side=inside)) <= 1e-9
    assert worst_step(legs("-.01 {y} .29", side=inside)) <= 1e-9  # anywhere inside is the same
    with pytest.raises(SymmetryError, match="left has no image: no tendon takes the image of its path"):
        derive(legs(".08 {y} .3", side=inside), MIRROR)


def test_a_path_may_run_backwards_but_not_without_its_side_site():
    assert worst_step(legs(paths=(PATH, BACK))) <= 1e-9
    with pytest.raises(SymmetryError, match="left has no image"):
        derive(legs(paths=(PATH, SHORT)), MIRROR)


def test_branches_of_pulleys_may_come_in_another_order():
    down = '<site site="top_{n}"/><site site="mid_{n}"/>'
    along = '<site site="side_{n}"/><site site="tip_{n}"/>'
    one = f'{down}<pulley divisor="2"/>{along}<pulley divisor="2"/>{down.replace("mid", "tip")}'
    other = f'{down}<pulley divisor="2"/>{down.replace("mid", "tip")}<pulley divisor="2"/>{along}'
    assert worst_step(legs(paths=(one, other))) <= 1e-9
    wrong = other.replace('"2"/><site site="side', '"3"/><site site="side')
    with pytest.raises(SymmetryError, match="left has no image"):
        derive(legs(paths=(one, wrong)), MIRROR)


def test_one_motor_may_pull_two_tied_tendons():
    tie = '<equality><tendon name="tie" tendon1="{}" tendon2="{}"/></equality>'
    motor = '<actuator><motor name="pull" tendon="left"/></actuator>'
    for order in (("left", "right"), ("right", "left")):
        image = derive(legs(rest=motor + tie.format(*order)), MIRROR).actions[1].actuators[0]
        assert (image.index, image.sign, image.through) == (0, 1.0, "tie")
    with pytest.raises(SymmetryError, match="pull has no image"):
        derive(legs(rest=motor), MIRROR)


@pytest.mark.parametrize("what", ["radius", "place", "axis"])
def test_wrapping_geoms_are_compared_by_what_the_tendon_feels(what):
    model = legs()
    geom = model.geom("pulley_right").id
    assert derive(model, MIRROR).actions[1].tendons[0].misfit < 1e-12
    model.geom_size[geom, 1] *= 2  # a cylinder wraps as if it were endless
    assert derive(model, MIRROR).actions[1].tendons[0].misfit < 1e-12
    model.geom_sameframe[geom] = 0
    if what == "radius":
        model.geom_size[geom, 0] *= 1.05
    elif what == "place":
        model.geom_pos[geom, 0] += 0.004
    else:
        mujoco.mju_mulQuat(
            model.geom_quat[geom], np.array([0.9999, 0.0141, 0, 0]), model.geom_quat[geom].copy()
        )
    robot = derive(model, MIRROR)
    assert 1e-3 < robot.actions[1].tendons[0].misfit < 0.1
    assert worst_step(model) > 1e-9


def test_coefficients_a_little_off_are_told_to_the_audit_and_others_refused():
    def model(coefficient: float) -> mujoco.MjModel:
        joint = """<body pos="0 {y} 0"><joint name="{n}" axis="0 1 0"/>
          <geom type="capsule" fromto="0 0 0 .2 0 0" size=".02"/></body>"""
        return mujoco.MjModel.from_xml_string(f"""<mujoco><worldbody>{joint.format(n="a", y=0.2)}
          {joint.format(n="b", y=-0.2)}</worldbody><tendon>
          <fixed name="a"><joint joint="a" coef="1"/><joint joint="b" coef=".5"/></fixed>
          <fixed name="b"><joint joint="b" coef="{coefficient}"/><joint joint="a" coef=".5"/></fixed>
          </tendon></mujoco>""")

    assert derive(model(1), MIRROR).table("tendon", 1) == {"a": "b", "b": "a"}
    images = derive(model(1.05), MIRROR).actions[1].tendons
    assert [images[t].index for t in (0, 1)] == [1, 0]
    assert images[0].misfit == pytest.approx(0.05 / np.hypot(1.05, 0.5))
    with pytest.raises(SymmetryError, match="a has no image: no tendon couples the images"):
        derive(model(-1), MIRROR)
