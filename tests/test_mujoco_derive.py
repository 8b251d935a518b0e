"""derive: published tables, independence of how a model is written, and equivariance of the simulator."""

import copy
import time
from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.robots import Limb, anymal, model, trifinger
from torchrl_sym import PointGroup
from torchrl_sym.mujoco import SymmetryError, derive

K4 = PointGroup.klein_four()
C3 = PointGroup.rotation(3)
LEGS = {"reflect-x": "LH RH LF RF", "reflect-y": "RF LF RH LH", "rot-180": "RH LH RF LF"}
SIGNS = {"reflect-x": "+--", "reflect-y": "-++", "rot-180": "---"}


def published_anymal(element: str) -> dict[str, str]:
    """The table of ANYmal's joints: leg to leg, signs for HAA, HFE, KFE."""
    legs = dict(zip(("LF", "RF", "LH", "RH"), LEGS[element].split(), strict=True))
    signs = dict(zip(("HAA", "HFE", "KFE"), SIGNS[element].replace("+", " "), strict=True))
    return {f"{a}_{j}": f"{s.strip()}{b}_{j}" for a, b in legs.items() for j, s in signs.items()}


def hinges(table: dict[str, str]) -> dict[str, str]:
    return {a: b for a, b in table.items() if a != "base"}


@pytest.mark.parametrize("element", LEGS)
@pytest.mark.parametrize("kind", ["joint", "actuator"])
def test_anymal_has_the_published_table(element, kind):
    robot = derive(model(anymal()), K4)
    assert hinges(robot.table(kind, element)) == published_anymal(element)


@pytest.mark.parametrize("turns", [1, 2])
def test_trifinger_turns_finger_to_finger_without_signs(turns):
    table = derive(model(*trifinger()), C3).table("joint", f"rot-{120 * turns}")
    # +120 degrees carries the finger at yaw -120 k to yaw -120 (k - 1)
    assert table == {
        f"finger{120 * k}_{j}": f"finger{120 * ((k - turns) % 3)}_{j}" for k in range(3) for j in range(3)
    }


@pytest.mark.parametrize(
    ("robot", "group"), [((anymal(),), K4), (trifinger(), C3)], ids=["ANYmal", "TriFinger"]
)
def test_derivation_takes_less_than_50_ms(robot, group):
    compiled = model(*robot)
    seconds = []
    for _ in range(20):
        start = time.process_time()
        derive(compiled, group)
        seconds.append(time.process_time() - start)
    assert min(seconds) < 0.05


@pytest.mark.parametrize("seed", range(3))
def test_result_does_not_depend_on_frames_order_or_names(seed):
    rng = np.random.default_rng(seed)

    def rewrite(limb: Limb) -> Limb:
        children = tuple(limb.children[i] for i in rng.permutation(len(limb.children)))
        return replace(limb, name=f"x{limb.name}", children=children)

    robot = derive(model(anymal().map(rewrite), frames=rng), K4)
    for element in LEGS:
        table = {a[1:]: b.replace("x", "") for a, b in robot.table("joint", element).items()}
        assert hinges(table) == published_anymal(element)


def test_axes_written_the_other_way_round_change_the_sign():
    base = anymal()
    left, right, *rest = base.children
    base = replace(base, children=(left, replace(right, axis=-right.axis), *rest))
    table = derive(model(base), PointGroup.reflection("y")).table("joint", "reflect-y")
    assert table["LF_HAA"] == "RF_HAA"
    assert table["LH_HAA"] == "-RH_HAA"


# --- against the simulator


def random_state(compiled, rng, height=0.4):
    """A random state; a floating base comes to lie near the ground, at any yaw and some tilt."""
    data = mujoco.MjData(compiled)
    for j in range(compiled.njnt):
        q = slice(compiled.jnt_qposadr[j], None)
        if compiled.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE:
            rotation = rng.standard_normal(4) * (1, 0.1, 0.1, 1)
            data.qpos[q][:7] = (*rng.uniform(-0.3, 0.3, 2), height, *(rotation / np.linalg.norm(rotation)))
        elif compiled.jnt_type[j] == mujoco.mjtJoint.mjJNT_BALL:
            rotation = rng.standard_normal(4)
            data.qpos[q][:4] = rotation / np.linalg.norm(rotation)
        else:
            data.qpos[q][0] += rng.uniform(-0.3, 0.3)
    data.qvel[:] = rng.uniform(-1, 1, compiled.nv)
    data.ctrl[:] = rng.uniform(-0.5, 0.5, compiled.nu)
    return data


