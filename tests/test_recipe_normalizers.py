"""Normalisation in the recipe, and actors that do not read what only the critic may."""

import dataclasses
import functools
import json

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Composite
from torchrl.envs import TransformedEnv
from torchrl.envs.transforms import Transform

import tasks
from torchrl_sym import PointGroup, Symmetry
from torchrl_sym.normalization import SymmetricNorm
from torchrl_sym.recipes import (
    PPOConfig,
    RunFolder,
    export_actor,
    load_actor,
    make_actor,
    read_metrics,
    train,
)
from torchrl_sym.recipes.networks import gaussian, make_networks
from torchrl_sym.recipes.normalizers import RewardScale, observe
from torchrl_sym.recipes.table import TIMING
from torchrl_sym.representations import polar, pseudoscalar
from torchrl_sym.testing import assert_equivariant

MAKE_ENV = functools.partial(tasks.make_env, "cartpole", num_threads=1)
SYMMETRY = MAKE_ENV(num_envs=1, seed=0).symmetry
TINY = PPOConfig(iterations=4, num_envs=8, horizon=8, epochs=2, minibatches=2)
BOTH = dataclasses.replace(TINY, normalize_observations=True, normalize_rewards=True)


def without_times(rows):
    return [{key: str(value) for key, value in row.items() if key not in TIMING} for row in rows]


def norms(*networks):
    return [m for network in networks for m in network.modules() if isinstance(m, SymmetricNorm)]


# --- observations and rewards -----------------------------------------------------------------------------


def test_cartpole_trains_with_both_and_continues_exactly(tmp_path):
    config = dataclasses.replace(BOTH, iterations=20)
    whole = list(train(config, MAKE_ENV, SYMMETRY, folder=tmp_path / "whole"))
    assert all(torch.tensor(row["loss_critic"]).isfinite() for row in whole)

    for iterations in (7, 20):
        cut = dataclasses.replace(config, iterations=iterations)
        train(cut, MAKE_ENV, SYMMETRY, folder=tmp_path / "parts").run()
    stored = read_metrics(tmp_path / "parts" / "metrics.csv")
    assert without_times(stored) == without_times(whole)
    one, other = (RunFolder(tmp_path / name).load()["parts"] for name in ("whole", "parts"))
    for part in ("actor", "critic", "rewards"):
        for key, value in one[part].items():
            assert torch.equal(value, other[part][key]), (part, key)


def test_statistics_are_those_of_all_iterations_but_never_of_an_evaluation(tmp_path):
    train(BOTH, MAKE_ENV, SYMMETRY, folder=tmp_path).run()
    actor = load_actor(tmp_path, MAKE_ENV(num_envs=1), SYMMETRY)
    (norm,) = norms(actor)
    rows = BOTH.iterations * BOTH.num_envs * BOTH.horizon
    assert norm.count == rows
    assert norm.mean.abs().max() == 0  # every entry of CartPole changes sign in the mirror
    assert (norm.var - 1).abs().min() > 1e-3
    MAKE_ENV(num_envs=4, seed=1).rollout(20, actor)
    assert norm.count == rows


def test_an_exported_policy_contains_its_normaliser(tmp_path):
    train(BOTH, MAKE_ENV, SYMMETRY, folder=tmp_path / "run").run()
    export_actor(tmp_path / "run", tmp_path / "policy")
    env = MAKE_ENV(num_envs=3, seed=2)
    actors = [load_actor(tmp_path / name, env, SYMMETRY) for name in ("run", "policy")]
    state = env.reset()
    first, second = (actor.get_dist(state).mean for actor in actors)
    assert torch.equal(first, second)
    with torch.no_grad():
        norms(actors[1])[0].var.mul_(4)
    assert not torch.equal(actors[1].get_dist(state).mean, first)


def test_augmentation_sees_raw_observations_and_ratios_begin_at_one():
    config = dataclasses.replace(BOTH, epochs=1, minibatches=1, desired_kl=None)
    rows = list(train(config, MAKE_ENV, SYMMETRY))
    assert all(abs(row["kl_approx"]) < 1e-5 for row in rows)  # also after the statistics have changed
    assert all(row["clip_fraction"] == 0 for row in rows)


def test_off_changes_nothing():
    env = MAKE_ENV(num_envs=2)
    for network in make_networks(TINY, env, SYMMETRY):
        assert not norms(network)
        assert not list(network.buffers())


def test_normalised_networks_stay_equivariant_under_the_group():
    """Of a network that would be equivariant without: linear, and without a bias."""
    group = PointGroup.dihedral(3)
    actor = make_actor(
        dataclasses.replace(BOTH, hidden=()), ["observation"], 3, 3, norm=SymmetricNorm(polar(group))
    )
    (norm,) = norms(actor)
    observe(
        actor, TensorDict(observation=torch.randn(50, 3) * torch.tensor([1, 5, 2]) + 3, batch_size=[50])
    )
    mean = gaussian(actor).mean
    with torch.no_grad():
        mean.net[0].weight.copy_(torch.eye(3))
        mean.net[0].bias.zero_()
    assert_equivariant(mean, polar(group), polar(group))
    assert norm.count == 50


def test_a_normaliser_is_asked_for():
    with pytest.raises(ValueError, match="norm: expected a normaliser"):
        make_actor(BOTH, ["observation"], 3, 1)


