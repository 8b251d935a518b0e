"""Contact sensors: what has no order is mapped, what the solver orders is not; sensors off the plane."""

import mujoco
import numpy as np
import pytest
import torch

from torchrl_sym import PointGroup
from torchrl_sym.mujoco import derive

MIRROR = PointGroup.reflection("y")
FEET = {
    "sphere": '<geom name="{n}" pos="0 {y} -.3" size=".05" mass=".3"/>',
    "box": '<geom name="{n}" type="box" pos="0 {y} -.3" size=".08 .04 .05" mass=".3"/>',
}
EVERYTHING = "found force torque dist pos normal tangent"


def robot(sensors: str, foot: str = "box"):
    """A trunk on two legs over a floor; feet may touch the floor and each other."""
    legs = "".join(
        f"""<body name="{n}_leg" pos="0 {0.1 * s} 0"><joint name="{n}" axis="1 0 0"/>
          <joint axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -.2" size=".02"
          contype="0" conaffinity="0"/>{FEET[foot].format(n=n, y=0.02 * s)}
          <site name="{n}" type="box" pos="0 {0.02 * s} -.35" size=".1 .1 .02"/></body>"""
        for n, s in (("left", 1), ("right", -1))
    )
    model = mujoco.MjModel.from_xml_string(f"""<mujoco>
      <option cone="elliptic" iterations="200" tolerance="0"/>
      <worldbody><geom name="floor" type="plane" size="5 5 .1"/>
        <body name="trunk" pos="0 0 .35"><freejoint/>
          <geom type="box" size=".1 .1 .05" mass="4"/>{legs}</body>
      </worldbody><sensor>{sensors}</sensor></mujoco>""")
    return derive(model, MIRROR)


def residuals(symmetry, names: list[str], seeds: int = 12) -> tuple[dict[str, float], float]:
    """Largest error of each sensor's readings at images of states, and the largest number of contacts."""
    model, rho = symmetry.model, symmetry.sensors(names)
    adr = [slice(s.adr[0], s.adr[0] + s.dim[0]) for s in (model.sensor(n) for n in names)]
    errors, most = dict.fromkeys(names, 0.0), 0
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        data, image = mujoco.MjData(model), mujoco.MjData(model)
        mujoco.mj_integratePos(model, data.qpos, 0.2 * rng.standard_normal(model.nv), 1.0)
        if model.nq > model.nv:  # a free base, near the floor
            data.qpos[2] = rng.uniform(0.3, 0.36)
        data.qvel[:] = 0.2 * rng.standard_normal(model.nv)
        image.qpos[:] = symmetry.map_qpos(torch.tensor(data.qpos), 1)
        image.qvel[:] = symmetry.map_qvel(torch.tensor(data.qvel), 1)
        for each in (data, image):
            mujoco.mj_forward(model, each)
        most = max(most, data.ncon)
        before, after = (
            torch.tensor(np.concatenate([each.sensordata[a] for a in adr])) for each in (data, image)
        )
        gaps, start = (rho(before, 1) - after).abs() / max(1.0, float(after.abs().max())), 0
        for name, part in zip(names, adr, strict=True):
            size = part.stop - part.start
            errors[name] = max(errors[name], float(gaps[start : start + size].max()))
            start += size
    return errors, most


def pair(what: str, rest: str) -> str:
    """A sensor for each side; ``{n}`` is the side, ``{o}`` the other one."""
    text = f'<contact name="{{n}}" {what} {rest}/>'
    return text.format(n="left", o="right") + text.format(n="right", o="left")


WATCHED = {
    "geoms": 'geom1="{n}" geom2="floor"',
    "one geom": 'geom1="{n}"',
    "second geom": 'geom2="{n}"',
    "body": 'body1="{n}_leg" geom2="floor"',
    "subtree": 'subtree1="{n}_leg" body2="world"',
    "inside a site": 'site="{n}" geom2="{n}"',
    "other foot": 'geom1="{n}" geom2="{o}"',
}


