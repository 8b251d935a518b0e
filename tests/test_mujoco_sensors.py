"""Sensors: readings at the image of a state are the image of the readings, whatever the type."""

import mujoco
import numpy as np
import pytest
import torch

from torchrl_sym import PointGroup
from torchrl_sym.mujoco import ModelSymmetry, derive

K4 = PointGroup.klein_four()
C3 = PointGroup.rotation(3)
OPTION = (
    '<option cone="elliptic" magnetic="0 0 -0.5" iterations="200" tolerance="0">'
    '<flag energy="enable"/></option><compiler angle="radian"/>'
)
LEGS = {"LF": (1, 1), "RF": (1, -1), "LH": (-1, 1), "RH": (-1, -1)}
DATA = "dist dir origin point normal depth"


def quat(seed: int) -> str:
    """A random frame: what a sensor measures must not depend on how its site was drawn."""
    return " ".join(map(str, np.random.default_rng(seed).standard_normal(4)))


def leg(name: str, x: int, y: int, seed: int) -> str:
    return f"""
    <body name="{name}" pos="{0.3 * x} {0.2 * y} 0">
      <joint name="{name}_haa" axis="1 0 0" range="-.2 .2" limited="true"/>
      <geom type="capsule" fromto="0 0 0 0 {0.1 * y} 0" size=".03" contype="0" conaffinity="0"/>
      <body name="{name}_shank" pos="0 {0.1 * y} 0">
        <joint name="{name}_hfe" axis="0 {y} 0" range="-.2 .2" limited="true" damping=".1"/>
        <geom type="capsule" fromto="0 0 0 {0.05 * x} 0 -.3" size=".02" contype="0" conaffinity="0"/>
        <geom name="{name}_foot" pos="{0.05 * x} 0 -.3" size=".04"/>
        <site name="{name}" pos="{0.05 * x} 0 -.3" size=".06" quat="{quat(seed)}"/>
        <site name="{name}_ray" pos="{0.05 * x} 0 -.2" zaxis="{x} {0.5 * y} -1"/>
        <site name="{name}_up" pos="{0.05 * x} 0 -.2" zaxis="{x} {0.5 * y} 1"/>
      </body>
    </body>"""


def leg_sensors(name: str) -> list[str]:
    site = f'objtype="site" objname="{name}"'
    return [
        f'<touch name="{name}_touch" site="{name}"/>',
        f'<rangefinder name="{name}_ray" site="{name}_ray"/>',
        f'<rangefinder name="{name}_up" site="{name}_up"/>',
        f'<rangefinder name="{name}_rays" site="{name}_ray" data="{DATA}"/>',
        *(
            f'<{kind} name="{name}_{kind}" site="{name}"/>'
            for kind in ("accelerometer", "velocimeter", "gyro", "force", "torque", "magnetometer")
        ),
        *(
            f'<{kind} name="{name}_{joint}_{kind}" joint="{name}_{joint}"/>'
            for joint in ("haa", "hfe")
            for kind in ("jointpos", "jointvel", "jointactuatorfrc", *LIMITS)
        ),
        *(
            f'<{kind} name="{name}_{kind}" actuator="{name}_hfe"/>'
            for kind in ("actuatorpos", "actuatorvel", "actuatorfrc")
        ),
        *(f'<{kind} name="{name}_{kind}" tendon="{name}"/>' for kind in ("tendonpos", "tendonvel")),
        *(
            f'<{kind} name="{name}_{kind}_{i}" {site} {reference}/>'
            for kind in ("framepos", "framequat", "framelinvel", "frameangvel")
            for i, reference in enumerate(REFERENCES)
        ),
        f'<framelinacc name="{name}_framelinacc" {site}/>',
        f'<frameangacc name="{name}_frameangacc" {site}/>',
        f'<framequat name="{name}_body_quat" objtype="body" objname="{name}_shank"/>',
        f'<framepos name="{name}_geom_pos" objtype="geom" objname="{name}_foot" {REFERENCES[1]}/>',
        *(
            f'<{kind} name="{name}_{kind}" body="{name}"/>'
            for kind in ("subtreecom", "subtreelinvel", "subtreeangmom")
        ),
        f'<insidesite name="{name}_inside" site="zone" objtype="geom" objname="{name}_foot"/>',
    ]


