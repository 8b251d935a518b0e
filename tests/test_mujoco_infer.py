"""infer: the observation's representation from the simulator; what cannot be known is refused by name."""

import numpy as np
import pytest
import torch
from dm_control import suite

import tasks
from torchrl_sym import PointGroup, Symmetry
from torchrl_sym.mujoco import InferenceError, derive, infer, verify
from torchrl_sym.representations import (
    Representation,
    axial,
    invariant,
    items,
    permutation,
    polar,
    pseudoscalar,
    quaternion,
    scalar,
    signed_permutation,
)

gymnasium = pytest.importorskip("gymnasium")
pytest.importorskip("imageio")  # gymnasium's MuJoCo environments import it
from gymnasium import spaces  # noqa: E402
from gymnasium.envs.mujoco import MujocoEnv  # noqa: E402
from gymnasium.wrappers import (  # noqa: E402
    FrameStackObservation,
    NormalizeObservation,
    RescaleAction,
)
from torchrl.envs import GymWrapper  # noqa: E402
from torchrl.envs.libs.dm_control import DMControlWrapper  # noqa: E402

MIRROR = PointGroup.reflection("y")
TURN = PointGroup.rotation(3)

# A ball with two arms, left and right, over a floor that it may touch with all of them.
ROBOT = """<mujoco><option timestep=".01"/><worldbody><geom type="plane" size="5 5 1"/>
  <body name="torso" pos="0 0 .4"><freejoint name="root"/><geom size=".1"/>
    <body pos="0 .1 0"><joint name="left" axis="1 0 0" range="-1 1" limited="true" damping=".1"/>
      <geom type="capsule" size=".03" fromto="0 0 0 .1 .2 0"/></body>
    <body pos="0 -.1 0"><joint name="right" axis="1 0 0" range="-1 1" limited="true" damping=".1"/>
      <geom type="capsule" size=".03" fromto="0 0 0 .1 -.2 0"/></body>
  </body></worldbody>
  <actuator><motor joint="left" ctrlrange="-1 1"/><motor joint="right" ctrlrange="-1 1"/></actuator>
  </mujoco>"""

# Three fingers about the vertical axis, and a free ball among them.
FINGERS = "".join(
    f'<body euler="0 0 {120 * i}"><body pos=".3 0 .2"><joint name="f{i}" axis="0 1 0" range="-1 1" '
    f'limited="true" damping=".1"/><geom type="capsule" size=".02" fromto="0 0 0 0 0 -.15"/></body></body>'
    for i in range(3)
)
HAND = f"""<mujoco><option timestep=".01"/><worldbody><geom type="plane" size="5 5 1"/>{FINGERS}
  <body name="ball" pos="0 0 .1"><freejoint name="ball"/><geom size=".05"/></body></worldbody><actuator>
  {"".join(f'<motor joint="f{i}" ctrlrange="-1 1"/>' for i in range(3))}</actuator></mujoco>"""


class Env(MujocoEnv):
    """A model, observed by a function; its last two actions and a command are remembered."""

    def __init__(self, path, observe, act=lambda env, action: action, size=None):
        self.observe_, self.act = observe, act
        self.metadata = {"render_modes": ["human", "rgb_array", "depth_array", "rgbd_tuple"]}
        self.last, self.last2, self.command = np.zeros(2), np.zeros(2), np.zeros(2)
        super().__init__(str(path), 2, observation_space=None)
        if size is not None:
            self.action_space = spaces.Box(-1.0, 1.0, (size,), np.float64)
        observation = self._get_obs()
        self.observation_space = (
            spaces.Dict({k: spaces.Box(-np.inf, np.inf, np.shape(v)) for k, v in observation.items()})
            if isinstance(observation, dict)
            else spaces.Box(-np.inf, np.inf, observation.shape, np.float64)
        )

    def step(self, action):
        self.last2, self.last = self.last, np.array(action)
        self.do_simulation(self.act(self, np.array(action)), self.frame_skip)
        return self._get_obs(), 0.0, False, False, {}

    def _get_obs(self):
        return self.observe_(self)

    def reset_model(self):
        self.last, self.last2 = np.zeros(2), np.zeros(2)
        self.command = self.np_random.uniform(-1, 1, 2)
        noise = self.np_random.uniform(-0.1, 0.1, self.model.nq)
        self.set_state(self.init_qpos + noise, self.np_random.uniform(-1, 1, self.model.nv))
        return self._get_obs()


