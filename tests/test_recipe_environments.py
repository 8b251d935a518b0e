"""The recipe on environments other than a bare task: several observations, processes, transforms."""

import dataclasses
import functools
import warnings

import pytest
import torch
from torchrl.data import OneHot
from torchrl.envs import ParallelEnv, RewardScaling, SerialEnv, StepCounter, TransformedEnv
from torchrl.envs.libs.dm_control import DMControlEnv

import tasks
from torchrl_sym import PointGroup, Symmetry
from torchrl_sym.recipes import PPOConfig, RunFolder, train
from torchrl_sym.recipes.networks import make_actor
from torchrl_sym.representations import polar, pseudoscalar, scalar, signed_permutation

TINY = PPOConfig(iterations=2, num_envs=4, horizon=8, epochs=1, minibatches=1)
TASK = functools.partial(tasks.make_env, "cartpole", num_threads=1)


def transformed(*, num_envs, seed):
    return TransformedEnv(
        TransformedEnv(TASK(num_envs=num_envs, seed=seed), StepCounter()), RewardScaling(0, 1)
    )


def serial(*, num_envs, seed):
    return SerialEnv(2, functools.partial(TASK, num_envs=num_envs // 2, seed=seed))


def processes(*, num_envs, seed):
    make = functools.partial(TASK, num_envs=num_envs // 2, seed=seed)
    return ParallelEnv(2, make)


@pytest.mark.parametrize("make_env", [transformed, serial, pytest.param(processes, marks=pytest.mark.slow)])
def test_wrapped_environments_train_and_continue_with_a_warning(make_env, tmp_path):
    symmetry = TASK(num_envs=1, seed=0).symmetry
    assert len(list(train(TINY, make_env, symmetry, folder=tmp_path))) == 2
    with pytest.warns(UserWarning, match="not exactly"):
        rest = list(train(dataclasses.replace(TINY, iterations=3), make_env, symmetry, folder=tmp_path))
    assert [row["iteration"] for row in rest] == [3]


def test_a_maker_that_ignores_its_seed_can_be_repeated():
    def ignoring(*, num_envs, seed):
        return SerialEnv(num_envs, lambda: DMControlEnv("pendulum", "swingup", from_pixels=False))

    group = PointGroup.reflection("y")
    sign = pseudoscalar(group)
    entries = {"orientation": scalar(group) + sign, "velocity": sign, "action": sign}
    config = dataclasses.replace(TINY, num_envs=2)
    runs = [list(train(config, ignoring, Symmetry(group, entries)))[-1]["log_prob"] for _ in range(2)]
    assert runs[0] == runs[1]


@pytest.mark.parametrize(("make_env", "restored"), [(TASK, True), (transformed, True), (serial, False)])
def test_returns_of_running_episodes_continue_if_the_episodes_do(make_env, restored, tmp_path):
    symmetry, run = TASK(num_envs=1, seed=0).symmetry, RunFolder(tmp_path)
    list(train(TINY, make_env, symmetry, folder=tmp_path))
    checkpoint = run.load()
    checkpoint["episodes"]["running"] += 1e6
    run.save(checkpoint)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        list(train(dataclasses.replace(TINY, iterations=3), make_env, symmetry, folder=tmp_path))
    assert (run.load()["episodes"]["running"] > 1e5).any() == restored


def test_bare_tasks_continue_without_a_warning(tmp_path):
    symmetry = TASK(num_envs=1, seed=0).symmetry
    list(train(TINY, TASK, symmetry, folder=tmp_path))
    with warnings.catch_warnings():
        warnings.simplefilter("error", UserWarning)
        list(train(dataclasses.replace(TINY, iterations=3), TASK, symmetry, folder=tmp_path))


def test_several_observations_in_double_precision():
    group = PointGroup.reflection("x")
    same, sign = scalar(group), pseudoscalar(group)
    symmetry = Symmetry(group, {"position": sign + same + sign, "velocity": sign * 2, "action": sign})

    def make_env(*, num_envs, seed):
        return DMControlEnv("cartpole", "swingup", random=seed)

    rows = list(train(dataclasses.replace(TINY, num_envs=1, horizon=32), make_env, symmetry))
    assert torch.tensor(rows[-1]["loss_objective"]).isfinite()


def test_discrete_actions_are_refused():
    def make_env(*, num_envs, seed):
        env = TASK(num_envs=num_envs, seed=seed)
        env.set_spec_lock_(False)
        env.action_spec = OneHot(2, shape=(num_envs, 2))
        return env

    group = PointGroup.reflection("x")
    symmetry = Symmetry(group, {"observation": pseudoscalar(group) * 3, "action": scalar(group) * 2})
    with pytest.raises(TypeError, match="expected one continuous action"):
        list(train(TINY, make_env, symmetry))


def test_losses_are_reported():
    symmetry = TASK(num_envs=1, seed=0).symmetry
    row = next(train(dataclasses.replace(TINY, mirror_coeff=1.0), TASK, symmetry))
    assert {"loss_mirror", "loss_entropy", "loss_critic", "loss_objective", "ESS"} <= row.keys()


def test_tied_std_makes_the_policy_symmetric_in_its_scale():
    group = PointGroup.reflection("y")
    swap = {"left": "-right", "right": "-left"}
    action = signed_permutation(group, list(swap), {"reflect-y": swap})
    config = dataclasses.replace(TINY, tie_std=True)
    free, tied = (
        make_actor(c, ["observation"], 3, 2, action)
        for c in (dataclasses.replace(config, tie_std=False), config)
    )
    for actor, equal in ((free, False), (tied, True)):
        torch.nn.init.uniform_(actor.get_parameter("module.0.module.log_std"), -1.0, 0.0)
        scale = actor.get_dist(TASK(num_envs=2, seed=0).reset()).base_dist.scale
        assert bool((scale[:, 0] == scale[:, 1]).all()) is equal
    turned = make_actor(config, ["observation"], 3, 3, polar(PointGroup.rotation(3)))
    torch.nn.init.uniform_(turned.get_parameter("module.0.module.log_std"), -1.0, 0.0)
    scale = turned.get_dist(TASK(num_envs=2, seed=0).reset()).base_dist.scale
    assert bool((scale[:, 0] == scale[:, 1]).all()), "x and y are mixed by a turn"
    assert not bool((scale[:, 0] == scale[:, 2]).any())
