"""verify with memory: what an environment remembers beside MuJoCo's state is put back, and mirrored."""

from typing import ClassVar

import mujoco
import numpy as np
import pytest
import torch
from dm_control import mujoco as dm_mujoco
from dm_control.rl import control
from torchrl.envs import GymWrapper
from torchrl.envs.libs.dm_control import DMControlWrapper

from torchrl_sym import PointGroup, Symmetry
from torchrl_sym.mujoco import Remembered, derive, verify
from torchrl_sym.representations import scalar
from torchrl_sym.testing import assert_env_symmetric

gymnasium = pytest.importorskip("gymnasium")
pytest.importorskip("imageio")  # gymnasium's MuJoCo environments import it
from gymnasium.envs.mujoco import MujocoEnv  # noqa: E402

XML = """<mujoco><worldbody>
  <body pos="0 .2 1"><joint name="left" axis="0 1 0" damping=".1"/><geom size=".05" pos="0 0 -.3"/></body>
  <body pos="0 -.2 1"><joint name="right" axis="0 1 0" damping=".1"/><geom size=".05" pos="0 0 -.3"/></body>
  </worldbody><actuator><motor name="left" joint="left" ctrlrange="-1 1"/>
  <motor name="right" joint="right" ctrlrange="-1 1"/></actuator></mujoco>"""
GROUP = PointGroup.reflection("y")
ROBOT = derive(mujoco.MjModel.from_xml_string(XML), GROUP)
ARMS = ROBOT.joints(["left", "right"])  # exchanged by the mirror
ACTIONS = ROBOT.actuators
LAST = {"last": ACTIONS, "last2": ACTIONS}


class Arms(MujocoEnv):
    """Two arms; what is observed, rewarded and kept is up to the functions below."""

    metadata: ClassVar = {"render_modes": ["human", "rgb_array", "depth_array", "rgbd_tuple"]}

    def __init__(self, path, observe, reward=lambda env: 0.0, keep=lambda env, action: None):
        self.observe, self.reward, self.keep = observe, reward, keep
        box = gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float64)
        self.forget()
        super().__init__(str(path), 2, observation_space=box)
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, self._get_obs().shape, np.float64)

    def forget(self):
        self.last, self.last2, self.frames, self.count = np.zeros(2), np.zeros(2), None, 0

    def step(self, action):
        self.frames = [self.data.qpos.copy(), self.data.qvel.copy()]
        self.last2, self.last = self.last, np.array(action)
        self.keep(self, action)
        self.count += 1
        self.do_simulation(action, self.frame_skip)
        return self._get_obs(), self.reward(self), False, False, {}

    def _get_obs(self):
        return self.observe(self)

    def reset_model(self):
        self.forget()
        self.set_state(self.np_random.uniform(-1, 1, 2), self.np_random.uniform(-1, 1, 2))
        return self._get_obs()


@pytest.fixture
def make(tmp_path):
    path = tmp_path / "arms.xml"
    path.write_text(XML)
    return lambda *args, **kwargs: Arms(path, *args, **kwargs)


def last_two(env):
    return np.concatenate([env.data.qpos, env.data.qvel, env.last, env.last2])


def term_major(env):
    """Positions now and before, then velocities now and before."""
    now, old = [env.data.qpos, env.data.qvel], env.frames or [env.data.qpos, env.data.qvel]
    return np.concatenate([frame for pair in zip(now, old, strict=True) for frame in pair])


def joints(env):
    return env.data.qpos.copy()


FRAMES = Remembered(
    {"frames": ARMS * 2},
    save=lambda env: {"frames": np.concatenate(env.frames or [env.data.qpos, env.data.qvel])},
    load=lambda env, values: setattr(env, "frames", np.split(values["frames"], 2)),
)


def report_of(env, observation, memory=None, **kwargs):
    symmetry = Symmetry(GROUP, {"observation": observation, "action": ACTIONS})
    return verify(env, symmetry, states=4, steps=2, memory=memory, **kwargs)


def one_sided(env):
    return term_major(env) * [1, 1, 1, 1, 1, 1, 1, 1.1]


