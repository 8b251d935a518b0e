"""Several joints of one body: their order, and slides that an element mixes."""

import mujoco
import numpy as np
import pytest
import torch

from tests.test_mujoco_derive import step_residual
from torchrl_sym import PointGroup
from torchrl_sym.mujoco import SymmetryError, derive

C3, C4, MIRROR = PointGroup.rotation(3), PointGroup.rotation(4), PointGroup.reflection("y")
OPTION = '<option integrator="implicitfast" timestep=".005"/><compiler angle="radian" autolimits="true"/>'


def compiled(bodies: str, rest: str = "") -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(f"<mujoco>{OPTION}<worldbody>{bodies}</worldbody>{rest}</mujoco>")


def worst_step(model: mujoco.MjModel, group: PointGroup, **options) -> float:
    robot = derive(model, group, **options)
    return max(
        step_residual(model, robot, g, seed, steps=3)[0] for g in range(group.order) for seed in range(4)
    )


# --- order


def hips(left: str, right: str) -> mujoco.MjModel:
    """Two legs, each of one body with the joints given (with ``{s}`` the side's name)."""
    legs = "".join(
        f"""<body name="{s}" pos="0 {y} 1">{joints.format(s=s)}
          <geom type="capsule" fromto="0 0 0 .1 {0.3 * y} -.4" size=".03"/></body>"""
        for s, y, joints in (("left", 0.2, left), ("right", -0.2, right))
    )
    return compiled(legs)


def hinge(name: str, axis: str, more: str = "") -> str:
    return f'<joint name="{name}_{{s}}" axis="{axis}" {more}/>'


def slide(name: str, axis: str) -> str:
    return f'<joint name="{name}_{{s}}" type="slide" axis="{axis}"/>'


X, Y, Z = (hinge(name, axis) for name, axis in zip("xyz", ("1 0 0", "0 1 0", "0 0 1"), strict=True))
SX, SY, SZ = (
    slide(f"s{name}", axis) for name, axis in zip("xyz", ("1 0 0", "0 1 0", "0 0 1"), strict=True)
)
OFF_LINE = hinge("o", "0 1 0", 'pos=".1 0 0"')
# joints of the left body and of the right one; whether the other order is another motion
ORDERS = {
    "universal joint": (X + Y, Y + X, True),
    "Euler hinges": (Z + Y + X, Z + X + Y, True),
    "hinges beside each other": (Y + OFF_LINE, OFF_LINE + Y, True),
    "hinge and slide across": (Y + SX, SX + Y, True),
    "hinge and slide along": (Y + SY, SY + Y, False),
    "slides": (SX + SY, SY + SX, False),
    "slides on both sides of a hinge": (SX + Y + SY, SX + SY + Y, False),
    "slides, one behind the hinge": (SX + Y + SZ, SX + SZ + Y, True),
    "Cardan shaft": (X + Y + hinge("x2", "1 0 0"), hinge("x2", "1 0 0") + Y + X, False),
}


@pytest.mark.parametrize("name", ORDERS)
def test_joints_keep_their_order_unless_they_commute(name):
    left, right, matters = ORDERS[name]
    assert worst_step(hips(left, left), MIRROR) <= 1e-9
    if matters:
        with pytest.raises(
            SymmetryError, match=r"left has no image .*its joints, .* order .*do not commute"
        ):
            derive(hips(left, right), MIRROR)
        # asked for all the same, it is not what the simulator does
        assert worst_step(hips(left, right), MIRROR, tolerance=2.0) > 1e-3
    else:
        assert worst_step(hips(left, right), MIRROR) <= 1e-9


NEARLY = ("0 0 1", ".01 0 1")


def test_hinges_on_one_line_go_to_each_other_in_order():
    wrist = hinge("yaw", "0 0 1") + Y + hinge("roll", "0 0 1")  # first and last are one line at zero
    table = derive(hips(wrist, wrist), MIRROR).table("joint", 1)
    assert table["yaw_left"] == "-yaw_right"
    assert table["roll_left"] == "-roll_right"
    # nearer crosswise, by a hair: the order decides
    wrists = (f"{hinge('yaw', one)}{Y}{hinge('roll', other)}" for one, other in (NEARLY, NEARLY[::-1]))
    assert derive(hips(*wrists), MIRROR).table("joint", 1)["yaw_left"] == "-yaw_right"


