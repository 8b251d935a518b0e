"""Observations that are put together from terms, as Isaac Lab and mjlab do it, and their symmetry."""

from types import SimpleNamespace

import gymnasium
import pytest
import torch
from torchrl.envs.libs.isaac_lab import IsaacLabWrapper

from tests.managers import Manager, cfg
from tests.point_groups import random
from torchrl_sym import Exchanged, PointGroup
from torchrl_sym.bridges import isaac_lab
from torchrl_sym.bridges.terms import observation_manager
from torchrl_sym.representations import (
    axial,
    image,
    invariant,
    items,
    permutation,
    polar,
    pseudoscalar,
    signed_permutation,
)

MIRROR, C3 = PointGroup.reflection("y"), PointGroup.rotation(3)
SWAP = {"left": "-right", "right": "-left", "knee": "knee"}
JOINTS = signed_permutation(MIRROR, list(SWAP), {"reflect-y": SWAP})
FRAME = {  # one frame of every term
    "base_lin_vel": polar(MIRROR),
    "base_ang_vel": axial(MIRROR),
    "joint_pos": JOINTS,
    "camera": image(MIRROR, (1, 2, 4), "CHW"),
    "depth": image(MIRROR, (3, 2, 4), "CHW"),
}
VECTORS = ["base_lin_vel", "base_ang_vel", "joint_pos"]


def env(*args, **kwargs):
    return SimpleNamespace(observation_manager=Manager(*args, **{"frame": FRAME} | kwargs))


def assert_mirrored(environment, symmetry, frame=FRAME):
    """Observations of mirrored frames are the images of the observations."""
    manager, group = environment.observation_manager, symmetry.group
    frames = {name: random(9, 2, *rho.event_shape, seed=i) for i, (name, rho) in enumerate(frame.items())}
    here = manager.compute(frames)
    for g in range(group.order):
        there = manager.compute({name: frame[name](x, g) for name, x in frames.items()})
        for key in set(symmetry.keys()) - {"action"}:
            one, other = (
                obs[key] if isinstance(key, str) else obs[key[0]][key[1]] for obs in (here, there)
            )
            torch.testing.assert_close(symmetry[key](one, g), other, rtol=0, atol=1e-12)


def declared(environment, **more):
    used = {name for terms in observation_manager(environment).groups.values() for name in terms}
    return isaac_lab.symmetry(environment, {name: FRAME[name] for name in used}, JOINTS, **more)


def test_groups_of_terms_with_and_without_history():
    environment = env(
        {
            "policy": {
                name: cfg(history_length=length) for name, length in zip(VECTORS, (3, 0, 5), strict=True)
            },
            "critic": {name: cfg() for name in reversed(VECTORS)},
        }
    )
    symmetry = declared(environment)
    assert symmetry.keys() == ["policy", "critic", "action"]
    assert symmetry["policy"].event_shape == (3 * 3 + 3 + 5 * 3,)
    assert_mirrored(environment, symmetry)


def test_terms_that_are_not_concatenated_have_keys_of_their_own():
    terms = {"joint_pos": cfg(history_length=2), "camera": cfg(), "depth": cfg(history_length=2)}
    environment = env({"policy": terms}, concatenate=False)
    symmetry = declared(environment)
    assert symmetry.keys() == [("policy", "joint_pos"), ("policy", "camera"), ("policy", "depth"), "action"]
    assert_mirrored(environment, symmetry)


def test_a_history_may_be_a_dimension_of_its_own():
    history = cfg(history_length=4, flatten_history_dim=False)
    environment = env({"policy": dict.fromkeys(VECTORS, history)})
    symmetry = declared(environment)
    assert symmetry["policy"].event_shape == (4, 9)
    assert_mirrored(environment, symmetry)


@pytest.mark.parametrize("dim", [0, -3])
def test_images_may_be_concatenated_along_their_channels(dim):
    environment = env({"policy": {"camera": cfg(), "depth": cfg()}}, dim=dim)
    symmetry = declared(environment)
    assert symmetry["policy"].event_shape == (4, 2, 4)
    assert_mirrored(environment, symmetry)


