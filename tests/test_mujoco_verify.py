"""verify: right symmetries pass on three kinds of environment; every wrong one is found, and where."""

import mujoco
import numpy as np
import pytest
import torch
from dm_control import suite
from torchrl.envs import RewardSum, TransformedEnv

import tasks
from tasks.cartpole import CartPole
from tasks.environment import BatchedEnv
from tasks.state import State
from torchrl_sym import PointGroup, Representation, Symmetry
from torchrl_sym.mujoco import derive, verify
from torchrl_sym.mujoco.verify import PARTS
from torchrl_sym.representations import axial, polar, pseudoscalar, quaternion, scalar, signed_permutation
from torchrl_sym.testing import assert_env_symmetric

MIRROR = PointGroup.reflection("x")


def signs(text: str) -> Representation:
    """One sign per entry: ``signs("+-")``."""
    total = None
    for sign in text:
        one = pseudoscalar(MIRROR) if sign == "-" else scalar(MIRROR)
        total = one if total is None else total + one
    assert total is not None
    return total


def symmetry(**texts: str) -> Symmetry:
    return Symmetry(MIRROR, {key: signs(text) for key, text in texts.items()})


def cartpole(task_class: type[CartPole] = CartPole) -> BatchedEnv:
    return BatchedEnv(task_class(), num_envs=16, num_threads=1)


SUITE = {
    "cartpole swingup": symmetry(position="-+-", velocity="--", action="-"),
    "acrobot swingup": symmetry(orientations="--++", velocity="--", action="-"),
    "ball_in_cup catch": symmetry(position="-+-+", velocity="-+-+", action="-+"),
    "pendulum swingup": symmetry(orientation="+-", velocity="-", action="-"),
}


def load(name: str):
    return suite.load(*name.split(), task_kwargs={"random": 0})


def test_our_cartpole_is_exactly_symmetric():
    env = cartpole()
    report = verify(env, env.symmetry)
    assert report.passed, str(report)
    states = [row for part in ("dynamics", "contact", "rollout") for row in report.of(part)]
    assert {row.element for row in states} == set(MIRROR.names)
    assert all(row.value == 0 for row in states)
    assert {row.part for row in report.rows} == set(PARTS)


def test_our_cartpole_in_dm_control():
    report = verify(tasks.load("cartpole", random=0), cartpole().symmetry)
    assert report.passed, str(report)


@pytest.mark.parametrize("name", SUITE)
def test_dm_control_suite_is_symmetric(name):
    report = verify(load(name), SUITE[name])
    assert report.passed, str(report)
    assert all(row.value < 1e-12 for part in ("dynamics", "contact") for row in report.of(part))


def test_states_alone_of_a_humanoid_in_contact():
    env = load("humanoid stand")
    group = PointGroup.reflection("y")
    actuators = derive(env.physics.model.ptr, group).actuators
    report = verify(env, Symmetry(group, {"action": actuators}, strict=False), states=8)
    assert report.passed, str(report)
    assert report.contacts > 0
    assert not report.of("kinematics")
    assert all(row.value < 1e-9 for part in ("dynamics", "contact") for row in report.of(part))


def test_target_kept_outside_the_state_shows_in_the_reward():
    env = load("reacher easy")  # it moves a geom of the model
    group = PointGroup.reflection("y")
    actuators = derive(env.physics.model.ptr, group).actuators
    report = verify(env, Symmetry(group, {"action": actuators}, strict=False))
    assert {row.part for row in report.rows if not row.passed} == {"reward"}


@pytest.fixture
def make_ant():
    gymnasium = pytest.importorskip("gymnasium")
    pytest.importorskip("imageio")  # gymnasium's MuJoCo environments import it
    return lambda: gymnasium.make("Ant-v5")


def ant_symmetry(env, axis: str) -> Symmetry:
    """Height, orientation, joints; velocities; torque and force of contact on each body but the world."""
    group = PointGroup.reflection(axis)
    robot = derive(env.unwrapped.model, group)
    joints = robot.joints([f"{kind}_{leg}" for leg in range(1, 5) for kind in ("hip", "ankle")])
    legs = robot.table("joint", f"reflect-{axis}")
    pairs = {f"{leg}{part}": f"{legs[f'ankle_{leg}'][-1]}{part}" for leg in range(1, 5) for part in "ABC"}
    bodies = signed_permutation(group, ["torso", *pairs], {f"reflect-{axis}": {"torso": "torso", **pairs}})
    wrench = axial(group) + polar(group)
    contact = Representation(
        group,
        torch.stack([torch.kron(*pair) for pair in zip(bodies.matrices, wrench.matrices, strict=True)]),
    )
    position = scalar(group) + quaternion(group, "conjugate") + joints
    observation = position + polar(group) + axial(group) + joints + contact
    return Symmetry(group, {"observation": observation, "action": robot.actuators})