BASE = """<body name="base" pos="0 0 .5">{}<geom type="cylinder" size=".2 .05"/></body>"""


def test_elements_that_exchange_hinges_of_a_body_are_refused():
    euler = BASE.format(Z + X + Y).replace("_{s}", "")
    with pytest.raises(SymmetryError, match=r"base has no image under 'rot-90'.*do not commute"):
        derive(compiled(euler), C4)
    assert worst_step(compiled(euler), PointGroup.klein_four()) <= 1e-9
    assert worst_step(compiled(euler), C4, tolerance=2.0) > 1e-3
    order = derive(compiled(euler), C4, tolerance=2.0).actions[1].coordinates.order
    assert list(order.values()) == [pytest.approx(1.0)]


def test_a_little_out_of_order_is_told_to_the_audit():
    near = hinge("near", "0 1 0", 'pos=".003 0 0"')
    order = derive(hips(Y + near, near + Y), MIRROR).actions[1].coordinates.order
    assert 1e-3 < max(order.values()) < 1e-2


# --- slides that mix

ARMS = "".join(
    f"""<frame euler="0 0 {2 * np.pi * k / 3}"><body name="arm{k}" pos=".2 0 0">
      <joint name="arm{k}" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 .1 .05 -.2" size=".02"/></body></frame>"""
    for k in range(3)
)


def planar(
    yaw: float = 0.0, place: str = "0 0 .5", more: str = "", ref: float = 0.0, kinds: str = "slide slide"
) -> str:
    """A base that moves in the plane, with three arms; its axes are turned by a yaw."""
    x, y = kinds.split()
    c, s = np.cos(yaw), np.sin(yaw)
    return f"""<body name="base" pos="{place}">
      <joint name="x" type="{x}" axis="{c} {s} 0" damping=".3" ref="{ref}"/>
      <joint name="y" type="{y}" axis="{-s} {c} 0" damping=".3"/>
      <joint name="yaw" axis="0 0 1"/><geom type="cylinder" size=".2 .05"/>
      <site name="base" pos="0 0 .1"/>{more}{ARMS}</body>"""


MOTORS = """<actuator><motor name="mx" joint="x" gear="3"/><motor name="my" joint="y" gear="3"/>
  <position name="px" joint="x" kp="20"/><position name="py" joint="y" kp="20" timeconst=".1"/>
  <position name="yaw" joint="yaw" kp="20"/></actuator>"""
MOTORS = MOTORS.replace('joint="x" kp="20"', 'joint="x" kp="20" timeconst=".1"')
SENSORS = """<sensor><jointpos name="qx" joint="x"/><jointpos name="qy" joint="y"/>
  <jointvel name="vy" joint="y"/><jointvel name="vx" joint="x"/>
  <actuatorfrc name="fx" actuator="mx"/><actuatorfrc name="fy" actuator="my"/>
  <jointactuatorfrc name="jy" joint="y"/><jointactuatorfrc name="jx" joint="x"/></sensor>"""


@pytest.mark.parametrize("yaw", [0.0, 0.4])
@pytest.mark.parametrize(
    "group", [C3, PointGroup.dihedral(3), PointGroup.rotation(12)], ids=["C3", "D3", "C12"]
)
def test_slides_of_a_planar_base_mix(group, yaw):
    bodies = planar(yaw).replace(".1 .05 -.2", ".1 0 -.2")  # the arms have mirror images of their own
    if group.order == 12:
        bodies = bodies.replace(ARMS.replace(".1 .05 -.2", ".1 0 -.2"), "")
    model = compiled(bodies, MOTORS + SENSORS)
    assert worst_step(model, group) <= 1e-9
    robot = derive(model, group)
    turned = robot.joints(["x", "y"])(torch.tensor([1.0, 0.0], dtype=torch.float64), 1)
    assert turned.norm() == pytest.approx(1.0)
    table = robot.table("joint", "rot-120")
    assert table["x"] == "-0.5 x + 0.866 y" if group is C3 else "x" in table
    assert "0.866 my" in robot.table("actuator", "rot-120")["mx"]