@pytest.mark.parametrize("name", WATCHED)
def test_numbers_of_contacts_and_net_forces_are_mapped(name):
    sensors = pair(WATCHED[name], 'data="found"')
    sensors += pair(WATCHED[name], 'data="found" num="3"').replace('name="', 'name="three_')
    net = pair(WATCHED[name], f'data="{EVERYTHING}" reduce="netforce"').replace('name="', 'name="net_')
    symmetry = robot(sensors + net)
    names = [f"{p}{n}" for p in ("", "three_", "net_") for n in ("left", "right")]
    errors, contacts = residuals(symmetry, names)
    assert {n: e for n, e in errors.items() if e > 1e-6} == {}
    assert contacts >= 4
    # two feet that touch each other are themselves, in the other order
    assert symmetry.table("sensor", 1)["left"] == ("left" if name == "other foot" else "right")


def test_objects_may_be_named_in_the_other_order_on_the_other_side():
    data = f'data="{EVERYTHING}" reduce="netforce"'
    symmetry = robot(
        f'<contact name="left" geom1="left" geom2="floor" {data}/>'
        f'<contact name="right" geom1="floor" geom2="right" {data}/>'
    )
    errors, contacts = residuals(symmetry, ["left", "right"])
    assert max(errors.values()) <= 1e-6
    assert contacts >= 4
    force = symmetry.sensors(["left", "right"]).matrices[1][18:19, 1:2]
    assert force[0, 0] == -1  # the force on the floor, not on the foot


def test_one_contact_has_a_place_and_a_normal():
    what = pair('geom1="{n}" geom2="floor"', 'data="found dist pos normal"')
    errors, contacts = residuals(robot(what, "sphere"), ["left", "right"])
    assert max(errors.values()) <= 1e-9
    assert contacts >= 1
    other = '<contact name="{}" geom1="{}" geom2="{}" data="found normal"/>'
    swapped = other.format("left", "left", "floor") + other.format("right", "floor", "right")
    assert max(residuals(robot(swapped, "sphere"), ["left", "right"])[0].values()) <= 1e-9
    depth = pair('geom1="{n}"', 'data="found dist" reduce="mindist" num="4"')
    assert max(residuals(robot(depth), ["left", "right"])[0].values()) <= 1e-9