def test_images_with_a_history_may_be_concatenated_along_their_channels():
    history = cfg(history_length=2, flatten_history_dim=False)
    environment = env({"policy": {"camera": history, "depth": history}}, dim=1)
    symmetry = declared(environment)
    assert symmetry["policy"].event_shape == (2, 4, 2, 4)
    assert_mirrored(environment, symmetry)


def test_terms_that_mix_are_put_together():
    frame = {"a": polar(C3), "b": axial(C3) + pseudoscalar(C3)}
    history = cfg(history_length=2, flatten_history_dim=False)
    environment = env({"policy": {"a": history, "b": history}}, frame=frame)
    symmetry = isaac_lab.symmetry(environment, frame, polar(C3))
    assert_mirrored(environment, symmetry, frame)


def test_a_term_may_differ_from_group_to_group():
    groups = {"policy": {"joint_pos": cfg()}, "critic": {"joint_pos": cfg()}}
    environment = env(groups)
    terms = {("critic", "joint_pos"): invariant(MIRROR, 3), "joint_pos": JOINTS}
    symmetry = isaac_lab.symmetry(environment, terms, JOINTS)
    assert symmetry["critic"].is_trivial and not symmetry["policy"].is_trivial


def test_a_wrapped_environment_and_other_entries():
    environment = SimpleNamespace(unwrapped=env({"policy": {"joint_pos": cfg()}}))
    hands = permutation(MIRROR, ["l", "r"], {"reflect-y": {"l": "r", "r": "l"}})
    others = {"pixels": FRAME["camera"], Exchanged("left", "right"): items(hands, polar(MIRROR))}
    symmetry = isaac_lab.symmetry(environment, {"joint_pos": JOINTS}, JOINTS, others=others)
    assert symmetry.keys() == ["policy", "action", "pixels", "left", "right"]


COMMUTING = [
    {"scale": 0.25},
    {"scale": torch.tensor([2.0, 2.0, 5.0])},
    {"clip": (-1.0, 1.0)},
    {"clip": (-1.0, 1.0), "scale": torch.tensor([2.0, 2.0, 5.0])},
    {"modifiers": [SimpleNamespace(func=lambda x, factor: factor * x, params={"factor": 3.0})]},
]
NOT_COMMUTING = [
    ({"scale": torch.tensor([2.0, 3.0, 5.0])}, r"scale \[2.0, 3.0, 5.0\] does not commute"),
    ({"clip": (-1.0, 2.0)}, r"clip \(-1.0, 2.0\) does not commute with 'reflect-y'"),
    ({"clip": (0.0, 100.0)}, "clip"),
    ({"clip": (-5000.0, 3000.0)}, "clip"),
    ({"modifiers": [SimpleNamespace(func=lambda x, bias: x + bias, params={"bias": 0.1})]}, "modifier"),
    ({"modifiers": [SimpleNamespace(func=SimpleNamespace(), params={})]}, "which remembers"),
]


@pytest.mark.parametrize("settings", COMMUTING)
def test_what_is_done_to_a_term_may_commute(settings):
    environment = env({"policy": {"joint_pos": cfg(**settings)}})
    symmetry = declared(environment)
    assert_mirrored(environment, symmetry)


@pytest.mark.parametrize(("settings", "message"), NOT_COMMUTING)
def test_what_is_done_to_a_term_and_does_not_commute_is_refused(settings, message):
    with pytest.raises(ValueError, match=f"'policy/joint_pos'.*{message}"):
        declared(env({"policy": {"joint_pos": cfg(**settings)}}))


def test_a_clip_of_components_that_mix_is_refused():
    environment = env({"policy": {"a": cfg(clip=(-1.0, 1.0))}}, frame={"a": polar(C3)})
    with pytest.raises(ValueError, match=r"clip.*'rot-120'"):
        isaac_lab.symmetry(environment, {"a": polar(C3)}, polar(C3))