def test_readings_of_slides_that_mix_mix_with_them():
    model = compiled(planar(0.3), MOTORS + SENSORS)
    robot, rng = derive(model, C3), np.random.default_rng(0)
    for g in range(3):
        data, image = mujoco.MjData(model), mujoco.MjData(model)
        data.qpos[:], data.qvel[:], data.ctrl[:] = (
            rng.standard_normal(n) for n in (model.nq, model.nv, model.nu)
        )
        data.act[:] = rng.standard_normal(model.na)
        image.act[:] = robot.map_act(torch.tensor(data.act), g)
        for name in ("qpos", "qvel", "ctrl"):
            getattr(image, name)[:] = getattr(robot, f"map_{name}")(torch.tensor(getattr(data, name)), g)
        for each in (data, image):
            mujoco.mj_forward(model, each)
        expected = robot.sensordata(torch.tensor(data.sensordata), g)
        torch.testing.assert_close(torch.tensor(image.sensordata), expected)
    assert robot.table("sensor", "rot-120")["qx"] == robot.table("joint", "rot-120")["x"].replace(
        "x", "qx"
    ).replace("y", "qy")
    with pytest.raises(ValueError, match="'rot-120' sends sensor 'qx' to 'qy', which is not among"):
        robot.sensors(["qx"])
    with pytest.raises(ValueError, match="'rot-120' sends x to y, which is not among"):
        robot.joints(["x"])


def test_a_mixing_base_that_does_not_start_at_zero_has_offsets():
    model = compiled(planar(ref=0.4), MOTORS)  # the coordinate is 0.4 where the base is on the axis
    robot = derive(model, C3)
    assert robot.offsets("rot-120")["y"] == pytest.approx(0.6)  # of its image x
    assert worst_step(model, C3) <= 1e-9


def test_a_base_that_leans_a_little_still_has_an_exact_representation():
    leaning = (
        planar()
        .replace('axis="1.0 0.0 0"', 'axis="1 0 .002"')
        .replace('axis="-0.0 1.0 0"', 'axis="0 1 -.001"')
    )
    robot = derive(compiled(leaning), C3)  # which checks that it composes
    assert robot.joints(["x", "y"]).matrices[1, 0, 0] == pytest.approx(-0.5, abs=1e-5)
    assert 1e-6 < worst_step(compiled(leaning), C3) < 1e-2


def test_a_mixing_base_may_stand_aside():
    model = compiled(planar(place=".3 -.2 .5"), MOTORS)
    robot = derive(model, C3)
    assert robot.axis == pytest.approx((0.3, -0.2))
    assert worst_step(model, C3) <= 1e-9


def test_what_slides_cannot_mix_is_refused():
    with pytest.raises(SymmetryError, match="'rot-120'"):  # two hinges do not mix
        derive(compiled(planar(kinds="hinge hinge")), C3)
    with pytest.raises(SymmetryError, match="'rot-120'"):  # one slide has nothing to mix with
        derive(compiled(planar(kinds="slide hinge")), C3)
    with pytest.raises(SymmetryError, match="'rot-120'"):  # not at right angles
        derive(compiled(planar().replace('axis="-0.0 1.0 0"', 'axis=".5 1 0"')), C3)
    with pytest.raises(SymmetryError, match="mx has no image"):
        derive(compiled(planar(), '<actuator><motor name="mx" joint="x"/></actuator>'), C3)


def test_slides_that_mix_across_a_hinge_are_refused():
    late = planar().replace('<joint name="yaw" axis="0 0 1"/>', "")
    late = late.replace('<joint name="y" ', '<joint name="yaw" axis="0 0 1"/><joint name="y" ')
    with pytest.raises(SymmetryError, match="do not commute"):
        derive(compiled(late), C3)