LIMITS = ("jointlimitpos", "jointlimitvel", "jointlimitfrc")
REFERENCES = ("", 'reftype="site" refname="imu"', 'reftype="xbody" refname="ball"')
PAIRS = [("LF", "RF"), ("RH", "LH"), ("LF", "LH"), ("RF", "RH")]
TRUNK_SENSORS = [
    *(
        f'<{kind} name="imu_{kind}" site="imu"/>'
        for kind in ("accelerometer", "velocimeter", "gyro", "magnetometer")
    ),
    '<gyro name="gyro_again" site="imu"/>',
    '<framequat name="orientation" objtype="xbody" objname="trunk"/>',
    '<framequat name="imu_orientation" objtype="site" objname="imu"/>',
    '<framequat name="camera" objtype="camera" objname="eye" reftype="site" refname="imu"/>',
    *(f'<frame{a}axis name="{a}" objtype="xbody" objname="trunk"/>' for a in "xyz"),
    *(f'<frame{a}axis name="imu_{a}" objtype="xbody" objname="trunk" {REFERENCES[1]}/>' for a in "xyz"),
    '<ballquat name="ballquat" joint="ball"/>',
    '<ballangvel name="ballangvel" joint="ball"/>',
    *(f'<{k} name="trunk_{k}" body="trunk"/>' for k in ("subtreecom", "subtreelinvel", "subtreeangmom")),
    *(
        f'<{kind} name="{a}_{b}_{kind}" geom1="{a}_foot" geom2="{b}_foot" cutoff="2"/>'
        for kind in ("distance", "normal", "fromto")
        for a, b in PAIRS
    ),
    '<clock name="clock"/>',
    '<e_potential name="potential"/>',
    '<e_kinetic name="kinetic"/>',
]


def quadruped_sensors() -> list[str]:
    return [sensor for name in LEGS for sensor in leg_sensors(name)] + TRUNK_SENSORS


def quadruped(sensors: list[str], option: str = OPTION, extra: str = "") -> mujoco.MjModel:
    legs = "".join(leg(name, *place, seed) for seed, (name, place) in enumerate(LEGS.items()))
    motors = "".join(
        f'<position name="{n}_haa" joint="{n}_haa" kp="20"/>'
        f'<motor name="{n}_hfe" joint="{n}_hfe" gear="{g}"/>'
        for n, g in zip(LEGS, (2, -2, 2, -2), strict=True)
    )
    tendons = "".join(
        f'<fixed name="{n}"><joint joint="{n}_haa" coef="{y}"/>'
        f'<joint joint="{n}_hfe" coef="{x * y}"/></fixed>'
        for n, (x, y) in LEGS.items()
    )
    xml = f"""<mujoco>{option}
      <worldbody>
        <geom name="floor" type="plane" size="0 0 .1"/>
        <site name="zone" type="box" size=".5 .5 .3" pos="0 0 .1"/>
        <body name="trunk" pos="0 0 .35" quat="0 0 0 1"><freejoint name="base"/>
          <geom type="box" size=".3 .2 .05" contype="0" conaffinity="0"/>
          <site name="imu" quat="{quat(7)}"/>
          <camera name="eye" pos="0 0 .2" quat="{quat(8)}"/>{extra}
          <frame quat="0 0 0 1">{legs}
          <body name="ball" pos="0 0 .1" quat="{quat(9)}"><joint name="ball" type="ball"/>
            <geom size=".05" contype="0" conaffinity="0"/></body></frame>
        </body>
      </worldbody>
      <tendon>{tendons}</tendon><actuator>{motors}</actuator><sensor>{"".join(sensors)}</sensor></mujoco>"""
    return mujoco.MjModel.from_xml_string(xml)


def arms(sensors: list[str], option: str = OPTION) -> mujoco.MjModel:
    """Three arms at 120 degrees on the world; every body and site frame is its own."""
    bodies = "".join(
        f"""<frame euler="0 0 {2 * np.pi * k / 3}"><body name="a{k}" pos=".2 0 .47">
          <joint name="a{k}" axis="{(1, -1, 1)[k]} 0 0"/>
          <geom type="capsule" fromto="0 0 0 .1 .02 -.2" size=".02" contype="0" conaffinity="0"/>
          <body name="f{k}" pos=".1 .02 -.2"><joint name="f{k}" axis="0 1 0"/>
            <geom type="capsule" fromto="0 0 0 .05 0 -.27" size=".02"/>
            <site name="f{k}" pos=".05 0 -.27" size=".05" quat="{quat(k)}"/>
            <site name="r{k}" pos=".05 0 -.2" zaxis="1 .3 -1"/></body></body></frame>"""
        for k in range(3)
    )
    motors = "".join(f'<motor joint="a{k}"/><motor joint="f{k}"/>' for k in range(3))
    xml = f"""<mujoco>{option}
      <worldbody><geom name="floor" type="plane" size="0 0 .1"/>{bodies}
        <body name="cube" pos="0 0 .05"><freejoint/><geom size=".05"/>
          <site name="cube" quat="{quat(5)}"/></body>
      </worldbody><actuator>{motors}</actuator><sensor>{"".join(sensors)}</sensor></mujoco>"""
    return mujoco.MjModel.from_xml_string(xml)