def image_of(compiled, robot, data, g):
    """The state that the symmetry maps this one to, with the solver's warm start."""
    image = mujoco.MjData(compiled)
    tensors = {name: torch.as_tensor(getattr(data, name)) for name in ("qpos", "qvel", "ctrl", "act")}
    image.act[:] = robot.map_act(tensors["act"], g)
    image.qpos[:] = robot.map_qpos(tensors["qpos"], g)
    image.qvel[:] = robot.map_qvel(tensors["qvel"], g)
    image.ctrl[:] = robot.map_ctrl(tensors["ctrl"], g)
    image.qacc_warmstart[:] = robot.map_qvel(torch.as_tensor(data.qacc_warmstart), g)
    return image


def step_residual(compiled, robot, g, seed, steps=1) -> tuple[float, int]:
    """Largest error of the mirrored step against the step of the mirror, and the contacts met."""
    data = random_state(compiled, np.random.default_rng(seed))
    image = image_of(compiled, robot, data, g)
    for each in (data, image):
        mujoco.mj_step(compiled, each, steps)
    expected = robot.map_qpos(torch.as_tensor(data.qpos), g), robot.map_qvel(torch.as_tensor(data.qvel), g)
    pairs = zip(expected, (image.qpos, image.qvel), strict=True)
    errors = [float((a - torch.as_tensor(b)).abs().max()) for a, b in pairs]
    return max(errors), data.ncon


ROBOTS = {
    "ANYmal": (model(anymal()), K4),
    "ANYmal in random frames": (model(anymal(), frames=np.random.default_rng(0)), K4),
    "TriFinger": (model(*trifinger(), frames=np.random.default_rng(1)), C3),
}


@pytest.mark.parametrize("name", ROBOTS)
def test_one_step_in_contact_commutes_with_every_element(name):
    compiled, group = ROBOTS[name]
    robot = derive(compiled, group)
    contacts = 0
    for g in range(group.order):
        for seed in range(8):
            residual, met = step_residual(compiled, robot, g, seed)
            assert residual <= 1e-9, (group.names[g], seed)
            contacts += met
    assert contacts > 0 or name == "TriFinger"


def test_one_flipped_sign_or_two_swapped_legs_are_noticed():
    compiled = model(anymal())
    robot = derive(compiled, PointGroup.reflection("y"))
    index = robot.qvel.blocks[0].index
    assert step_residual(compiled, robot, 1, 0)[0] <= 1e-9
    robot.qvel.blocks[0].sign[1, 6] *= -1
    assert step_residual(compiled, robot, 1, 0)[0] > 1e-2
    robot.qvel.blocks[0].sign[1, 6] *= -1
    index[1, [6, 9]] = index[1, [9, 6]]
    assert step_residual(compiled, robot, 1, 0)[0] > 1e-2


@pytest.mark.parametrize("name", ROBOTS)
def test_one_element_per_row_maps_rows_as_it_does_one_by_one(name):
    compiled, group = ROBOTS[name]
    compiled = copy.deepcopy(compiled)
    compiled.qpos0[-9:] += 0.1 * np.arange(9)  # offsets: the pose that the group keeps is not at zero
    robot = derive(compiled, group, tolerance=2.0)
    assert any(robot.offsets(g) for g in group.names)
    generator = torch.Generator().manual_seed(0)
    g = torch.randint(group.order, (12, 5), generator=generator)
    maps = {"qpos": compiled.nq, "qvel": compiled.nv, "ctrl": compiled.nu, "act": compiled.na}
    for kind, size in maps.items():
        image = getattr(robot, f"map_{kind}")
        for dtype in (torch.float64, torch.float32):
            x = torch.randn(12, 5, size, generator=generator, dtype=dtype)
            expected = torch.stack([image(x, e) for e in range(group.order)])
            one_by_one = expected.gather(0, g[None, ..., None].expand(1, *x.shape))[0]
            torch.testing.assert_close(image(x, g), one_by_one)  # dense blocks round differently
            torch.testing.assert_close(image(x, g[:, 0])[:, 3], image(x[:, 3], g[:, 0]))
            assert torch.equal(image(x, group.names[-1]), expected[-1])
            assert image(x, g).dtype == dtype
    with pytest.raises(ValueError, match="expected indices of elements"):
        robot.map_qpos(torch.zeros(3, compiled.nq), g)
    with pytest.raises(KeyError, match="expected element indices"):
        robot.map_ctrl(torch.zeros(2, compiled.nu), torch.tensor([0, group.order]))