def rate(env):
    return -float(np.square(env.last - env.last2).sum())


RIGHT = {
    "last two actions": ((last_two,), ARMS * 4, LAST),
    "history": ((term_major,), ARMS * 4, FRAMES),
    "reward of the action's rate": ((joints, rate), ARMS, LAST),
    "a count": ((lambda env: np.array([env.count / 10]),), scalar(GROUP), {"count": scalar(GROUP)}),
}


@pytest.mark.parametrize("wrap", [lambda env: env, GymWrapper], ids=["itself", "GymWrapper"])
@pytest.mark.parametrize(("functions", "observation", "memory"), RIGHT.values(), ids=RIGHT)
def test_a_symmetric_task_passes_with_its_memory_and_is_not_tested_without(
    make, functions, observation, memory, wrap
):
    report = report_of(wrap(make(*functions)), observation, memory)
    assert report.passed and report.tested, str(report)
    assert str(report).startswith("symmetric: 4 states")

    report = report_of(wrap(make(*functions)), observation)
    assert not report.passed and not report.tested
    assert report.worst.element == "identity" and not report.worst.passed
    first, _, table = str(report).partition("\n")
    assert first.startswith("not tested: the environment remembers something that its state does not hold")
    assert "nothing below says anything of the symmetry" in first and "memory=" in first
    assert "not symmetric" not in str(report) and "identity" in table


def keep_one_sided(env, action):
    env.last = action * [1.0, 0.5]


WRONG = {
    "history declared in another order": (
        (term_major,),
        ARMS + scalar(GROUP) * 4 + ARMS,
        FRAMES,
        "kinematics",
    ),
    "one entry of a history": ((one_sided,), ARMS * 4, FRAMES, "kinematics"),
    "memory declared to stay": ((last_two,), ARMS * 4, {**LAST, "last2": scalar(GROUP) * 2}, "kinematics"),
    "a reward of one side's last action": ((joints, lambda env: float(env.last2[0])), ARMS, LAST, "reward"),
    "memory that one side feeds": (
        (joints, lambda env: 0.0, keep_one_sided),
        ARMS,
        LAST,
        "next observation",
    ),
}


@pytest.mark.parametrize(("functions", "observation", "memory", "part"), WRONG.values(), ids=WRONG)
def test_a_wrong_declaration_fails_and_says_where(make, functions, observation, memory, part):
    report = report_of(make(*functions), observation, memory)
    assert report.tested and not report.passed
    assert (report.worst.part, report.worst.element) == (part, "reflect-y")
    assert str(report).startswith(f"not symmetric, first in {part}: ")


def test_memory_after_a_step_is_named(make):
    report = report_of(make(joints, lambda env: 0.0, keep_one_sided), ARMS, LAST)
    assert report.worst.where.startswith("memory last[")


def test_forgotten_memory_leaves_it_untested(make):
    report = report_of(make(last_two), ARMS * 4, {"last": ACTIONS})  # and not last2
    assert not report.tested
    assert report.worst.where.endswith("(wrong: 6-7)")


def test_the_assertion_says_not_tested(make):
    symmetry = Symmetry(GROUP, {"observation": ARMS * 4, "action": ACTIONS})
    with pytest.raises(AssertionError, match=r"not tested, .* 'identity': kinematics"):
        assert_env_symmetric(make(last_two), symmetry, states=2)
    assert_env_symmetric(make(last_two), symmetry, states=2, memory=LAST)


class LastAction(control.Task):
    """A task of dm_control that observes its last action."""

    last = np.zeros(2)

    def initialize_episode(self, physics):
        self.last = np.zeros(2)
        physics.data.qpos[:] = np.random.default_rng(0).uniform(-1, 1, 2)

    def before_step(self, action, physics):
        self.last = np.array(action)
        physics.set_control(action)

    def after_step(self, physics):
        pass

    def action_spec(self, physics):
        return dm_mujoco.action_spec(physics)

    def get_observation(self, physics):
        return {"qpos": physics.data.qpos.copy(), "last": self.last}

    def get_reward(self, physics):
        return 0.0