def test_gymnasium_ant_in_contact(make_ant):
    env = make_ant()
    report = verify(env, ant_symmetry(env, "y"), states=32)
    assert report.passed, str(report)
    assert report.contacts > 0
    for part in ("kinematics", "dynamics", "contact", "next observation"):
        assert all(row.value < 1e-9 for row in report.of(part)), str(report)


def test_ant_is_rewarded_for_going_forward_only(make_ant):
    env = make_ant()
    report = verify(env, ant_symmetry(env, "x"))
    assert {(row.part, row.element) for row in report.rows if not row.passed} == {("reward", "reflect-x")}
    assert report.worst.part == "reward"
    assert "first in reward" in str(report)
    assert "FAILED" in str(report)


def test_asymmetric_scales_in_a_wrapper_are_found(make_ant):
    from gymnasium.wrappers import TransformObservation

    env = make_ant()
    scales = np.ones(105)
    scales[[6, 7]] = 1.1  # ankle 1, hip 2
    report = verify(TransformObservation(env, lambda x: scales * x, None), ant_symmetry(env, "y"), states=4)
    worst = report.worst
    assert (worst.part, worst.element) == ("kinematics", "reflect-y")
    # their own entries and those of their images: hip 3 and ankle 4
    assert worst.where.startswith("observation[")
    assert worst.where.endswith("(wrong: 6-7, 9, 12)")


def test_slippery_foot_is_contact(make_ant):
    env = make_ant()
    model = env.unwrapped.model
    model.geom_friction[model.geom("left_ankle_geom").id, 0] = 3.0
    report = verify(env, ant_symmetry(env, "y"), states=32)
    assert (report.worst.part, report.worst.element) == ("contact", "reflect-y")
    assert all(row.passed for row in report.of("dynamics"))


def test_heavy_leg_is_dynamics(make_ant):
    env = make_ant()
    env.unwrapped.model.body_mass[4] *= 1.01
    report = verify(env, ant_symmetry(env, "y"), states=2)
    assert (report.worst.part, report.worst.element) == ("dynamics", "reflect-y")
    assert report.worst.where.startswith("joint ")


def test_wrong_action_sign_is_dynamics():
    report = verify(load("cartpole swingup"), symmetry(position="-+-", velocity="--", action="+"))
    assert (report.worst.part, report.worst.element) == ("dynamics", "reflect-x")
    assert report.worst.where.startswith("joint ")
    assert all(row.passed for row in report.of("kinematics"))


@pytest.mark.parametrize(("entry", "texts"), [(0, "+--"), (1, "-+-"), (2, "--+")])
def test_flipped_sign_of_an_observation_is_named(entry, texts):
    report = verify(cartpole(), symmetry(observation=texts, action="-"))
    worst = report.worst
    assert (worst.part, worst.element, worst.where) == (
        "kinematics", "reflect-x", f"observation[{entry}]"
    )  # fmt: skip
    assert all(row.passed for part in ("dynamics", "contact", "reward") for row in report.of(part))


def test_flipped_sign_in_one_key_of_several():
    report = verify(load("pendulum swingup"), symmetry(orientation="++", velocity="-", action="-"))
    assert (report.worst.part, report.worst.where) == ("kinematics", "orientation[1]")


class OneSidedReward(CartPole):
    def reward(self, state, action):
        return super().reward(state, action) + 0.01 * state.qvel[:, 0]


class OneSidedStart(CartPole):
    def sample_initial_state(self, n, generator):
        return self.sample_goal_state(n, generator)


class OneSidedEnd(CartPole):
    def terminated(self, state):
        return state.qpos[:, 0] > 0.05


class AsymmetricMotor(CartPole):
    def control(self, action, state):
        return super().control(action, state) + 0.1


@pytest.mark.parametrize(
    ("task_class", "parts"),
    [
        (OneSidedReward, ["reward"]),
        (OneSidedStart, ["reset"]),
        (OneSidedEnd, ["termination"]),
        (AsymmetricMotor, ["dynamics", "contact", "reward", "next observation"]),
    ],
)
def test_one_sided_tasks_are_found(task_class, parts):
    env = cartpole(task_class)
    report = verify(env, env.symmetry)
    failed = {row.part for row in report.rows if not row.passed}
    assert failed == set(parts)
    assert report.worst.part == parts[0]
    assert report.worst.element == "reflect-x"
    if parts == ["reset"]:
        assert report.worst.where == "observation[1]"  # the pole's angle


