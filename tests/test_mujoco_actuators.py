"""Actuators and tendons: through equalities, in other frames, around geoms; mirrored steps decide."""

import mujoco
import numpy as np
import pytest
import torch

from tests.test_mujoco_derive import step_residual
from torchrl_sym import PointGroup
from torchrl_sym.mujoco import ModelSymmetry, SymmetryError, derive

MIRROR = PointGroup.reflection("y")
OPTION = '<option integrator="implicitfast" timestep=".002" iterations="100" tolerance="0"/>'
FREE = 'contype="0" conaffinity="0"'


def compiled(xml: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(f'<mujoco>{OPTION}<compiler autolimits="true"/>{xml}</mujoco>')


def worst_step(model: mujoco.MjModel, robot: ModelSymmetry | None = None, seeds: int = 6) -> float:
    robot = robot or derive(model, MIRROR)
    return max(step_residual(model, robot, 1, seed, steps=3)[0] for seed in range(seeds))


# --- one motor, two fingers


def gripper(rest: str, right: str = "0 -1 0") -> mujoco.MjModel:
    """Two fingers on slides; the axis of that on the right may be written the other way round."""
    return compiled(f"""<worldbody><body name="palm" pos="0 0 .2">
      <joint name="lift" type="slide" axis="0 0 1"/><geom type="box" size=".03 .06 .02" mass="1"/>
      <body name="left" pos="0 .03 .05"><joint name="left" type="slide" axis="0 1 0"/>
        <geom type="box" size=".01 .005 .03" mass=".1" {FREE}/></body>
      <body name="right" pos="0 -.03 .05"><joint name="right" type="slide" axis="{right}"/>
        <geom type="box" size=".01 .005 .03" mass=".1" {FREE}/></body>
      <body name="rod"><joint name="rod" type="slide" axis="0 0 1"/>
        <geom size=".01" mass=".1" {FREE}/></body>
      </body></worldbody>{rest}""")


SERVO = '<actuator><position name="grip" joint="left" kp="100" kv="5"/></actuator>'
TENDONS = """<tendon><fixed name="tl"><joint joint="left" coef="2"/></fixed>
  <fixed name="tr"><joint joint="right" coef="2"/></fixed>
  <fixed name="gap"><joint joint="left" coef="1"/><joint joint="right" coef="-1"/></fixed></tendon>"""


def tie(one: str, other: str, slope: str = "1", name: str = "tie", more: str = "") -> str:
    return (
        f'<joint name="{name}" joint1="{one}" joint2="{other}" polycoef="0 {slope} 0 0 0" '
        f'solref=".004 1" {more}/>'
    )


# equality constraints, and the axis of the right finger
TIED = {
    "q1 = q2": (tie("left", "right"), "0 -1 0", "tie"),
    "q2 = q1": (tie("right", "left"), "0 -1 0", "tie"),
    "q2 = -q1": (tie("right", "left", "-1"), "0 1 0", "tie"),
    "by tendons": ('<tendon name="tie" tendon1="tl" tendon2="tr" solref=".004 1"/>', "0 -1 0", "tie"),
    "by one tendon": (
        '<tendon name="tie" tendon1="gap" polycoef="0 0 0 0 0" solref=".004 1"/>', "0 -1 0", "tie",
    ),
    "a chain": (tie("left", "rod", ".5") + tie("right", "rod", ".5", "tie2"), "0 -1 0", "tie, tie2"),
}  # fmt: skip


@pytest.mark.parametrize("name", TIED)
def test_one_motor_is_its_own_image_through_an_equality(name):
    equality, right, through = TIED[name]
    model = gripper(f"{TENDONS}<equality>{equality}</equality>{SERVO}", right)
    robot = derive(model, MIRROR)
    assert robot.table("actuator", 1) == {"grip": "grip"}
    assert robot.actions[1].actuators[0].through == through
    for target in (0.02, -0.01):
        data, image = mujoco.MjData(model), mujoco.MjData(model)
        data.ctrl[:] = target
        image.ctrl[:] = robot.map_ctrl(torch.tensor(data.ctrl), 1)
        for each in (data, image):
            mujoco.mj_step(model, each, 1500)
        fingers = robot.map_qpos(torch.tensor(data.qpos), 1).numpy()[1:3] - image.qpos[1:3]
        assert abs(data.qpos[1]) > 0.5 * abs(target)
        assert np.abs(fingers).max() < 1e-3 * abs(target) + 1e-6  # once the constraint has closed


def test_a_motor_without_a_tie_that_carries_its_force_has_no_image():
    for equality in (
        "",
        tie("left", "right", more='active="false"'),
        tie("left", "right", ".5"),  # the control would need another scale
        tie("left", "rod"),
        tie("left", "right").replace("0 1 0 0 0", "0 1 .3 0 0"),
    ):
        with pytest.raises(SymmetryError, match="grip has no image: no actuator drives"):
            derive(gripper(f"<equality>{equality}</equality>{SERVO}"), MIRROR)


def test_a_motor_of_its_own_goes_before_an_equality():
    servos = SERVO.replace(
        "</actuator>", '<position name="other" joint="right" kp="100" kv="5"/></actuator>'
    )
    model = gripper(f"<equality>{tie('left', 'right')}</equality>{servos}")
    images = derive(model, MIRROR).actions[1].actuators
    assert [(image.index, image.through) for image in images.values()] == [(1, ""), (0, "")]


def test_the_force_of_a_motor_with_an_image_through_an_equality_is_not_on_the_other_finger():
    sensors = """<sensor><jointactuatorfrc name="left" joint="left"/><jointactuatorfrc name="right"
      joint="right"/><actuatorfrc name="force" actuator="grip"/></sensor>"""
    robot = derive(gripper(f"<equality>{tie('left', 'right')}</equality>{SERVO}{sensors}"), MIRROR)
    assert robot.sensors(["force"]).dim == 1
    with pytest.raises(ValueError, match=r"'left' has no .* only through equality tie"):
        robot.sensors(["left", "right"])


@pytest.mark.parametrize(("coefficients", "sign"), [((0.5, 0.5), ""), ((0.5, -0.5), "-")])
def test_a_tendon_that_drives_both_fingers_is_exact(coefficients, sign):
    one, other = coefficients
    model = gripper(
        f"""<tendon><fixed name="both"><joint joint="left" coef="{one}"/>
        <joint joint="right" coef="{other}"/>
        </fixed></tendon><actuator><position name="grip" tendon="both" kp="100"/></actuator>"""
    )
    robot = derive(model, MIRROR)
    assert robot.table("actuator", 1) == {"grip": f"{sign}grip"}
    assert robot.table("tendon", 1) == {"both": f"{sign}both"}
    assert worst_step(model, robot) <= 1e-12


# --- frames


def swingers(sites: str, actuators: str, rest: str = "") -> mujoco.MjModel:
    """Two bodies beside the plane, with frames of their own; ``{n}``, ``{s}``: name and side."""
    bodies = "".join(
        f"""<body name="{n}" pos=".1 {0.3 * s} 1" quat="{quat}"><joint name="{n}" type="ball"/>
          <geom type="capsule" fromto="{turned(quat, (0, 0, 0, 0.2, 0.1 * s, -0.3))}" size=".03"/>
          {sites.format(n=n, s=s, end=turned(quat, (0.1, 0.02 * s, -0.1)))}</body>"""
        for n, s, quat in (("left", 1, "1 0 0 0"), ("right", -1, ".5 .5 .5 .5"))
    )
    sides = (("left", 1), ("right", -1))
    root = "".join(f'<site name="root_{n}" pos=".4 {0.2 * s} .5"/>' for n, s in sides)
    both = "".join(actuators.format(n=n) for n, _ in sides)
    return compiled(f"<worldbody>{root}{bodies}</worldbody><actuator>{both}</actuator>{rest}")


def turned(quat: str, points: tuple[float, ...]) -> str:
    """World-aligned points, in the frame of a body with this quaternion."""
    out, conjugate = np.zeros(3), np.array([float(x) for x in quat.split()]) * (1, -1, -1, -1)
    whole = []
    for k in range(0, len(points), 3):
        mujoco.mju_rotVecQuat(out, np.array(points[k : k + 3]), conjugate)
        whole += out.tolist()
    return " ".join(map(str, whole))


SITE = '<site name="tip_{n}" pos="{end}"/>'
MIRRORED = {  # gears of the left side; the right side's are their mirror images, in frames of their own
    "translation from a reference site": ('site="tip_{n}" refsite="root_{n}"', (1, 2, 3, 0, 0, 0), False),
    "rotation from a reference site": ('site="tip_{n}" refsite="root_{n}"', (0, 0, 0, 1, 2, 3), False),
    "a ball from its parent": ('jointinparent="{n}"', (1, 2, 3, 0, 0, 0), True),
}


@pytest.mark.parametrize("name", MIRRORED)
def test_transmissions_in_other_frames_are_mapped(name):
    where, gear, axial = MIRRORED[name]
    model = swingers(SITE, f'<motor name="{{n}}" {where}/>')
    mirror = np.array([1, -1, 1])
    image = np.concatenate([mirror * gear[:3] * (-1 if axial else 1), -mirror * gear[3:]])
    if axial:  # a parent's frame is that of the body at rest
        image[:3] = [float(x) for x in turned(".5 .5 .5 .5", tuple(image[:3])).split()]
    model.actuator_gear[:] = gear, -image
    robot = derive(model, MIRROR)
    assert robot.table("actuator", 1) == {"left": "-right", "right": "-left"}
    assert worst_step(model, robot) <= 1e-9
    model.actuator_gear[1] = gear
    with pytest.raises(SymmetryError, match="left has no image: no actuator drives"):
        derive(model, MIRROR)


def test_the_zero_of_a_ball_is_the_frame_of_its_parent():
    key = '<keyframe><key name="home" qpos="1 0 0 0 .5 .5 .5 .5"/></keyframe>'
    model = swingers("", '<motor name="{n}" jointinparent="{n}"/>', key)
    model.body_quat[model.body("right").id] = (
        1,
        0,
        0,
        0,
    )  # it looks like the left one in the keyframe only
    model.actuator_gear[:, :3] = (1, 2, 3), (-1, 2, -3)
    robot = derive(model, MIRROR)
    assert "home" in robot.pose
    assert robot.table("actuator", 1) == {"left": "right", "right": "left"}
    assert worst_step(model, robot) <= 1e-9
    # angles from two zeros that are no images of each other are not mapped
    model.actuator_biastype[:] = int(mujoco.mjtBias.mjBIAS_AFFINE)
    model.actuator_biasprm[:, 1] = -1
    with pytest.raises(SymmetryError, match="left has no image: no actuator drives"):
        derive(model, MIRROR)


def test_a_free_body_pushed_in_the_frame_of_the_world_is_mapped():
    xml = """<worldbody><body name="ship" pos="0 0 1"><joint name="ship" type="free"/>
      <geom type="box" size=".2 .1 .05"/></body></worldbody><actuator>
      <motor name="ahead" jointinparent="ship" gear="1 0 0 0 .2 0"/>
      <motor name="turn" jointinparent="ship" gear="0 0 0 0 0 1"/></actuator>"""
    robot = derive(compiled(xml), MIRROR)
    assert robot.table("actuator", 1) == {"ahead": "ahead", "turn": "-turn"}
    assert worst_step(robot.model, robot) <= 1e-9


def crank(zaxis: str = "0 0 1", rod: float = 0.5) -> mujoco.MjModel:
    sites = '<site name="slider_{n}" pos="{end}"/>'
    model = swingers(
        sites,
        '<general name="{n}" cranksite="slider_{n}" slidersite="root_{n}" cranklength=".5" gear="2"/>',
    )
    right = model.site("root_right").id
    model.site_sameframe[right] = 0
    model.site_quat[right] = {"0 0 1": (1, 0, 0, 0), "0 0 -1": (0, 1, 0, 0)}[zaxis]
    model.actuator_cranklength[1] = rod
    return model


def test_slider_cranks_are_mapped_by_their_sites_and_rods():
    assert worst_step(crank()) <= 1e-9
    with pytest.raises(SymmetryError, match="left has no image"):
        derive(crank("0 0 -1"), MIRROR)  # the other solution for the crank
    longer = derive(crank(rod=0.52), MIRROR)
    assert longer.actions[1].actuators[0].misfit == pytest.approx(0.02 / 0.52)
    assert worst_step(longer.model, longer) > 1e-6


def test_servos_of_joints_with_another_zero_shift_their_states_too():
    joint = """<body pos="0 {y} 0"><joint name="{n}" axis="0 0 1" ref="{r}"/>
      <geom type="capsule" fromto="0 0 0 .3 {k} 0" size=".03" {free}/></body>"""
    bodies = "".join(
        joint.format(y=s * 0.2, n=n, r=r, k=s * 0.1, free=FREE)
        for n, s, r in (("a", 1, 20), ("b", -1, -50))
    )
    servos = "".join(
        f"""<position name="{n}" joint="{n}" kp="20" timeconst=".1"/>
        <intvelocity name="i{n}" joint="{n}" kp="5" actrange="-3 3"/>
        <position name="p{n}" joint="{n}" kp="5"/>"""
        for n in "ab"
    )
    model = compiled(f"<worldbody>{bodies}</worldbody><actuator>{servos}</actuator>")
    robot, shift = derive(model, MIRROR), np.radians(-50 + 20)
    image = robot.actions[1].actuators
    assert [image[a].offset for a in range(3)] == pytest.approx([shift, 0.0, shift])
    assert [image[a].state_offset for a in range(3)] == pytest.approx([shift, shift, 0.0])
    assert worst_step(model, robot) <= 1e-12


def test_what_cannot_be_told_is_refused_by_actuator_and_the_rest_is_mapped():
    model = compiled(
        """<worldbody><body pos="0 .1 0"><joint name="left"/><geom size=".1"/></body>
        <body pos="0 -.1 0"><joint name="right"/><geom size=".1"/></body></worldbody>
        <actuator><motor name="odd" joint="left"/><motor name="left" joint="left"/>
        <motor name="right" joint="right"/></actuator>"""
    )
    model.actuator_trntype[0] = int(mujoco.mjtTrn.mjTRN_UNDEFINED)
    robot = derive(model, MIRROR)
    assert robot.table("actuator", 1) == {"odd": "(no image)", "left": "-right", "right": "-left"}
    assert robot.table("joint", 1)["left"] == "-right"
    reason = "'odd' cannot be told, as its transmission is not supported"
    with pytest.raises(ValueError, match=reason):
        robot.actuators  # noqa: B018
    with pytest.raises(ValueError, match=reason):
        robot.map_ctrl(torch.zeros(3), 1)
    assert "(no image)" in str(robot)
    assert robot.table("actuator", "identity")["odd"] == "odd"