@pytest.mark.parametrize("wrap", [lambda env: env, DMControlWrapper], ids=["itself", "DMControlWrapper"])
def test_attributes_of_a_dm_control_task(wrap):
    env = wrap(control.Environment(dm_mujoco.Physics.from_xml_string(XML), LastAction(), n_sub_steps=2))
    symmetry = Symmetry(GROUP, {"qpos": ARMS, "last": ACTIONS, "action": ACTIONS})

    def parts(memory):
        return {row.part for row in verify(env, symmetry, states=3, memory=memory).rows if not row.passed}

    # it starts at one and the same pose, which is not symmetric
    assert parts({"task.last": ACTIONS}) == {"reset"}
    assert "kinematics" in parts(None)


@pytest.mark.parametrize(
    "value",
    [
        np.array([1, 2]),
        np.array([1.0, 2.0], dtype=np.float32),
        torch.tensor([1.0, 2.0]),
        torch.tensor([True, False]),
        np.array([[1.0], [2.0]]),
    ],
    ids=str,
)
def test_images_come_in_the_form_of_their_values(value):
    memory = Remembered({"x": ARMS})
    env = type("Env", (), {"x": value})()
    memory.write(env, memory.image(memory.read(env), 1))
    assert type(env.x) is type(value) and env.x.dtype == value.dtype and env.x.shape == value.shape
    assert env.x.reshape(-1).tolist() == value.reshape(-1).tolist()[::-1]
    assert env.x is not value


def test_numbers_stay_numbers():
    memory, env = Remembered({"n": scalar(GROUP)}), type("Env", (), {"n": 3})()
    memory.write(env, memory.image(memory.read(env), 1))
    assert env.n == 3 and type(env.n) is int


def test_what_was_read_does_not_change_with_the_environment():
    memory, env = Remembered({"x": ARMS}), type("Env", (), {"x": np.zeros(2)})()
    values = memory.read(env)
    memory.write(env, values)
    env.x[:] = 1.0
    assert values["x"].tolist() == [0.0, 0.0]


def test_errors_say_what_to_do(make):
    env = make(last_two)
    with pytest.raises(KeyError, match=r"expected attributes .*'lost'"):
        report_of(env, ARMS * 4, {"lost": ACTIONS})
    with pytest.raises(
        TypeError, match=r"'frames': expected an array, a tensor or a number, got .*; give Remembered\("
    ):
        report_of(env, ARMS * 4, {"frames": ARMS * 2})
    with pytest.raises(
        ValueError, match="'last': the environment remembers 2 entries, its representation has 4"
    ):
        report_of(env, ARMS * 4, {"last": ARMS * 2})
    with pytest.raises(ValueError, match=r"'last': expected a representation of .*reflect-y"):
        report_of(env, ARMS * 4, {"last": scalar(PointGroup.reflection("x"))})
    with pytest.raises(TypeError, match="'last': expected Representation, got 'same'"):
        report_of(env, ARMS * 4, {"last": "same"})
    with pytest.raises(TypeError, match="memory: expected a mapping of names to representations"):
        report_of(env, ARMS * 4, ["last"])
    with pytest.raises(ValueError, match="got none; leave it out"):
        report_of(env, ARMS * 4, {})
    with pytest.raises(TypeError, match="expected save and load, or neither"):
        Remembered(LAST, save=lambda env: {})
    with pytest.raises(KeyError, match=r"save: expected values for \['last', 'last2'\], got \['last'\]"):
        report_of(env, ARMS * 4, Remembered(LAST, lambda env: {"last": env.last}, lambda env, values: None))


def test_our_tasks_remember_in_their_state():
    tasks = pytest.importorskip("tasks", reason="our tasks need MuJoCo 3.17", exc_type=ImportError)
    batched = tasks.make_env("cartpole", num_envs=2, num_threads=1)
    with pytest.raises(ValueError, match=r"got None, \(\) and \['last'\]; leave them out, and keep"):
        verify(batched, batched.symmetry, memory={"last": batched.symmetry["action"]})
