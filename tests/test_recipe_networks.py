"""The recipe's networks: what is symmetric before and after training, in mean, deviation and value."""

import dataclasses
import functools

import pytest
import torch
from torch import nn
from torchrl.envs.utils import ExplorationType, set_exploration_type

import tasks
from torchrl_sym.recipes import PPOConfig, load_actor, train
from torchrl_sym.recipes.learner import Learner
from torchrl_sym.recipes.networks import gaussian, make_actor, make_networks
from torchrl_sym.representations import polar

TINY = PPOConfig(augmentation="none", iterations=2, num_envs=8, horizon=16, epochs=2, minibatches=2)
TASKS = {
    "cartpole": {"num_threads": 1},
    "anymal_push": {"num_threads": 1, "physics_timestep": 0.01},
    "trifinger_repose": {"num_threads": 1, "physics_timestep": 0.01},
}


@functools.cache
def environment(name):
    return tasks.make_env(name, num_envs=8, seed=0, **TASKS[name])


def asymmetry(actor, critic, env):
    """How far mean, deviation and value of mirrored states are from the images of those of the states."""
    observation, action = env.symmetry["observation"], env.symmetry["action"]
    batch = env.reset().select("observation")
    batch["observation"] = torch.randn_like(batch["observation"])
    with torch.no_grad():
        gaps = []
        for g in range(env.symmetry.group.order):
            image = batch.clone().set("observation", observation(batch["observation"], g))
            mine, theirs = (actor.get_dist(b).base_dist for b in (batch, image))
            gaps.append((action(mine.loc, g) - theirs.loc).abs().max())
            gaps.append((action.absolute()(mine.scale, g) - theirs.scale).abs().max())
            values = (critic(b.clone())["state_value"] for b in (batch, image))
            gaps.append(torch.stack(list(values)).diff(dim=0).abs().max())
    return float(max(gaps))


def trained(config, name):
    torch.manual_seed(0)
    env = environment(name)
    actor, critic = make_networks(config, env, env.symmetry)
    before = asymmetry(actor, critic, env)
    learner = Learner(config, actor, critic, env.symmetry)
    for _ in range(2):
        with torch.no_grad():
            data = env.rollout(config.horizon, actor, break_when_any_done=False)
        report = learner.learn(data)
    return before, asymmetry(actor, critic, env), report


@pytest.mark.parametrize("name", TASKS)
def test_equivariant_networks_stay_symmetric(name):
    before, after, _ = trained(dataclasses.replace(TINY, network="equivariant"), name)
    assert before < 1e-5 and after < 1e-5


@pytest.mark.parametrize(
    "changes",
    [{"network": "relaxed", "tie_std": True}, {"initialization": "symmetric", "tie_std": True}],
    ids=str,
)
def test_others_are_symmetric_until_they_are_trained(changes):
    before, after, report = trained(dataclasses.replace(TINY, **changes), "anymal_push")
    assert before < 1e-5 < 1e-4 < after
    assert ("loss_relaxation" in report) is ("network" in changes)


def test_ordinary_networks_are_not_symmetric():
    before, _, report = trained(TINY, "anymal_push")
    assert before > 1e-2 and "loss_relaxation" not in report


def test_a_price_keeps_a_relaxed_network_symmetric():
    free, dear = (
        trained(dataclasses.replace(TINY, network="relaxed", tie_std=True, relaxation_coeff=c), "cartpole")[
            1
        ]
        for c in (0.0, 1e3)
    )
    assert dear < 0.3 * free


def test_augmentation_changes_no_update_of_an_equivariant_policy():
    """Equation (sym-aug) is the same for every copy then, so that a step is that of plain PPO."""
    results = []
    for augmentation in ("none", "all"):
        env = environment.__wrapped__("anymal_push")  # a new one: episodes go on from those before
        config = dataclasses.replace(TINY, network="equivariant", augmentation=augmentation)
        torch.manual_seed(0)
        actor, critic = make_networks(config, env, env.symmetry)
        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):  # of means, no gradient is left
            data = env.rollout(config.horizon, actor, break_when_any_done=False)
        learner = Learner(config, actor, critic, env.symmetry)
        rows = learner.estimate(data)
        out = learner.evaluate(rows)
        total = out["loss_objective"] + out["loss_critic"] + out["loss_entropy"]
        results.append([total, *torch.autograd.grad(total, learner.parameters, allow_unused=True)])
    for one, other in zip(*results, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-3, atol=2e-6)


def test_sizes_are_rounded_up_to_the_groups_order():
    env = environment("trifinger_repose")
    actor, _ = make_networks(
        dataclasses.replace(TINY, network="equivariant", hidden=(32, 33)), env, env.symmetry
    )
    sizes = [
        layer.out_features for layer in gaussian(actor).mean.net.dense() if isinstance(layer, nn.Linear)
    ]
    assert sizes[:2] == [33, 33]


def test_runs_are_kept_and_loaded(tmp_path):
    config = dataclasses.replace(TINY, network="equivariant", normalize_observations=True)
    make_env = functools.partial(tasks.make_env, "cartpole", num_threads=1)
    env = environment("cartpole")
    for iterations in (1, 2):  # continued
        list(
            train(
                dataclasses.replace(config, iterations=iterations),
                make_env,
                env.symmetry,
                folder=tmp_path / "run",
            )
        )
    actor = load_actor(tmp_path / "run", env, env.symmetry)
    x = env.reset()["observation"]
    with torch.no_grad():
        one, other = (gaussian(actor)(sign * x)[0] for sign in (1, -1))
    torch.testing.assert_close(one, -other, rtol=0, atol=1e-6)


def test_what_does_not_go_together_is_refused():
    with pytest.raises(ValueError, match="symmetric when"):
        dataclasses.replace(TINY, network="equivariant", initialization="symmetric")
    with pytest.raises(ValueError, match="expected representations"):
        make_actor(dataclasses.replace(TINY, network="equivariant"), ["observation"], 3, 3)
    group = environment("trifinger_repose").symmetry.group
    actor = make_actor(
        dataclasses.replace(TINY, network="equivariant"),
        ["x"],
        3,
        3,
        polar(group),
        observation=polar(group),
    )
    assert gaussian(actor)(torch.randn(5, 3))[0].shape == (5, 3)