ARM_SENSORS = [
    *(
        f'<{kind} name="f{k}_{kind}" site="f{k}"/>'
        for k in range(3)
        for kind in ("touch", "accelerometer", "velocimeter", "gyro", "force", "torque", "magnetometer")
    ),
    *(f'<rangefinder site="r{k}" data="{DATA}"/>' for k in range(3)),
    *(f'<{kind} joint="{j}{k}"/>' for k in range(3) for j in "af" for kind in ("jointpos", "jointvel")),
    *(
        f'<{kind} objtype="site" objname="f{k}" {reference}/>'
        for k in range(3)
        for kind in ("framepos", "framequat", "framelinvel", "frameangvel")
        for reference in ("", 'reftype="site" refname="cube"')
    ),
    *(f'<framepos objtype="xbody" objname="cube" reftype="site" refname="f{k}"/>' for k in range(3)),
    *(f'<framezaxis objtype="site" objname="r{k}"/>' for k in range(3)),
    '<framequat name="cube" objtype="xbody" objname="cube"/>',
    '<subtreeangmom body="cube"/><subtreecom body="cube"/>',
]


def state(model: mujoco.MjModel, seed: int) -> mujoco.MjData:
    """A random state in which feet touch the floor and joints their limits."""
    rng, data = np.random.default_rng(seed), mujoco.MjData(model)
    mujoco.mj_resetData(model, data)
    mujoco.mj_integratePos(model, data.qpos, 0.3 * rng.standard_normal(model.nv), 1.0)
    mujoco.mj_kinematics(model, data)
    free = int(np.flatnonzero(model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)[0])
    mine = model.body_rootid[model.geom_bodyid] == model.body_rootid[model.jnt_bodyid[free]]
    lowest = data.geom_xpos[mine & (model.geom_contype > 0), 2].min()
    data.qpos[model.jnt_qposadr[free] + 2] -= lowest - 0.03
    data.qvel[:] = rng.standard_normal(model.nv)
    data.ctrl[:] = rng.standard_normal(model.nu)
    data.time = 0.7
    mujoco.mj_forward(model, data)
    return data


def image(robot: ModelSymmetry, data: mujoco.MjData, g: int) -> mujoco.MjData:
    out = mujoco.MjData(robot.model)
    out.qpos[:] = robot.map_qpos(torch.tensor(data.qpos), g)
    out.qvel[:] = robot.map_qvel(torch.tensor(data.qvel), g)
    out.ctrl[:] = robot.map_ctrl(torch.tensor(data.ctrl), g)
    out.time = data.time
    mujoco.mj_forward(robot.model, out)
    return out


def residuals(robot: ModelSymmetry, rho, seeds=None) -> dict[str, float]:
    """Largest difference by sensor, relative to the size of its readings; quaternions up to sign."""
    model, out = robot.model, {}
    for seed in SEEDS if seeds is None else seeds:
        data = state(model, seed)
        assert data.ncon > 0
        for g in range(robot.group.order):
            actual = image(robot, data, g).sensordata
            expected = rho(torch.tensor(data.sensordata), g).numpy()
            for i in range(model.nsensor):
                part = slice(model.sensor_adr[i], model.sensor_adr[i] + model.sensor_dim[i])
                a, b = actual[part], expected[part]
                if model.sensor_type[i] in QUATERNIONS and a @ b < 0:
                    b = -b
                error = np.abs(a - b).max() / max(1.0, np.abs(b).max())
                name = model.sensor(i).name or f"sensor {i}"
                out[name] = max(out.get(name, 0.0), float(error))
    return out


SEEDS = range(20)
QUATERNIONS = [int(mujoco.mjtSensor.mjSENS_FRAMEQUAT), int(mujoco.mjtSensor.mjSENS_BALLQUAT)]
ROBOTS = {"quadruped": (quadruped, quadruped_sensors(), K4), "arms": (arms, ARM_SENSORS, C3)}