@pytest.fixture
def make(tmp_path):
    def make(observe, xml=ROBOT, **kwargs):
        path = tmp_path / "robot.xml"
        path.write_text(xml)
        return Env(path, observe, **kwargs)

    return make


ARMS = signed_permutation(MIRROR, ["l", "r"], {"reflect-y": {"l": "-r", "r": "-l"}})
FREE = polar(MIRROR) + quaternion(MIRROR, "conjugate")


def state(env):
    return np.concatenate([env.data.qpos, env.data.qvel])


def same(one: Representation, other: Representation) -> bool:
    return one.event_shape == other.event_shape and torch.allclose(
        one.matrices, other.matrices, rtol=0, atol=1e-9
    )


RIGHT = {
    "state": (state, FREE + ARMS + polar(MIRROR) + axial(MIRROR) + ARMS),
    "last two actions": (
        lambda env: np.concatenate([env.data.qpos, env.last, env.last2]),
        FREE + ARMS * 3,
    ),
    "a scale that both sides have": (lambda env: 0.3 * env.data.qpos, FREE + ARMS),
    "a constant beside": (
        lambda env: np.append(env.data.qvel[:6], 2.0),
        polar(MIRROR) + axial(MIRROR) + scalar(MIRROR),
    ),
    "entries that are there twice": (
        lambda env: env.data.qpos[[7, 8, 7, 8, 2]],
        ARMS * 2 + scalar(MIRROR),
    ),
    "forces of contact": (
        lambda env: np.clip(env.data.cfrc_ext[1:], -1, 1).ravel(),
        items(
            permutation(MIRROR, ["t", "l", "r"], {"reflect-y": {"t": "t", "l": "r", "r": "l"}}),
            axial(MIRROR) + polar(MIRROR),
        ).flatten(),
    ),
    "single precision": (
        lambda env: state(env).astype(np.float32),
        FREE + ARMS + polar(MIRROR) + axial(MIRROR) + ARMS,
    ),
}


@pytest.mark.parametrize(("observe", "expected"), RIGHT.values(), ids=RIGHT)
def test_a_mirror_is_found(make, observe, expected):
    env = make(observe)
    symmetry = infer(env, MIRROR)
    assert same(symmetry["observation"], expected)
    assert same(symmetry["action"], ARMS)
    if observe is not RIGHT["last two actions"][0]:  # which verify needs to be told of
        report = verify(env, symmetry, states=3, steps=2)
        assert report.passed, str(report)
    symmetry.check_specs(GymWrapper(env))


def test_turns_that_mix_are_found(make):
    env = make(state, HAND)
    symmetry = infer(env, TURN)
    robot = derive(env.model, TURN)
    fingers = robot.joints(["f0", "f1", "f2"])
    ball = polar(TURN) + quaternion(TURN, "conjugate")
    assert not symmetry["observation"].is_signed_permutation
    expected = fingers + ball + fingers + polar(TURN) + axial(TURN)
    assert same(symmetry["observation"], expected)
    assert same(symmetry["action"], robot.actuators)
    assert verify(env, symmetry, states=2, steps=2).passed


def test_goals_frames_and_keys_that_change_places(make):
    def observe(env):
        left, right = env.data.geom_xpos[2:4] - env.data.xpos[1]
        goal = {"achieved": env.data.qpos[:3].copy(), "frame": env.data.xmat[1].reshape(3, 3).copy()}
        return {"left_arm": left, "right_arm": right, "goal": goal}

    env = make(observe)
    symmetry = infer(env, MIRROR)
    assert set(symmetry.keys()) == {
        "left_arm",
        "right_arm",
        ("goal", "achieved"),
        ("goal", "frame"),
        "action",
    }
    assert symmetry.together(["left_arm"]) == ["left_arm", "right_arm"]
    assert symmetry["goal", "frame"].event_shape == (3, 3)
    assert verify(env, symmetry, states=2, steps=2).passed