def test_reward_scale_follows_returns_across_batches():
    torch.manual_seed(0)
    reward, done = torch.randn(3, 40, 1) + 1, torch.rand(3, 40, 1) < 0.1
    running, returns = torch.zeros(3), []
    for t in range(40):
        running = 0.9 * running + reward[:, t, 0]
        returns.append(running)
        running = running.masked_fill(done[:, t, 0], 0.0)
    scale = RewardScale(3, 0.9)
    for start, stop in ((0, 15), (15, 40)):
        following = TensorDict(reward=reward, done=done, batch_size=[3, 40])
        data = TensorDict(next=following, batch_size=[3, 40])[:, start:stop]
        scaled = scale(data)
        std = torch.stack(returns[:stop]).std(correction=0)
        torch.testing.assert_close(scaled["next", "reward"], reward[:, start:stop] / std)
        assert torch.equal(data["next", "reward"], reward[:, start:stop])
        restored = RewardScale(3, 0.9)
        restored.load_state_dict(scale.state_dict())
        scale = restored


def test_rewards_that_are_all_zero_stay_finite():
    zeros = torch.zeros(2, 5, 1)
    following = TensorDict(reward=zeros, done=zeros.bool(), batch_size=[2, 5])
    scaled = RewardScale(2, 0.9)(TensorDict(next=following, batch_size=[2, 5]))
    assert torch.equal(scaled["next", "reward"], zeros)


# --- privileged critics -----------------------------------------------------------------------------------


class Privileged(Transform):
    """Adds what the robot cannot measure; here, twice the observation."""

    def __init__(self):
        super().__init__(in_keys=["observation"], out_keys=[("privileged", "state")])

    def _apply_transform(self, x):
        return 2 * x

    def _reset(self, tensordict, tensordict_reset):
        return self._call(tensordict_reset)

    def transform_observation_spec(self, spec):
        spec["privileged"] = Composite(state=spec["observation"].clone(), shape=spec.shape)
        return spec


def make_privileged(*, num_envs, seed):
    return TransformedEnv(MAKE_ENV(num_envs=num_envs, seed=seed), Privileged())


SIGN = pseudoscalar(SYMMETRY.group)
STATE = ("privileged", "state")
WIDE = Symmetry(SYMMETRY.group, {"observation": SIGN * 3, STATE: SIGN * 3, "action": SIGN})


@pytest.mark.parametrize("normalize", [False, True])
def test_an_actor_that_does_not_read_the_privileged_group(normalize, tmp_path):
    config = dataclasses.replace(TINY, actor_keys=("observation",), normalize_observations=normalize)
    train(config, make_privileged, WIDE, folder=tmp_path).run()
    env = make_privileged(num_envs=2, seed=0)
    actor, critic = make_networks(config, env, WIDE)
    assert actor.in_keys == ["observation"]
    assert critic.in_keys == ["observation", STATE]
    assert len(norms(actor, critic)) == 2 * normalize
    robot = MAKE_ENV(num_envs=2, seed=0)  # which has nothing privileged
    for keys in (None, (STATE,)):
        policy = load_actor(tmp_path, robot, WIDE)
        assert policy.in_keys == ["observation"]
        assert policy(robot.reset())["loc"].shape == (2, 1)
        train(dataclasses.replace(config, critic_keys=keys), make_privileged, WIDE).run()


def test_unknown_and_empty_keys_are_refused():
    env = make_privileged(num_envs=2, seed=0)
    for name in ("actor_keys", "critic_keys"):
        with pytest.raises(KeyError, match=rf"{name}: expected observations .* got \['lidar'\]"):
            make_networks(dataclasses.replace(TINY, **{name: ("observation", "lidar")}), env, WIDE)
        with pytest.raises(ValueError, match=f"{name}: expected at least one key"):
            PPOConfig(**{name: ()})
        with pytest.raises(ValueError, match=f"{name}: expected distinct keys"):
            PPOConfig(**{name: ("a", "a")})
        with pytest.raises(TypeError, match=f"{name}: expected a sequence of keys"):
            PPOConfig(**{name: "observation"})
        with pytest.raises(TypeError, match=f"{name}: expected a key"):
            PPOConfig(**{name: (3,)})
    with pytest.raises(KeyError, match="privileged"):  # also what only the critic reads must be declared
        list(train(dataclasses.replace(TINY, actor_keys=("observation",)), make_privileged, SYMMETRY))


# --- configurations ---------------------------------------------------------------------------------------


def test_configurations_travel_through_files_and_old_ones_are_read():
    keys = {"actor_keys": ("observation",), "critic_keys": [STATE, "observation"]}
    config = dataclasses.replace(BOTH, **keys)
    assert config.critic_keys == (STATE, "observation")
    stored = json.loads(json.dumps(dataclasses.asdict(config)))
    assert PPOConfig(**stored) == config
    assert not config.differences(stored)
    added = {"normalize_observations", "normalize_rewards", *keys}
    old = {name: value for name, value in dataclasses.asdict(TINY).items() if name not in added}
    assert not TINY.differences(old)
    assert config.differences(old) == {
        "normalize_observations": (False, True),
        "normalize_rewards": (False, True),
        "actor_keys": (None, ("observation",)),
        "critic_keys": (None, (STATE, "observation")),
    }
