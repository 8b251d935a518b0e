"""What MuJoCo's releases say differently is asked in one place; verify runs on each of them."""

import re
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

from torchrl_sym import PointGroup, Symmetry
from torchrl_sym.mujoco import derive, verify
from torchrl_sym.mujoco.model.releases import weld_ids
from torchrl_sym.representations import pseudoscalar, scalar

PACKAGE = Path(__file__).parent.parent / "torchrl_sym" / "mujoco"
# The simulator's own notion, which decides what collides.
AS_SIMULATED = {"audit/contacts.py", "model/shapes.py", "model/releases.py"}
WORLD = """<mujoco><worldbody><geom type="plane" size="1 1 .1"/>
  <body name="fixed"><geom size=".1"/><body name="welded"><geom size=".1"/></body></body>
  <body name="target" mocap="true" pos=".3 .2 1"><geom size=".1"/><body name="tip"><geom size=".1"/>
    <body name="arm" pos="0 0 .3"><joint axis="1 0 0"/><geom size=".1"/></body></body></body>
  <body name="mirrored" mocap="true" pos=".3 -.2 1"><geom size=".1"/></body>
  <body name="free" pos="0 0 2"><freejoint/><geom size=".1"/>
    <body name="on it"><geom size=".1"/></body></body>
</worldbody></mujoco>"""


def test_what_hangs_on_a_mocap_body_is_moved_by_it():
    model = mujoco.MjModel.from_xml_string(WORLD)
    names = [model.body(b).name for b in range(model.nbody)]
    moved_by = {name: names[b] for name, b in zip(names, weld_ids(model), strict=True)}
    assert moved_by == {
        "world": "world", "fixed": "world", "welded": "world", "target": "target", "tip": "target",
        "arm": "arm", "mirrored": "mirrored", "free": "free", "on it": "free",
    }  # fmt: skip
    late = tuple(map(int, mujoco.__version__.split(".")[:2])) >= (3, 17)
    assert (weld_ids(model) == model.body_weldid).all() == late


def test_mocap_bodies_are_not_a_part_of_the_world():
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><body name="left" mocap="true" pos="0 .2 1"><geom size=".1"/></body>
        <body name="right" mocap="true" pos="0 -.2 1"><geom size=".1"/></body></worldbody></mujoco>"""
    )
    robot = derive(model, PointGroup.reflection("y"))
    position = torch.tensor([[[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]]])
    rotation = torch.tensor([[[1.0, 0, 0, 0], [1.0, 0, 0, 0]]])
    image, _ = robot.map_mocap(position, rotation, 1)
    np.testing.assert_allclose(image.numpy(), [[[0.4, -0.5, 0.6], [0.1, -0.2, 0.3]]], rtol=1e-6)


def test_no_other_file_asks_the_model_what_is_welded():
    asking = {
        str(path.relative_to(PACKAGE))
        for path in PACKAGE.rglob("*.py")
        if re.search(r"\bbody_weldid\b", path.read_text())
    }
    assert asking <= AS_SIMULATED, "use torchrl_sym.mujoco.model.releases.weld_ids"


def test_environments_of_dm_control_are_verified():
    suite = pytest.importorskip("dm_control.suite")
    group = PointGroup.reflection("x")
    odd, even = pseudoscalar(group), scalar(group)
    right = {"orientation": even + odd, "velocity": odd, "action": odd}
    env = suite.load("pendulum", "swingup", task_kwargs={"random": 0})
    assert verify(env, Symmetry(group, right)).passed
    wrong = verify(env, Symmetry(group, right | {"orientation": even + even}))
    assert (wrong.worst.part, wrong.worst.where) == ("kinematics", "orientation[1]")