def test_sides_that_are_images_of_themselves_too(make):
    def observe(env):  # the shoulders are opposite, so that each is minus the other
        return dict(zip(("left", "right"), env.data.xpos[2:4] - env.data.xpos[1], strict=True))

    env = make(observe)
    symmetry = infer(env, MIRROR)
    assert symmetry.together(["left"]) == ["left", "right"]
    assert verify(env, symmetry, states=2, steps=2).passed


ACTIONS = {
    "rescaled": (lambda env, a: 0.5 * a, 2, ARMS),
    "one for both arms": (lambda env, a: np.array([a[0], -a[0]]), 1, scalar(MIRROR)),
    "sum and difference": (
        lambda env, a: np.array([a[0] + a[1], a[0] - a[1]]) / 2,
        2,
        signed_permutation(MIRROR, ["s", "d"], {"reflect-y": {"s": "-s", "d": "d"}}),
    ),
    "one that does nothing": (lambda env, a: a[:2], 3, ARMS + scalar(MIRROR)),
    "smoothed": (lambda env, a: 0.5 * (a + env.last2), 2, ARMS),
}


@pytest.mark.parametrize(("act", "size", "expected"), ACTIONS.values(), ids=ACTIONS)
def test_actions_are_found_by_what_they_do(make, act, size, expected):
    symmetry = infer(make(state, act=act, size=size), MIRROR)
    assert same(symmetry["action"], expected)
    assert any("moves nothing" in note for note in symmetry.notes) == (size == 3)


def test_wrappers_that_remember(make):
    env = FrameStackObservation(RescaleAction(make(state), -2.0, 2.0), 3)
    frame = FREE + ARMS + polar(MIRROR) + axial(MIRROR) + ARMS
    symmetry = infer(env, MIRROR)
    assert same(symmetry["observation"], (frame * 3).unflatten((3, 17)))
    with pytest.raises(ValueError, match="go through FrameStackObservation, which remembers: take what is"):
        verify(env, symmetry, states=1)


WRONG = {
    "offset": (
        lambda env: env.data.qpos + 0.3 * (np.arange(9) == 8),
        r"\[7\] .*plus -?0\.3; observe it rel",
    ),
    "scale": (
        lambda env: env.data.qpos * (1 + 0.1 * (np.arange(9) == 8)),
        r"1\.1 times .*scale both alike",
    ),
    "absent partner": (
        lambda env: env.data.qpos[:8],
        r"observation\[7\] \(left\) under reflect-y: no entry",
    ),
    "a square": (lambda env: np.append(env.data.qpos[[7, 8]], env.data.qpos[7] ** 2), r"observation\[2\]"),
    "there more often": (lambda env: env.data.qpos[[7, 7, 8]], "2 times, what becomes it once"),
    "a command": (lambda env: np.append(env.data.qpos, env.command), "one state is observed in two ways"),
    "noise": (lambda env: env.data.qpos + 1e-2 * np.random.randn(9), "one state is observed in two ways"),
    "text": (lambda env: {"a": env.data.qpos, "b": np.zeros((8, 8, 3), np.uint8)}, "got an image"),
}


@pytest.mark.parametrize(("observe", "message"), WRONG.values(), ids=WRONG)
def test_entries_without_image_are_named(make, observe, message):
    with pytest.raises(InferenceError, match=message):
        infer(make(observe), MIRROR)


def test_errors_carry_what_was_found(make):
    def observe(env):
        return {"good": env.data.qpos[7:].copy(), "bad": env.data.qpos[7:] + np.array([0, 0.3])}

    with pytest.raises(InferenceError) as error:
        infer(make(observe), MIRROR)
    assert same(error.value.partial["good"], ARMS)
    assert {(entry.key, entry.index) for entry in error.value.entries} == {("bad", 0), ("bad", 1)}
    assert error.value.entries[0].label == "left" and "memory" not in str(error.value.entries[0])


def test_commands_are_handed_over(make):
    env = make(lambda env: np.append(env.data.qpos, env.command))
    memory = {"command": pseudoscalar(MIRROR) * 2}
    symmetry = infer(env, MIRROR, memory=memory)
    assert same(symmetry["observation"], FREE + ARMS + pseudoscalar(MIRROR) * 2)
    assert verify(env, symmetry, states=2, steps=2, memory=memory).passed