@pytest.mark.parametrize("name", ROBOTS)
def test_readings_at_the_image_of_a_state_are_the_image_of_the_readings(name):
    build, sensors, group = ROBOTS[name]
    robot = derive(build(sensors), group)
    worst = residuals(robot, robot.sensordata)
    assert {n: e for n, e in worst.items() if e > 1e-9} == {}
    readings = np.abs([state(robot.model, seed).sensordata for seed in SEEDS]).max(axis=0)
    silent = [
        n
        for n, sensor in ((i, robot.model.sensor(i)) for i in range(robot.model.nsensor))
        if readings[sensor.adr[0] : sensor.adr[0] + sensor.dim[0]].max() < 1e-9
    ]
    assert not silent, [robot.model.sensor(i).name for i in silent]  # each says something in these states


def test_order_of_sensors_does_not_matter():
    shuffled = [TRUNK_SENSORS[i] for i in np.random.default_rng(0).permutation(len(TRUNK_SENSORS))]
    names = [f"imu_{kind}" for kind in ("gyro", "accelerometer")] + ["LF_RF_normal", "RH_LH_normal"]
    one, other = (derive(quadruped(sensors), K4) for sensors in (TRUNK_SENSORS, shuffled))
    torch.testing.assert_close(one.sensors(names).matrices, other.sensors(names).matrices)
    assert max(residuals(other, other.sensordata, range(2)).values()) < 1e-9


def test_names_select_and_order_the_readings():
    robot = derive(quadruped(quadruped_sensors()), K4)
    names = [f"{leg}_touch" for leg in ("RH", "LH", "RF", "LF")]
    touch = robot.sensors(names)
    assert touch(torch.arange(4.0), "reflect-y").tolist() == [1, 0, 3, 2]
    assert touch(torch.arange(4.0), "reflect-x").tolist() == [2, 3, 0, 1]
    table = robot.table("sensor", "reflect-y")
    assert table["LF_haa_jointpos"] == "-RF_haa_jointpos"  # an angle changes sign,
    assert table["LF_haa_jointlimitpos"] == "RF_haa_jointlimitpos"  # the distance to a limit does not
    assert table["gyro_again"] == "gyro_again"
    with pytest.raises(KeyError, match=r"no sensors \['nose'\]; the model has"):
        robot.sensors(["nose"])
    with pytest.raises(ValueError, match="'reflect-x' sends sensor 'LF_touch' to 'LH_touch', which is not"):
        robot.sensors(["LF_touch", "RF_touch"])
    assert robot.sensors([]).dim == 0


def test_an_axial_sensor_treated_as_polar_is_noticed():
    robot = derive(quadruped(TRUNK_SENSORS), K4)
    det = torch.linalg.det(K4.matrices)
    matrices = robot.sensordata.matrices.clone()
    start = int(robot.model.sensor("imu_gyro").adr[0])
    matrices[:, start : start + 3, start : start + 3] *= det[:, None, None]

    def wrong(x, g):
        return matrices[g] @ x

    worst = residuals(robot, wrong, range(2))
    assert [name for name, error in worst.items() if error > 1e-9] == ["imu_gyro"]


