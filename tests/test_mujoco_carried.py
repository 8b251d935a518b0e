"""Carried objects: a turn of the world takes along a body of any shape, whose own frame stays."""

import mujoco
import numpy as np
import pytest
import torch

from tests.robots import anymal, model, text, trifinger
from torchrl_sym import PointGroup
from torchrl_sym.mujoco import SymmetryError, audit, derive

C3 = PointGroup.rotation(3)
CARRIED = ("cube", "goal")
CUBE = np.full(3, 0.0325)
BOX = np.array([0.02, 0.04, 0.03])  # half edges, all different
TETHER = '<equality><weld body1="goal" body2="cube" solref=".1 1"/></equality>'
STATE = ("qpos", "qvel", "ctrl", "qacc_warmstart", "mocap_pos", "mocap_quat")


def rotation(seed: int) -> str:
    q = np.random.default_rng(seed).standard_normal(4)
    return text(q / np.linalg.norm(q))


def scene(edges: np.ndarray = CUBE, more: str = "", inertia: str = "", frames: int = 1) -> mujoco.MjModel:
    """TriFinger, a free block 1 mm above the table (touching breaks exactness), and a goal for it."""
    inertia = inertia or f'<inertial pos="0 0 0" mass=".094" diaginertia="{text([6.6e-5] * 3)}"/>'
    block = f'<geom name="{{}}" type="box" size="{text(edges)}" {{}}/>'
    objects = f"""<body name="cube" pos=".01 -.02 {edges[2] + 1e-3}"><freejoint name="cube"/>{inertia}
        {block.format("cube", "")}<site name="cube" pos=".01 .02 .01" quat="{rotation(3)}"/></body>
      <body name="goal" mocap="true" pos=".05 .03 .1" quat="{rotation(4)}">
        {block.format("goal", 'contype="0" conaffinity="0"')}
        <site name="goal" pos="0 .01 0" quat="{rotation(5)}"/></body>"""
    return model(*trifinger(), frames=np.random.default_rng(frames), objects=objects, more=more)


def uneven(seed: int) -> mujoco.MjModel:
    """A block with no symmetry at all: three different edges, any inertia in any frame off its middle."""
    rng = np.random.default_rng(seed)
    moments = rng.uniform(4e-5, 6e-5, 3)
    inertia = f"""<inertial pos="{text(rng.uniform(-0.008, 0.008, 3))}" quat="{rotation(seed)}" mass=".1"
      diaginertia="{text(moments)}"/>"""
    return scene(rng.permutation(BOX) * rng.uniform(0.9, 1.1, 3), inertia=inertia)


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
    "uneven 0": uneven(0),
    "uneven 1": uneven(1),
    "uneven 2": uneven(2),
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
    robot = derive(SCENES[name], C3)
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