def test_a_normaliser_is_refused_and_an_action_with_an_offset(make):
    with pytest.raises(InferenceError, match="one state is observed in two ways"):
        infer(NormalizeObservation(make(state)), MIRROR)
    with pytest.raises(
        InferenceError, match=r"'action': under 'reflect-y', .* has an offset, a limit or a"
    ):
        infer(make(state, act=lambda env, a: a + np.array([0.3, 0.0])), MIRROR)
    with pytest.raises(InferenceError, match="'action' does not transform orthogonally"):
        infer(make(state, act=lambda env, a: a * np.array([1.0, 0.5])), MIRROR)
    with pytest.raises(InferenceError, match="no action makes a difference"):
        infer(make(state, act=lambda env, a: 0 * a), MIRROR)


def test_a_group_that_does_nothing_is_refused_and_not_tested(make):
    env = suite.load("cheetah", "run", task_kwargs={"random": 0})
    with pytest.raises(InferenceError, match=r"reflect-y changes no entry .* take a group without it"):
        infer(env, MIRROR)
    still = {key: invariant(MIRROR, n) for key, n in (("position", 8), ("velocity", 9), ("action", 6))}
    report = verify(env, Symmetry(MIRROR, still), states=2, steps=2)
    assert not report.tested and not report.passed
    assert "not tested: reflect-y moves no entry of the observation or the action" in str(report)


def test_an_action_without_effect_is_not_tested(make):
    env = make(state, act=lambda env, a: 0 * a)
    expected = RIGHT["state"][1]
    report = verify(env, Symmetry(MIRROR, {"observation": expected, "action": ARMS}), states=2, steps=2)
    assert not report.passed and "no action makes a difference" in report.verdict


def test_contact_is_searched_for(make):
    xml = ROBOT.replace('pos="0 0 .4"', 'pos="0 0 40"')
    env = make(state, xml)
    report = verify(env, Symmetry(MIRROR, {"observation": RIGHT["state"][1], "action": ARMS}), states=2)
    assert report.contacts > 0 and report.passed, str(report)


SUITE = {
    "cartpole swingup": {"position": "-+-", "velocity": "--", "action": "-"},
    "acrobot swingup": {"orientations": "--++", "velocity": "--", "action": "-"},
    "ball_in_cup catch": {"position": "-+-+", "velocity": "-+-+", "action": "-+"},
    "pendulum swingup": {"orientation": "+-", "velocity": "-", "action": "-"},
}


@pytest.mark.parametrize("name", SUITE)
def test_dm_control_suite(name):
    group = PointGroup.reflection("x")
    env = suite.load(*name.split(), task_kwargs={"random": 0})
    symmetry = infer(DMControlWrapper(env), group)
    for key, text in SUITE[name].items():
        signs = torch.tensor([1.0 if s == "+" else -1.0 for s in text], dtype=torch.float64)
        assert torch.equal(symmetry[key].matrices[1], torch.diag(signs))


def test_our_tasks_as_declared():
    env = tasks.make_env("cartpole", num_envs=8, num_threads=1, seed=0)
    symmetry = infer(env, env.symmetry.group)
    assert all(same(symmetry[key], env.symmetry[key]) for key in (*symmetry.keys(),))


def test_code_and_table_say_the_same(make):
    def observe(env):
        return {"state": state(env), "forces": np.clip(env.data.cfrc_ext, -1, 1).ravel()}

    symmetry = infer(make(observe), MIRROR)
    for written in (
        symmetry.code(),
        Symmetry(MIRROR, {k: symmetry[k] for k in list(symmetry.keys())}).code(),
    ):
        names: dict = {}
        exec(written, names)
        for key in list(symmetry.keys()):
            assert same(names["symmetry"][key], symmetry[key])
    assert '"left": "-right"' in symmetry.code()
    text = str(symmetry)
    assert "never changed" not in text and "left velocity" in text
    assert (
        len([line for line in text.splitlines() if line.startswith("  ")]) == 17 + 24 + 2 + 3
    )  # and three headings