def test_range_finders_in_one_place_are_told_apart_by_direction():
    names = ["north", "west", "south", "east"]
    directions = ["1 .2 0", "-.2 1 0", "-1 -.2 0", ".2 -1 0"]
    sites = "".join(f'<site name="{n}" zaxis="{d}"/>' for n, d in zip(names, directions, strict=True))
    xml = f"""<mujoco><worldbody>{sites}</worldbody>
      <sensor>{"".join(f'<rangefinder name="{n}" site="{n}"/>' for n in names)}</sensor></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    table = derive(model, PointGroup.rotation(4)).table("sensor", "rot-90")
    assert table == dict(zip(names, [*names[1:], "north"], strict=True))
    mirrored = derive(model, PointGroup.reflection("y"))
    with pytest.raises(ValueError, match=r"'north' has no representation under 'reflect-y': no sensor"):
        mirrored.sensordata  # noqa: B018


def test_axes_may_be_exchanged_by_a_quarter_turn():
    xml = """<mujoco><worldbody><body><freejoint/><geom size=".1"/><site name="s"/></body></worldbody>
      <sensor>
      <framexaxis name="x" objtype="site" objname="s"/><frameyaxis name="y" objtype="site" objname="s"/>
      <framezaxis name="z" objtype="site" objname="s"/></sensor></mujoco>"""
    robot = derive(mujoco.MjModel.from_xml_string(xml), PointGroup.rotation(4))
    assert robot.table("sensor", "rot-90") == {"x": "y", "y": "x", "z": "z"}
    data = mujoco.MjData(robot.model)
    data.qpos[:] = [1, 2, 3, 0.5, 0.5, -0.5, 0.5]
    mujoco.mj_forward(robot.model, data)
    for g in range(4):
        expected = robot.sensordata(torch.tensor(data.sensordata), g)
        torch.testing.assert_close(torch.tensor(image(robot, data, g).sensordata), expected)


@pytest.mark.parametrize("field", ["0 -0.5 0", "0.5 0 0"])
def test_a_horizontal_magnetic_field_is_mapped_up_to_its_sign(field):
    option = OPTION.replace("0 0 -0.5", field)
    robot = derive(quadruped(TRUNK_SENSORS, option), K4)
    assert max(residuals(robot, robot.sensordata, range(2)).values()) < 1e-9


REFUSED = {
    "user": ('<user name="odd" dim="2" needstage="pos"/>', "'odd' has no .* callback"),
    "camera": ('<camprojection name="odd" site="imu" camera="eye"/>', "'odd' has no .* pixel coordinates"),
    "contact": (
        '<contact name="odd" subtree1="trunk" data="pos"/>',
        "'odd' has no .* order of its contacts",
    ),
    "no image": (
        '<touch name="odd" site="LF"/>',
        "'odd' has no .* under 'reflect-x': no sensor of its kind",
    ),
    "other cutoff": (
        '<touch name="odd" site="LF"/>'
        + "".join(f'<touch name="{n}_t" site="{n}" cutoff="9"/>' for n in ("RF", "LH", "RH")),
        "'odd' has no .* under 'reflect-x': no sensor of its kind, cutoff",
    ),
    "off the mirror plane": (
        '<accelerometer name="odd" site="beside"/>',
        "'odd' has no .* 'reflect-y': no sensor .* the nearest, .*, is [12]00.0 mm away; move it",
    ),
    "skew axis": ('<framexaxis name="odd" objtype="site" objname="imu"/>', "'odd' has no .* 'reflect-x'"),
    "clipped": ('<gyro name="odd" site="imu" cutoff="9"/>', "'odd' has no .* cutoff clips every entry"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_has_no_representation_is_named_and_the_rest_still_works(name):
    sensor, message = REFUSED[name]
    extra = '<site name="beside" pos="0 .1 0"/>' if "beside" in sensor else ""
    option = OPTION + '<visual><global offwidth="64"/></visual>'
    robot = derive(quadruped([*TRUNK_SENSORS, sensor], option, extra), K4)  # deriving is no error
    with pytest.raises(ValueError, match=message + r".*; or select other sensors with sensors\(names\)"):
        robot.sensordata  # noqa: B018
    with pytest.raises(ValueError, match=message):
        robot.sensors(["odd"])
    assert robot.sensors(["imu_gyro"]).dim == 3
    assert "imu_gyro" in robot.table("sensor", "reflect-y")


def test_a_magnetic_field_that_turns_is_refused():
    robot = derive(arms(ARM_SENSORS, OPTION.replace("0 0 -0.5", "0 -0.5 0")), C3)
    with pytest.raises(ValueError, match=r"'f0_magnetometer' .* the magnetic field \[0.0, -0.5, 0.0\]"):
        robot.sensordata  # noqa: B018


def test_joints_with_an_offset_are_refused_but_their_velocities_are_not():
    joint = '<body pos="0 {y} 0"><joint name="{n}" axis="1 0 0"/><geom size=".1"/></body>'
    xml = f"""<mujoco><worldbody>{joint.format(y=0.2, n="l")}{joint.format(y=-0.2, n="r")}</worldbody>
      <tendon><fixed name="l"><joint joint="l" coef="2"/></fixed>
        <fixed name="r"><joint joint="r" coef="2"/></fixed></tendon>
      <actuator><motor name="l" joint="l" gear="3"/><motor name="r" joint="r" gear="3"/></actuator>
      <sensor>{
        "".join(
            f'''<jointpos name="q{n}" joint="{n}"/><jointvel name="v{n}" joint="{n}"/>
        <tendonpos name="t{n}" tendon="{n}"/><actuatorpos name="a{n}" actuator="{n}"/>'''
            for n in "lr"
        )
    }
      </sensor><keyframe><key qpos="0.3 -0.1"/></keyframe></mujoco>"""
    robot = derive(mujoco.MjModel.from_xml_string(xml), PointGroup.reflection("y"), keyframe=0)
    for name, offset in (("q", 0.2), ("t", 0.4), ("a", 0.6)):
        with pytest.raises(ValueError, match=f"'{name}l' .* offset of {offset}.*use joint_positions"):
            robot.sensors([f"{name}l", f"{name}r"])
    assert robot.sensors(["vl", "vr"])(torch.tensor([1.0, 2.0]), "reflect-y").tolist() == [-2, -1]
