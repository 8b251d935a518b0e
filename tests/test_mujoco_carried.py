"""Carried objects: a turn of the world takes along a body of any shape, whose own frame stays."""

import mujoco
import numpy as np
import pytest
import torch
from dm_control import mujoco as dm_mujoco
from dm_control.rl import control
from dm_control.suite import base

from tests import robots
from tests.robots import anymal, mjcf, model, text, trifinger
from torchrl_sym import PointGroup, Symmetry
from torchrl_sym.mujoco import SymmetryError, audit, derive, symmetrize_with_report, verify
from torchrl_sym.mujoco.__main__ import Arguments, main
from torchrl_sym.representations import polar, quaternion

C3 = PointGroup.rotation(3)
CARRIED = ("cube", "goal")
CUBE = np.full(3, 0.0325)
BOX = np.array([0.02, 0.04, 0.03])  # half edges, all different
TETHER = '<equality><weld body1="goal" body2="cube" solref=".1 1"/></equality>'
STATE = ("qpos", "qvel", "ctrl", "qacc_warmstart", "mocap_pos", "mocap_quat")


def rotation(seed: int) -> str:
    q = np.random.default_rng(seed).standard_normal(4)
    return text(q / np.linalg.norm(q))


def written(edges: np.ndarray = CUBE, more: str = "", inertia: str = "", frames: int | None = 1) -> str:
    """TriFinger, a free block 1 mm above the table (touching breaks exactness), and a goal for it."""
    inertia = inertia or f'<inertial pos="0 0 0" mass=".094" diaginertia="{text([6.6e-5] * 3)}"/>'
    block = f'<geom name="{{}}" type="box" size="{text(edges)}" {{}}/>'
    objects = f"""<body name="cube" pos=".01 -.02 {edges[2] + 1e-3}"><freejoint name="cube"/>{inertia}
        {block.format("cube", "")}<camera name="cube" pos=".01 0 .02" quat="{rotation(6)}"/>
        <site name="cube" pos=".01 .02 .01" quat="{rotation(3)}" size=".05"/></body>
      <body name="goal" mocap="true" pos=".05 .03 .1" quat="{rotation(4)}">
        {block.format("goal", 'contype="0" conaffinity="0"')}
        <site name="goal" pos="0 .01 0" quat="{rotation(5)}"/></body>"""
    rng = None if frames is None else np.random.default_rng(frames)
    return mjcf(*trifinger(), frames=rng, objects=objects, more=more)


def scene(*args, **options) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(written(*args, **options))


def uneven(seed: int) -> str:
    """A block with no symmetry at all: three different edges, any inertia in any frame off its middle."""
    rng = np.random.default_rng(seed)
    moments = rng.uniform(4e-5, 6e-5, 3)
    inertia = f"""<inertial pos="{text(rng.uniform(-0.008, 0.008, 3))}" quat="{rotation(seed)}" mass=".1"
      diaginertia="{text(moments)}"/>"""
    return written(rng.permutation(BOX) * rng.uniform(0.9, 1.1, 3), inertia=inertia)


def start(compiled: mujoco.MjModel, seed: int) -> mujoco.MjData:
    """Fingers about to grasp the block, which lies at any yaw; the goal anywhere."""
    rng, data = np.random.default_rng(seed), mujoco.MjData(compiled)
    data.qpos[:9] = np.array([0.2, 0.9, -1.8] * 3) + rng.uniform(-0.08, 0.08, 9)
    data.ctrl[:] = np.array([0.35, 0.8, -1.7] * 3) + rng.uniform(-0.1, 0.1, 9)
    yaw = rng.uniform(-np.pi, np.pi)
    data.qpos[9:11] += rng.uniform(-0.01, 0.01, 2)
    data.qpos[12:16] = (np.cos(yaw / 2), 0, 0, np.sin(yaw / 2))
    data.qvel[:] = rng.uniform(-0.2, 0.2, compiled.nv)
    data.mocap_pos[:] += rng.uniform(-0.02, 0.02, (1, 3))
    data.mocap_quat[:] = rng.standard_normal((1, 4))
    data.mocap_quat[:] /= np.linalg.norm(data.mocap_quat)
    return data