def test_ball_joints_and_slides_commute_in_random_frames():
    arm = Limb("left", np.array([0.1, 0.3, 0.5]), "ball", mass=0.7, com=np.array([0.1, 0.2, 0.0]))
    arm = replace(
        arm, children=(Limb("left_hand", np.array([0.2, 0.1, 0.0]), "slide", np.array([1.0, 0.5, 0.2])),)
    )
    mirror = np.diag([1.0, -1.0, 1.0])
    trunk = Limb("trunk", np.array([0.0, 0.0, 1.0]), "free", com=np.array([0.1, 0.0, 0.0]))
    other = arm.image(mirror, lambda name: name.replace("left", "right"), sign=-1.0)
    compiled = model(replace(trunk, children=(arm, other)), frames=np.random.default_rng(2), floor=False)
    robot = derive(compiled, PointGroup.reflection("y"))
    assert robot.table("joint", 1)["left_hand"] == "-right_hand"
    assert max(step_residual(compiled, robot, 1, seed, steps=5)[0] for seed in range(8)) <= 1e-9


def test_offsets_of_joints_whose_zero_is_not_symmetric():
    xml = """<mujoco><option gravity="0 0 0"/><worldbody>
      <body pos="0 .1 0"><joint name="a" axis="0 0 1" ref="20"/><geom size=".1" pos=".3 .1 0"/></body>
      <body pos="0 -.1 0"><joint name="b" axis="0 0 1" ref="-50"/><geom size=".1" pos=".3 -.1 0"/></body>
      </worldbody><actuator>
      <position name="a" joint="a" kp="5"/><position name="b" joint="b" kp="5"/></actuator>
      </mujoco>"""
    compiled = mujoco.MjModel.from_xml_string(xml)
    robot = derive(compiled, PointGroup.reflection("y"))
    assert robot.table("joint", 1) == {"a": "-b", "b": "-a"}
    assert robot.offsets(1)["a"] == pytest.approx(np.radians(-50 + 20))
    assert max(step_residual(compiled, robot, 1, seed, steps=20)[0] for seed in range(4)) <= 1e-12


# --- random trees


@st.composite
def limbs(draw, depth=3):
    """A random chain or bush of limbs off the planes of symmetry."""
    seed = draw(st.integers(0, 2**31))
    rng = np.random.default_rng(seed)

    def grow(level: int, name: str) -> Limb:
        axis = rng.standard_normal(3)
        children = (
            () if level == 0 else tuple(grow(level - 1, f"{name}{i}") for i in range(rng.integers(0, 3)))
        )
        spread = rng.standard_normal((3, 3)) * 0.05
        spread = spread @ spread.T + 0.003 * np.eye(3)  # second moments of a mass distribution
        inertia = np.trace(spread) * np.eye(3) - spread
        return Limb(
            name,
            rng.uniform(0.1, 0.4, 3) * (1, 1, -1),
            str(rng.choice(["hinge", "slide", "ball"])),
            axis / np.linalg.norm(axis),
            float(rng.uniform(0.3, 2.0)),
            rng.uniform(-0.1, 0.1, 3),
            inertia,
            children=children,
        )

    return seed, grow(depth, "limb")