def test_asymmetric_normaliser_is_found():
    env = cartpole()
    mean = torch.tensor([0.0, 0.3, 0.0])

    def normalize(batch):
        return batch.set("observation", batch["observation"] - mean)

    report = verify(env, env.symmetry, observe=normalize)
    assert (report.worst.part, report.worst.where) == ("kinematics", "observation[1]")
    assert 0.3 < report.worst.value <= 0.6 + 1e-6  # twice the mean, relative to the largest value or 1


def test_asymmetric_action_box_is_found():
    env = load("ball_in_cup catch")
    spec = env.action_spec()
    env.action_spec = lambda: spec.replace(minimum=np.array([-0.5, -1.0]))
    report = verify(env, SUITE["ball_in_cup catch"], states=2)
    assert (report.worst.part, report.worst.where) == ("action box", "action[0]")


def test_hidden_state_fails_the_identity():
    class Hidden(CartPole):
        steps = 0

        def control(self, action, state):
            self.steps += 1
            return super().control(action, state) * (1 + 0.01 * self.steps)

    env = cartpole(Hidden)
    report = verify(env, env.symmetry, states=1)
    assert any(row.element == "identity" and not row.passed for row in report.of("contact"))


def test_quaternions_count_up_to_sign():
    """A task may return -q for q: the same orientation."""

    class Tumbling(CartPole):
        sign = 1.0

        def __init__(self):
            super().__init__()
            self.model = mujoco.MjModel.from_xml_string("""<mujoco>
              <option timestep="0.01"/><worldbody><body pos="0 0 1"><freejoint name="root"/>
              <geom size=".1 .2 .3" type="box"/></body></worldbody></mujoco>""")
            group = self.symmetry.group
            self.position = polar(group) + quaternion(group, "conjugate")
            self.velocity = polar(group) + axial(group)
            self.symmetry = Symmetry(group, {"observation": polar(group), "action": signs("-")})

        def sample_goal_state(self, n, generator):
            qpos = torch.randn(n, 7, generator=generator, dtype=torch.float64)
            qpos[:, 3:] /= qpos[:, 3:].norm(dim=1, keepdim=True)
            return State(qpos, torch.randn(n, 6, generator=generator, dtype=torch.float64))

        def control(self, action, state):
            return torch.zeros(len(state), 0, dtype=torch.float64)

        def observe(self, state):
            return state.qpos[:, :3].clone()

        def reward(self, state, action):
            return state.qpos[:, 2].clone()

        def transform_state(self, state, g):
            self.sign = -self.sign  # another choice each time
            sign = torch.tensor([1.0] * 3 + [self.sign] * 4)
            return State(sign * self.position(state.qpos, g), self.velocity(state.qvel, g), time=state.time)

    env = cartpole(Tumbling)
    report = verify(env, env.symmetry)
    assert report.passed, str(report)


def test_assertion_names_the_worst():
    env = cartpole()
    assert_env_symmetric(env, env.symmetry)
    with pytest.raises(AssertionError, match=r"'reflect-x': kinematics is off by .* at observation\[1\]"):
        assert_env_symmetric(env, symmetry(observation="-+-", action="-"))


def test_errors_say_what_to_do():
    env = tasks.make_env("cartpole", num_envs=2, num_threads=1)
    for wrong in (object(), TransformedEnv(env, RewardSum())):
        with pytest.raises(TypeError, match=r"expected a batched .* got \w+; pass the innermost"):
            verify(wrong, env.symmetry)
    with pytest.raises(KeyError, match=r"verify reads .*'velocity'"):
        verify(load("pendulum swingup"), symmetry(orientation="+-", action="-"))
    with pytest.raises(ValueError, match="'velocity': the environment observes 1 entries"):
        verify(load("pendulum swingup"), symmetry(orientation="+-", velocity="--", action="-"))
    with pytest.raises(ValueError, match="'action': the environment takes 1 entries"):
        verify(env, symmetry(observation="---", action="--"))
    with pytest.raises(ValueError, match="states: expected a whole number from 1"):
        verify(env, env.symmetry, states=0)
    with pytest.raises(KeyError, match="expected one of"):
        verify(env, env.symmetry).of("everything")