def image_of(robot, data: mujoco.MjData, g: int) -> mujoco.MjData:
    image = mujoco.MjData(robot.model)
    values = {name: torch.tensor(getattr(data, name)) for name in STATE}
    for name in ("qpos", "qvel", "ctrl"):
        getattr(image, name)[:] = getattr(robot, f"map_{name}")(values[name], g)
    image.qacc_warmstart[:] = robot.map_qvel(values["qacc_warmstart"], g)
    image.mocap_pos[:], image.mocap_quat[:] = robot.map_mocap(values["mocap_pos"], values["mocap_quat"], g)
    image.time = data.time
    return image


def residual(robot, g: int, seed: int, steps: int, warm_up: int = 0) -> tuple[float, set[str]]:
    """Error of positions and velocities of the mapped state's steps, and what the block has touched."""
    compiled, data = robot.model, start(robot.model, seed)
    mujoco.mj_step(compiled, data, warm_up)
    image, touched = image_of(robot, data, g), set()
    for _ in range(steps):
        for each in (data, image):
            mujoco.mj_step(compiled, each)
        block = compiled.geom("cube").id
        pairs = [set(pair.tolist()) for pair in data.contact.geom if block in pair]
        touched |= {"table" if 0 in pair else "finger" for pair in pairs}
    gaps = [
        np.abs(robot.map_qpos(torch.tensor(data.qpos), g).numpy() - image.qpos).max(),
        np.abs(robot.map_qvel(torch.tensor(data.qvel), g).numpy() - image.qvel).max(),
    ]
    return float(max(gaps)), touched


SCENES = {
    "cube": scene(),
    "tethered to the goal": scene(more=TETHER),
    **{f"uneven {k}": mujoco.MjModel.from_xml_string(uneven(k)) for k in range(3)},
}


@pytest.mark.parametrize("steps", [1, 100])
@pytest.mark.parametrize("name", SCENES)
def test_steps_in_contact_commute_with_every_element(name, steps):
    robot, touched = derive(SCENES[name], C3, carried=CARRIED), set()
    for g in range(3):
        for seed in range(4):
            error, parts = residual(robot, g, seed, steps, warm_up=20 if steps == 1 else 0)
            assert error <= 1e-8, (g, seed)
            touched |= parts
    assert touched == {"table", "finger"}


@pytest.mark.parametrize("name", SCENES)
def test_conjugation_is_noticed_in_the_same_states(name):
    if name.startswith("uneven"):
        with pytest.raises(
            SymmetryError, match=r"cube has no image.*mm beside it.*pass carried=\['cube'\]"
        ):
            derive(SCENES[name], C3)
    robot = derive(SCENES[name], C3, tolerance=1.0)
    for g in (1, 2):
        errors = [residual(robot, g, seed, steps=5, warm_up=20)[0] for seed in range(4)]
        assert max(errors) > 1e-2


def test_positions_are_a_representation_and_the_block_rotates_from_the_left():
    robot = derive(SCENES["uneven 0"], C3, carried=CARRIED)
    generator = torch.Generator().manual_seed(0)
    qpos = torch.randn(6, 16, generator=generator, dtype=torch.float64)
    mocap = tuple(torch.randn(6, 1, n, generator=generator, dtype=torch.float64) for n in (3, 4))
    for g in range(3):
        for h in range(3):
            gh = int(C3.table[g, h])
            torch.testing.assert_close(robot.map_qpos(robot.map_qpos(qpos, h), g), robot.map_qpos(qpos, gh))
            twice = robot.map_mocap(*robot.map_mocap(*mocap, h), g)
            for a, b in zip(twice, robot.map_mocap(*mocap, gh), strict=True):
                torch.testing.assert_close(a, b)
        quaternions = torch.stack([qpos[:, 12:], mocap[1][:, 0]])
        images = torch.stack([robot.map_qpos(qpos, g)[:, 12:], robot.map_mocap(*mocap, g)[1][:, 0]])
        for x, y in zip(quaternions.flatten(0, 1), images.flatten(0, 1), strict=True):
            torch.testing.assert_close(matrix_of(y), C3.matrices[g] @ matrix_of(x))
    qvel = torch.randn(6, 15, generator=generator, dtype=torch.float64)
    for g in range(3):  # body-frame angular velocities stay, bit by bit
        assert torch.equal(robot.map_qvel(qvel, g)[:, 12:], qvel[:, 12:])
        torch.testing.assert_close(robot.map_qvel(qvel, g)[:, 9:12], qvel[:, 9:12] @ C3.matrices[g].mT)