@settings(max_examples=25, deadline=None)
@given(limbs(), st.sampled_from(["C2", "C3", "K4", "D3"]))
def test_random_symmetric_trees_are_recovered(drawn, name):
    seed, limb = drawn
    rng = np.random.default_rng(seed)
    group = {"C2": PointGroup.reflection("y"), "C3": C3, "K4": K4, "D3": PointGroup.dihedral(3)}[name]
    images = [
        limb.image(matrix.numpy(), lambda n, g=g: f"g{g}_{n}", sign=float(rng.choice([-1, 1])))
        for g, matrix in enumerate(group.matrices)
    ]
    trunk = Limb(
        "trunk", np.array([0.0, 0.0, 1.0]), "free", children=tuple(rng.permutation(np.array(images)))
    )
    compiled = model(trunk, frames=rng, floor=False)
    robot = derive(compiled, group)
    for g in range(group.order):
        bodies = robot.table("body", g)
        for h in range(group.order):
            assert bodies[f"g{h}_limb"] == f"g{int(group.table[g, h])}_limb"
        assert step_residual(compiled, robot, g, seed)[0] <= 1e-8


# --- refusals


def test_wrong_requests_say_what_and_what_to_do():
    compiled = model(anymal())
    tilt = PointGroup.generate({"flip": torch.diag(torch.tensor([1.0, -1, -1]))}, fixes_vertical=False)
    with pytest.raises(ValueError, match=r"tilts gravity.*fixes the vertical axis"):
        derive(compiled, tilt)
    with pytest.raises(KeyError, match="no keyframe 'home'; the model has none"):
        derive(compiled, K4, keyframe="home")
    with pytest.raises(SymmetryError, match=r"has no image under 'rot-120'.*pass keyframe"):
        derive(compiled, C3)
    with pytest.raises(KeyError, match="no hinge or slide joints"):
        derive(compiled, K4).joints(["LF_TOE"])
    with pytest.raises(ValueError, match=r"sends LF_HAA to L?RF_HAA, which is not among"):
        derive(compiled, PointGroup.reflection("y")).joints(["LF_HAA"])


def test_missing_leg_and_missing_motor_are_named():
    base = anymal()
    with pytest.raises(SymmetryError, match="has no image under 'reflect-y'"):
        derive(model(replace(base, children=base.children[:3])), PointGroup.reflection("y"))
    xml = """<mujoco><worldbody><body pos="0 .1 0"><joint name="a"/><geom size=".1"/></body>
      <body pos="0 -.1 0"><joint name="b"/><geom size=".1"/></body></worldbody>
      <actuator><motor name="a" joint="a"/></actuator></mujoco>"""
    with pytest.raises(SymmetryError, match="a has no image: no actuator drives"):
        derive(mujoco.MjModel.from_xml_string(xml), PointGroup.reflection("y"))


def test_subset_of_joints_and_readable_table():
    robot = derive(model(anymal()), K4)
    names = ["RF_HAA", "LF_HAA", "RH_HAA", "LH_HAA"]
    assert robot.joints(names)(torch.tensor([1.0, 2, 3, 4]), "reflect-y").tolist() == [-2, -1, -4, -3]
    lines = str(robot).splitlines()
    assert "reflect-x" in lines[2]
    assert any(line.split() == ["LF_HAA", "LH_HAA", "-RF_HAA", "-RH_HAA"] for line in lines)


def test_thrusters_on_welded_mounts_are_mapped_by_where_they_point():
    def mount(
        name: str, side: int, last: str
    ) -> str:  # the same place and direction, however it is written
        return f"""<body name="{name}" pos=".3 {0.2 * side} 0" euler="{40 * side} 0 0"><geom size=".05"/>
          <body pos="0 0 .1" euler="0 30 0"><body pos="0 0 .1" euler="{20 * side} 25 0">{last}</body></body>
          </body>"""

    mounts = mount("left", 1, '<site name="left" euler="35 0 0"/>')
    mounts += mount("right", -1, '<body euler="-35 0 0"><site name="right"/></body>')
    xml = f"""<mujoco><worldbody><body name="hull" pos="0 0 1"><freejoint/><geom size=".1"/>{mounts}</body>
      </worldbody><actuator><motor name="left" site="left" gear="0 0 1 0 0 .5"/>
      <motor name="right" site="right" gear="0 0 -1 0 0 .5"/></actuator></mujoco>"""
    compiled = mujoco.MjModel.from_xml_string(xml)
    robot = derive(compiled, PointGroup.reflection("y"))
    assert robot.table("actuator", 1) == {"left": "-right", "right": "-left"}
    assert max(step_residual(compiled, robot, 1, seed)[0] for seed in range(4)) <= 1e-9