REFUSED = {
    "place of one of four": (pair('geom1="{n}"', 'data="pos"'), "order of its contacts is the solver's"),
    "strongest": (pair('geom1="{n}"', 'data="force" reduce="maxforce"'), "order of its contacts"),
    "depth in no order": (pair('geom1="{n}"', 'data="dist" num="2"'), "order of its contacts"),
    "within the robot": (
        '<contact name="left" subtree1="trunk" subtree2="trunk" data="force" reduce="netforce"/>',
        "no first and second object",
    ),
    "everything": ('<contact name="left" data="force" reduce="netforce"/>', "no first and second object"),
    "no image": ('<contact name="left" geom1="left"/>', "no sensor of its kind"),
    "other reduction": (
        '<contact name="left" geom1="left" data="force" reduce="netforce"/>'
        '<contact name="right" geom1="right" data="force" reduce="maxforce"/>',
        "no sensor of its kind",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_the_solver_orders_is_refused(name):
    sensors, reason = REFUSED[name]
    symmetry = robot(sensors)
    with pytest.raises(ValueError, match=f"'left' has no representation under 'reflect-y': .*{reason}"):
        symmetry.sensordata  # noqa: B018
    assert symmetry.table("sensor", 1)["left"] == "(no image)"


def test_a_single_force_is_refused_for_its_frame():
    symmetry = robot(pair('geom1="{n}" geom2="floor"', 'data="found force"'), "sphere")
    with pytest.raises(ValueError, match="frame that the solver chooses"):
        symmetry.sensordata  # noqa: B018


def test_under_the_identity_every_sensor_is_its_own_image():
    sensors = REFUSED["everything"][0] + '<user name="odd" dim="2" needstage="pos"/>'
    symmetry = robot(sensors)
    assert symmetry.table("sensor", "identity") == {"left": "left", "odd": "odd"}
    assert derive(symmetry.model, PointGroup.trivial()).sensordata.dim == 5


# --- sensors that do not sit in the plane

IMU = "".join(
    f'<{kind} name="{kind}" site="imu"/>'
    for kind in ("gyro", "accelerometer", "velocimeter", "magnetometer", "force")
)
IMU += "".join(
    f'<{kind} name="{kind}" objtype="site" objname="imu"/>'
    for kind in ("framequat", "framexaxis", "frameangvel", "framelinvel", "framepos")
)
PLACELESS = ["gyro", "magnetometer", "framequat", "framexaxis", "frameangvel", "force"]


def imu(beside: float):
    model = mujoco.MjModel.from_xml_string(f"""<mujoco><option magnetic="0 0 -.5"/><worldbody>
      <body name="trunk" pos="0 0 .35"><freejoint/><geom type="box" size=".2 .1 .05" mass="4"/>
        <site name="imu" pos=".05 {-beside} 0"/>
        <body><joint axis="0 1 0"/><geom type="capsule" fromto="0 0 0 .1 0 -.2" size=".02"/></body></body>
      </worldbody><sensor>{IMU}</sensor></mujoco>""")
    return derive(model, MIRROR)


def test_only_what_depends_on_its_place_is_refused_beside_the_plane():
    symmetry = imu(0.067)
    errors, _ = residuals(symmetry, PLACELESS, 5)
    assert max(errors.values()) <= 1e-9
    for name in ("accelerometer", "velocimeter", "framelinvel", "framepos"):
        with pytest.raises(ValueError, match=f"'{name}' has .* the nearest, '{name}', is 134.0 mm away"):
            symmetry.sensors([name])
    assert symmetry.sensors(PLACELESS).dim == 19


def test_a_sensor_beside_the_plane_by_less_than_the_tolerance_is_mapped():
    assert imu(1e-3).sensors(["accelerometer"]).dim == 3


def test_the_volume_of_a_touch_sensor_counts():
    touch = '<touch name="left" site="left"/><touch name="right" site="right"/>'
    assert robot(touch).sensordata.dim == 2
    bigger = robot(touch).model
    bigger.site_size[bigger.site("left").id, 2] += 0.03
    with pytest.raises(ValueError, match=r"'left' has no .* the nearest, 'right', is"):
        derive(bigger, MIRROR).sensordata  # noqa: B018


def test_positions_in_the_world_are_refused_where_the_axis_is_not_at_its_origin():
    arm = """<body name="{n}" pos="1 {y} .3"><joint name="{n}" axis="0 1 0"/><geom type="capsule"
      fromto="0 0 0 .1 0 -.2" size=".02"/><site name="{n}" pos="0 0 -.2"/></body>"""
    sensors = "".join(
        f'''<framepos name="{n}" objtype="site" objname="{n}"/><subtreecom name="c{n}" body="{n}"/>
        <framelinvel name="v{n}" objtype="site" objname="{n}"/>
        <framepos name="r{n}" objtype="site" objname="{n}" reftype="xbody" refname="{n}"/>'''
        for n in ("left", "right")
    )
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco><worldbody>{arm.format(n='left', y=0.7)}{arm.format(n='right', y=0.3)}</worldbody>"
        f"<sensor>{sensors}</sensor></mujoco>"
    )
    symmetry = derive(model, MIRROR, axis=(0.0, 0.5))
    assert max(residuals(symmetry, ["vleft", "vright", "rleft", "rright"], 5)[0].values()) <= 1e-9
    for name in ("left", "cright"):
        with pytest.raises(ValueError, match=rf"'{name}' has .* the element adds \(0, 1, 0\) m.*reftype"):
            symmetry.sensors([name])
