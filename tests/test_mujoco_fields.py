"""Whatever changes a mirrored step is in the audit: all numbers and flags of a rich model, on one side."""

import contextlib

import mujoco
import numpy as np
import pytest
import torch

from tests.rich_model import rich_model
from torchrl_sym import PointGroup
from torchrl_sym.mujoco import audit, derive

GROUP = PointGroup.reflection("y")
STATE = mujoco.mjtState.mjSTATE_INTEGRATION
KINDS = {
    **{"body": "nbody", "jnt": "njnt", "geom": "ngeom", "site": "nsite", "tendon": "ntendon"},
    **{"actuator": "nu", "eq": "neq", "pair": "npair", "dof": "nv", "wrap": "nwrap", "sensor": "nsensor"},
}
NAMED = {"jnt": "joint", "eq": "equality"}
# What MuJoCo derives to draw, to search or to index, and what nobody but a user reads.
LEFT_OUT = (
    "user",
    "rgba",
    "adr",
    "num",
    "id",
    "sameframe",
    "simple",
    "group",
    "ctrlspec",
    "wrap_type",
    "user",
)
FLAGS = {
    "jnt_limited": 1,
    "jnt_actfrclimited": 1,
    "jnt_actgravcomp": 1,
    "actuator_ctrllimited": 1,
    "actuator_forcelimited": 1,
    "actuator_actlimited": 1,
    "actuator_actearly": 1,
    "geom_condim": 2,
    "geom_contype": 2,
    "geom_priority": 1,
    "tendon_limited": 1,
    "tendon_actfrclimited": 1,
    "pair_dim": 2,
}


class Robot:
    """The model, some states and their images, and how far a step of one is from that of the other."""

    def __init__(self):
        self.model = rich_model()
        self.robot = derive(self.model, GROUP)
        rng = np.random.default_rng(0)
        self.states = [self.state(rng, *which) for which in ((2.0, 1, 15), (0.25, 1, 15), (1.5, 6, 40))]
        self.images = [self.image(data) for data in self.states]
        self.saved = [self.save(data) for data in (*self.states, *self.images)]
        self.one, self.other = mujoco.MjData(self.model), mujoco.MjData(self.model)

    def state(self, rng, height, effort, steps):
        data = mujoco.MjData(self.model)
        mujoco.mj_resetData(self.model, data)
        data.qpos[2] = height
        data.qvel[:] = 0.5 * effort * rng.normal(size=self.model.nv)
        data.ctrl[:] = effort * rng.uniform(0, 0.8, size=self.model.nu)
        data.act[:] = rng.uniform(0, 0.4, size=self.model.na)
        for _ in range(steps):
            mujoco.mj_step(self.model, data)
        return data

    def image(self, data):
        image, robot = mujoco.MjData(self.model), self.robot
        for field, move in (
            ("qpos", robot.map_qpos),
            ("qvel", robot.map_qvel),
            ("ctrl", robot.map_ctrl),
            ("act", robot.map_act),
            ("qacc_warmstart", robot.map_qvel),
        ):
            getattr(image, field)[:] = move(torch.as_tensor(np.array(getattr(data, field))), 1)
        poses = (torch.as_tensor(np.array(x)) for x in (data.mocap_pos, data.mocap_quat))
        image.mocap_pos[:], image.mocap_quat[:] = robot.map_mocap(*poses, 1)
        return image

    def save(self, data):
        out = np.zeros(mujoco.mj_stateSize(self.model, STATE))
        mujoco.mj_getState(self.model, data, out, STATE)
        return out

    def gap(self):
        """Largest difference of a mirrored step from the step of the mirror; 0 if a step is impossible."""
        worst, half = 0.0, len(self.states)
        for k in range(half):
            for data, saved in ((self.one, self.saved[k]), (self.other, self.saved[k + half])):
                mujoco.mj_setState(self.model, data, saved, STATE)
                try:
                    mujoco.mj_step(self.model, data)
                except Exception:
                    return 0.0
            for field, move in (("qvel", self.robot.map_qvel), ("act", self.robot.map_act)):
                expected = move(torch.as_tensor(np.array(getattr(self.one, field))), 1).numpy()
                worst = max(worst, float(np.abs(expected - getattr(self.other, field)).max()))
        return worst

    def rows_of_one_side(self, kind, count):
        """Rows of what is on the left, or in the middle."""
        rows = range(getattr(self.model, KINDS[kind]))
        if kind == "dof":
            names = [self.model.joint(int(j)).name for j in self.model.dof_jntid]
        elif kind == "wrap":
            names = [""] * count
        else:
            names = [getattr(self.model, NAMED.get(kind, kind))(i).name for i in rows]
        return [i for i, name in enumerate(names) if not name.startswith("right")]


@pytest.fixture(scope="module")
def robot():
    return Robot()


def fields_of(model, kind, letters):
    for name in dir(model):
        value = getattr(model, name, None)
        wanted = name.startswith(f"{kind}_") and not any(word in name for word in LEFT_OUT)
        if wanted and isinstance(value, np.ndarray) and value.dtype.kind in letters and value.size:
            yield name, value.reshape(len(value), -1)


def test_the_model_is_symmetric_and_rich(robot):
    report = audit(robot.model, GROUP)
    assert report.exact, str(report)
    assert robot.gap() < 1e-12
    assert any(data.ncon for data in robot.states)
    assert not report.unchecked


@contextlib.contextmanager
def changed(values, row, to):
    kept = np.array(values[row])
    values[row] = to
    try:
        yield
    finally:
        values[row] = kept


@pytest.mark.parametrize("kind", KINDS)
def test_numbers_that_change_a_mirrored_step_are_in_the_audit(robot, kind):
    hits, missed = 0, []
    for name, rows in fields_of(robot.model, kind, "f"):
        audited = 0
        for row in robot.rows_of_one_side(kind, len(rows)):
            for to in (1.05 * rows[row], np.where(rows[row] != 0, 1.05 * rows[row], 0.05)):
                with changed(rows, row, to):
                    if robot.gap() > 1e-9:
                        hits, audited = hits + 1, audited + 1
                        if audited <= 2 and audit(robot.model, GROUP).exact:
                            missed.append(f"{name}[{row}]")
                        break
    assert not missed
    assert hits or kind == "sensor"
    assert robot.gap() < 1e-12


@pytest.mark.parametrize("name", FLAGS)
def test_flags_that_change_a_mirrored_step_are_in_the_audit(robot, name):
    values, kind = getattr(robot.model, name), name.split("_")[0]
    for row in robot.rows_of_one_side(kind, len(values))[:6]:
        with changed(values, row, (int(values[row]) ^ FLAGS[name]) or 1):
            assert robot.gap() <= 1e-9 or not audit(robot.model, GROUP).exact, f"{name}[{row}]"


@pytest.mark.parametrize("joint", ["left_hinge", "left_slide"])
@pytest.mark.parametrize("name", ["qpos0", "qpos_spring"])
def test_reference_positions_are_in_the_audit(robot, name, joint):
    values, row = getattr(robot.model, name), robot.model.joint(joint).qposadr[0]
    with changed(values, row, values[row] + 0.05):
        assert robot.gap() > 1e-9
        assert not audit(robot.model, GROUP).exact


@pytest.mark.parametrize(("name", "value"), [("wind", (0.5, 0.1, 0.1)), ("gravity", (0.0, 1e-5, -9.81))])
def test_fields_of_the_world_are_in_the_audit(robot, name, value):
    with changed(getattr(robot.model.opt, name), slice(None), value):
        assert robot.gap() > 1e-9
        assert not audit(robot.model, GROUP).exact