def test_every_term_that_is_not_declared_is_named():
    groups = {"policy": dict.fromkeys(VECTORS, cfg(history_length=2)), "critic": {"camera": cfg()}}
    with pytest.raises(KeyError, match="none for") as error:
        isaac_lab.symmetry(env(groups), {"base_ang_vel": axial(MIRROR)}, JOINTS)
    for label in ("'policy/base_lin_vel': (3,)", "'policy/joint_pos': (3,)", "'critic/camera': (1, 2, 4)"):
        assert label in str(error.value)
    assert "base_ang_vel" not in str(error.value)


@pytest.mark.parametrize("name", ["joint_positions", ("critic", "joint_pos"), 3])
def test_a_term_that_is_none_is_refused(name):
    terms = {"joint_pos": JOINTS, name: JOINTS}
    with pytest.raises(KeyError, match=r"expected names of terms.*'policy/joint_pos'"):
        isaac_lab.symmetry(env({"policy": {"joint_pos": cfg()}}), terms, JOINTS)


@pytest.mark.parametrize("history", [0, 3])
@pytest.mark.parametrize("flatten", [True, False])
def test_a_term_of_another_size_is_refused(history, flatten):
    """Also where the sizes of all frames together are those of one frame of the declared one."""
    settings = cfg(history_length=history, flatten_history_dim=flatten)
    environment = env({"policy": {"joint_pos": settings, "camera": settings}}, concatenate=False)
    for wrong in (invariant(MIRROR, 2), invariant(MIRROR, 9), FRAME["camera"]):
        with pytest.raises(ValueError, match=r"'policy/joint_pos': expected a representation on \(3,\)"):
            isaac_lab.symmetry(environment, {"camera": FRAME["camera"], "joint_pos": wrong}, JOINTS)
    with pytest.raises(ValueError, match=r"'policy/camera': expected a representation on \("):
        isaac_lab.symmetry(environment, {"joint_pos": JOINTS, "camera": JOINTS}, JOINTS)


def test_an_environment_without_terms_is_refused():
    with pytest.raises(TypeError, match="observation_manager"):
        isaac_lab.symmetry(SimpleNamespace(observation_space=None), {}, JOINTS)


def test_terms_of_two_groups_are_refused():
    environment = env({"policy": {"joint_pos": cfg(), "base_lin_vel": cfg()}})
    terms = {"joint_pos": JOINTS, "base_lin_vel": polar(PointGroup.reflection("x"))}
    with pytest.raises(ValueError, match="one group"):
        isaac_lab.symmetry(environment, terms, JOINTS)


class ManagerBasedEnv(gymnasium.Env):
    """What gymnasium, and so TorchRL's wrapper, sees of Isaac Lab's environment."""

    num_envs, device = 4, "cpu"

    def __init__(self, manager):
        self.observation_manager = manager
        self.single_observation_space = self._space(self._observations())
        self.single_action_space = self._space(torch.zeros(1, 3))
        batch = gymnasium.vector.utils.batch_space
        self.observation_space = batch(self.single_observation_space, self.num_envs)
        self.action_space = batch(self.single_action_space, self.num_envs)

    def _space(self, value):
        if isinstance(value, dict):
            return gymnasium.spaces.Dict({name: self._space(each) for name, each in value.items()})
        return gymnasium.spaces.Box(-float("inf"), float("inf"), value.shape[1:])

    def _observations(self):
        frames = {name: torch.randn(9, 4, *rho.event_shape) for name, rho in FRAME.items()}
        return self.observation_manager.compute(frames)

    def reset(self, seed=None, options=None):
        return self._observations(), {}

    def step(self, action):
        no = torch.zeros(self.num_envs, dtype=torch.bool)
        return self._observations(), torch.zeros(self.num_envs), no, no, {}


def test_torchrls_wrapper_gives_the_same_keys():
    groups = {"policy": {name: cfg(history_length=2) for name in VECTORS}, "critic": {"camera": cfg()}}
    manager = Manager(groups, FRAME)
    manager.group_obs_concatenate["critic"] = False
    wrapped = IsaacLabWrapper(ManagerBasedEnv(manager), device="cpu")
    symmetry = declared(wrapped)
    assert symmetry.keys() == ["policy", ("critic", "camera"), "action"]
    symmetry.check_specs(wrapped)
    assert symmetry.orbit(wrapped.rollout(3)).batch_size == (2, 4, 3)