def matrix_of(q: torch.Tensor) -> torch.Tensor:
    out = np.zeros(9)
    mujoco.mju_quat2Mat(out, (q / q.norm()).numpy())
    return torch.as_tensor(out).reshape(3, 3)


def test_carried_bodies_are_matched_with_themselves_at_any_pose():
    """Not so without: of three equal cubes round the axis, each is the image of another."""
    cubes = "".join(
        f"""<body name="c{k}" pos="{text(robots.turn(120 * k) @ (0.1, 0.0, 0.0335))}" euler="0 0 {120 * k}">
          <freejoint/><geom type="box" size="{text(CUBE)}" mass=".1"/></body>"""
        for k in range(3)
    )
    pose = " ".join(f".{k} .1 .2 {rotation(k)}" for k in range(3))
    compiled = mujoco.MjModel.from_xml_string(
        f"""<mujoco><worldbody>{cubes}</worldbody><keyframe><key qpos="{pose}"/></keyframe></mujoco>"""
    )
    assert derive(compiled, C3).table("body", 1)["c0"] == "c1"
    one, other = (derive(compiled, C3, key, carried=["c0", "c1", "c2"]) for key in (None, 0))
    assert one.table("body", 1) == {name: name for name in ("world", "c0", "c1", "c2")}
    qpos = torch.randn(4, 21, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    torch.testing.assert_close(one.map_qpos(qpos, 2), other.map_qpos(qpos, 2))


def test_one_element_per_row():
    robot = derive(SCENES["cube"], C3, carried=CARRIED)
    generator = torch.Generator().manual_seed(0)
    g = torch.randint(3, (50,), generator=generator)
    qpos, position, rotation_ = (
        torch.randn(50, *shape, generator=generator, dtype=torch.float64)
        for shape in ((16,), (1, 3), (1, 4))
    )
    images = robot.map_qpos(qpos, g), *robot.map_mocap(position, rotation_, g)
    for e in range(3):
        expected = robot.map_qpos(qpos, e), *robot.map_mocap(position, rotation_, e)
        for image, one in zip(images, expected, strict=True):
            torch.testing.assert_close(image[g == e], one[g == e])


def test_wrong_requests_name_the_body_and_the_remedy():
    compiled = scene()
    with pytest.raises(KeyError, match=r"no body 'cup' to be carried; free and mocap.*'cube', 'goal'"):
        derive(compiled, C3, carried=["cup"])
    with pytest.raises(ValueError, match="'finger0_0' cannot be carried: it is neither a free body"):
        derive(compiled, C3, carried=["finger0_0"])
    with pytest.raises(ValueError, match="'base' cannot be carried: 'LF_HAA' moves on it"):
        audit(model(anymal()), C3, carried=["base"])
    for group, element in ((PointGroup.klein_four(), "reflect-x"), (PointGroup.rotation(2), "rot-180")):
        with pytest.raises(SymmetryError, match=f"cube, goal cannot be carried along.*'{element}'.*leave"):
            derive(compiled, group, carried=CARRIED)
    reason = audit(compiled, PointGroup.klein_four(), carried=["cube"]).reason
    assert reason is not None
    assert reason.startswith("cube cannot be carried along: 'reflect-x' is a reflection")


# --- audit, sensors, averages


@pytest.mark.parametrize("name", SCENES)
def test_audit_is_exact_with_carried_objects_only(name):
    report = audit(SCENES[name], C3, carried=CARRIED)
    assert report.exact, str(report)
    without = audit(SCENES[name], C3)
    assert not without.exact
    culprit = without.reason if without.worst is None else without.worst.name
    assert any(name in culprit for name in ("goal", "cube", "equality 0"))
    assert not audit(SCENES[name], C3, carried=["goal"]).exact


def test_audit_still_finds_what_is_wrong_with_the_fingers_and_the_damping_of_a_carried_body():
    compiled = scene()
    compiled.body_mass[compiled.body("finger120_1").id] *= 1.05
    compiled.dof_damping[-6:-3] = (0.1, 0.1, 0.3)  # about the vertical: kept
    report = audit(compiled, C3, carried=CARRIED)
    assert {row.term for row in report.residuals if row.residual > 1e-8} == {"mass"}
    compiled.dof_damping[-6] = 0.2
    terms = {row.term for row in audit(compiled, C3, carried=CARRIED).residuals if row.residual > 1e-8}
    assert "damping" in terms


SENSORS = [
    *(
        f'<{kind} site="cube"/>'
        for kind in ("accelerometer", "velocimeter", "gyro", "magnetometer", "force", "torque", "touch")
    ),
    *(
        f'<{kind} {of} {reference}/>'
        for kind in ("framepos", "framequat", "framexaxis", "framezaxis")
        for of in (
            *(f'objtype="{o}" objname="cube"' for o in ("xbody", "body", "geom", "site", "camera")),
            'objtype="site" objname="goal"',
        )
        for reference in ("", 'reftype="site" refname="goal"', 'reftype="camera" refname="cube"')
    ),
    *(
        f'<{kind} objtype="site" objname="cube" {reference}/>'
        for kind in ("framepos", "framequat", "framelinvel", "frameangvel", "frameyaxis")
        for reference in ("", *(f'reftype="xbody" refname="finger{k}_2"' for k in (0, 120, 240)))
    ),
    *(
        f'<{kind} objtype="xbody" objname="finger{k}_2" reftype="site" refname="cube"/>'
        for kind in ("framepos", "framequat", "framelinvel", "frameangvel")
        for k in (0, 120, 240)
    ),
    *(f'<framelinacc objtype="{o}" objname="cube"/><frameangacc objtype="{o}" objname="cube"/>'
      for o in ("xbody", "site")),
    *(f'<{kind} cutoff=".3" body1="finger{k}_2" geom2="cube"/>'
      for kind in ("distance", "normal", "fromto") for k in (0, 120, 240)),
    '<subtreecom body="cube"/><subtreelinvel body="cube"/><subtreeangmom body="cube"/>',
]  # fmt: skip


@pytest.mark.parametrize("frames", [None, 1])
def test_sensors_on_carried_bodies(frames):
    option = f'<option magnetic="0 0 -.5"/><sensor>{"".join(SENSORS)}</sensor>'
    robot = derive(scene(BOX, option, frames=frames), C3, carried=CARRIED)
    compiled, quaternions = robot.model, int(mujoco.mjtSensor.mjSENS_FRAMEQUAT)
    for seed in range(6):
        data = start(compiled, seed)
        mujoco.mj_step(compiled, data, 20)
        for g in range(3):
            image = image_of(robot, data, g)
            for each in (data, image):
                mujoco.mj_forward(compiled, each)
            expected = robot.sensordata(torch.tensor(data.sensordata), g).numpy()
            for s in range(compiled.nsensor):
                part = slice(compiled.sensor_adr[s], compiled.sensor_adr[s] + compiled.sensor_dim[s])
                a, b = image.sensordata[part], expected[part]
                sign = -1 if compiled.sensor_type[s] == quaternions and a @ b < 0 else 1
                assert np.abs(a - sign * b).max() <= 1e-8 * max(1, np.abs(b).max()), SENSORS[s]


def test_symmetrize_leaves_carried_bodies_and_evens_the_fingers():
    spec = mujoco.MjSpec.from_string(uneven(0))
    spec.body("finger120_1").mass *= 1.03
    before = spec.compile()
    assert not audit(before, C3, carried=CARRIED).exact
    even, report = symmetrize_with_report(spec, C3, carried=CARRIED)
    after = even.compile()
    assert audit(after, C3, carried=CARRIED).exact
    assert {change.name for change in report.changes} == {f"finger{k}_1" for k in (0, 120, 240)}
    assert report.left == ["body 'cube' is only carried along", "body 'goal' is only carried along"]
    for name in CARRIED:
        for values in ("pos", "quat", "ipos", "iquat", "inertia", "mass"):
            one, other = (getattr(m.body(name), values) for m in (before, after))
            np.testing.assert_allclose(other, one, atol=1e-15)
        for kind in ("geom", "site"):
            for values in ("pos", "quat", "size"):
                one, other = (getattr(getattr(m, kind)(name), values) for m in (before, after))
                np.testing.assert_allclose(other, one, atol=1e-15)


# --- environments and the command line


PUSHERS = "".join(
    f"""<body pos="{text(np.array([np.cos(a), np.sin(a), 0]) * 0.3)}" euler="0 0 {float(np.degrees(a))!r}">
      <joint name="push{k}" type="slide" axis="-1 0 0" damping="4" range="-.1 .24"/>
      <geom type="sphere" size=".03" mass=".2" pos="0 0 .04"/></body>"""
    for k, a in enumerate(2 * np.pi / 3 * np.arange(3))
)
TABLE = f"""<mujoco><option cone="elliptic" timestep=".005"/>
  <worldbody><geom type="plane" size="1 1 .1"/>{PUSHERS}
    <body name="block" pos="0 0 .031"><freejoint/><geom type="box" size="{text(BOX)}" mass=".1"/></body>
    <body name="goal" mocap="true" pos="0 0 .1"/></worldbody>
  <actuator>{"".join(f'<motor joint="push{k}" ctrlrange="-1 1"/>' for k in range(3))}</actuator></mujoco>"""


class Push(base.Task):
    """Push a block, of three different edges, to where the goal is."""

    def initialize_episode(self, physics) -> None:
        physics.data.qpos[:3] = self.random.uniform(0, 0.15, 3)
        angles = self.random.uniform(0, 4 * np.pi, 2) / 2  # both signs of a quaternion alike
        radius, way = 0.03 * np.sqrt(self.random.uniform()), self.random.uniform(0, 2 * np.pi)
        physics.data.qpos[3:5] = radius * np.cos(way), radius * np.sin(way)
        physics.data.qpos[6:] = np.cos(angles[0]), 0, 0, np.sin(angles[0])
        physics.data.mocap_quat[:] = np.cos(angles[1]), 0, 0, np.sin(angles[1])
        super().initialize_episode(physics)

    def get_observation(self, physics) -> dict:
        data = physics.data
        return {
            "joints": data.qpos[:3],
            "at": data.qpos[3:6],
            "turn": data.qpos[6:],
            "goal": data.mocap_quat,
        }

    def get_reward(self, physics) -> float:
        return float(np.dot(physics.data.qpos[6:], physics.data.mocap_quat[0]) ** 2)


def test_verify_with_carried_objects():
    env = control.Environment(dm_mujoco.Physics.from_xml_string(TABLE), Push(random=0))
    robot = derive(env.physics.model.ptr, C3, carried=["block", "goal"])
    turned = quaternion(C3, "left")
    entries = {"joints": robot.joint_positions, "at": polar(C3), "turn": turned, "goal": turned}
    symmetry = Symmetry(C3, {**entries, "action": robot.actuators})
    report = verify(env, symmetry, carried=["block", "goal"], states=24, steps=5)
    assert report.passed, str(report)
    assert report.contacts > 12
    wrong = verify(env, symmetry, states=8, steps=5)
    assert wrong.worst.part in ("contact", "dynamics")


def test_command_line(tmp_path, capsys):
    path = tmp_path / "push.xml"
    path.write_text(TABLE)
    assert main(Arguments(path, group="rotation-3", carried=("block", "goal"))) == 0
    assert "exact" in capsys.readouterr().out.splitlines()
    out = tmp_path / "out.xml"
    assert main(Arguments(path, group="rotation-3", carried=("block", "goal"), out=out)) == 0
    assert out.exists()
    main(Arguments(path, group="rotation-3"))
    assert "exact" not in capsys.readouterr().out.splitlines()[-3:]
