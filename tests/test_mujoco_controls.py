"""Wrong symmetries of robots and objects are noticed, and the guilty part is named."""

import mujoco
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.robots import Limb, model, trifinger
from tests.test_mujoco_derive import limbs
from torchrl_sym import PointGroup, Representation
from torchrl_sym.mujoco import audit, derive
from torchrl_sym.representations import height_map

C3 = PointGroup.rotation(3)
CUBE = """<mujoco><option cone="elliptic"/><worldbody><geom type="plane" size="2 2 .1"/>
  <body name="cube" pos="0 0 .05"><freejoint/><geom name="cube" type="{shape}" size="{size}"/></body>
</worldbody></mujoco>"""


def test_cube_conjugated_by_a_turn_that_is_not_its_own_is_named():
    cube = mujoco.MjModel.from_xml_string(CUBE.format(shape="box", size=".0325 .0325 .0325"))
    report = audit(cube, C3)
    assert not report.exact
    assert report.worst is not None
    assert (report.worst.term, report.worst.name.split(" ")[0]) == ("collision geometry", "cube")
    assert audit(cube, PointGroup.rotation(4)).exact
    puck = mujoco.MjModel.from_xml_string(CUBE.format(shape="cylinder", size=".0325 .0325"))
    assert audit(puck, C3).exact


def test_cube_in_contact_disagrees_with_the_simulator_where_the_audit_says_so():
    cube = mujoco.MjModel.from_xml_string(CUBE.format(shape="box", size=".0325 .0325 .0325"))
    errors = {}
    for name, group in (("turn of its own", PointGroup.rotation(4)), ("not its own", C3)):
        robot = derive(cube, group)
        errors[name] = max(resting_residual(cube, robot, 1, seed) for seed in range(8))
    assert errors["turn of its own"] <= 1e-9
    assert errors["not its own"] > 1e-2


def resting_residual(cube: mujoco.MjModel, robot, g: int, seed: int) -> float:
    """Velocity error of a step of the mapped cube, which lies a little tilted on the floor."""
    rng = np.random.default_rng(seed)
    data, image = mujoco.MjData(cube), mujoco.MjData(cube)
    tilt = np.array([1.0, *rng.uniform(-0.1, 0.1, 2), rng.uniform(-1, 1)])
    data.qpos[:] = (0.1, 0.0, 0.034, *(tilt / np.linalg.norm(tilt)))
    data.qvel[:] = rng.uniform(-0.2, 0.2, 6)
    image.qpos[:] = robot.map_qpos(torch.as_tensor(data.qpos), g)
    image.qvel[:] = robot.map_qvel(torch.as_tensor(data.qvel), g)
    for each in (data, image):
        mujoco.mj_step(cube, each)
    return float(np.abs(robot.map_qvel(torch.as_tensor(data.qvel), g).numpy() - image.qvel).max())


def test_forward_biased_height_map_is_refused():
    with pytest.raises(ValueError, match="not closed under 'reflect-x': point"):
        height_map(
            PointGroup.klein_four(), x=torch.linspace(-0.5, 1.5, 21), y=torch.linspace(-0.5, 0.5, 11)
        )


def test_swapped_legs_are_refused_when_they_do_not_compose():
    robot = derive(model(*trifinger()), C3)
    matrices = robot.joint_positions.matrices.clone()
    matrices[1] = matrices[1][[3, 4, 5, 0, 1, 2, 6, 7, 8]]
    with pytest.raises(ValueError, match="not a representation"):
        Representation(C3, matrices)


@settings(max_examples=20, deadline=None)
@given(limbs(), st.sampled_from(["mass", "com", "inertia"]), st.integers(0, 2**31))
def test_one_random_perturbation_is_detected_and_named(drawn, term, seed):
    _, limb = drawn
    rng = np.random.default_rng(seed)
    group = PointGroup.reflection("y")
    images = [
        limb.image(matrix.numpy(), lambda n, g=g: f"g{g}_{n}") for g, matrix in enumerate(group.matrices)
    ]
    trunk = Limb("trunk", np.array([0.0, 0.0, 1.0]), "free", children=tuple(images))
    compiled = model(trunk, floor=False)
    assert audit(compiled, group).exact
    body = int(rng.integers(2, compiled.nbody))
    if term == "mass":
        compiled.body_mass[body] *= 1.01
    elif term == "com":
        compiled.body_ipos[body] += 0.003
    else:
        compiled.body_inertia[body] *= 1.02
    report = audit(compiled, group)
    assert not report.exact
    guilty = compiled.body(body).name.split("_", 1)[1]
    terms = {"mass": "mass", "com": "centre of mass", "inertia": "inertia"}
    assert any(terms[term] in row.term and guilty in row.name for row in report.residuals), str(report)
