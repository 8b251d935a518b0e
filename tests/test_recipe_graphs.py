"""Updates recorded into CUDA graphs, as far as a CPU can tell: what a replay does, and what is refused."""

import dataclasses
import functools
import types

import pytest
import torch
from tensordict import TensorDict

import tasks
from tests.fake_graphs import FakeCuda
from torchrl_sym.recipes import PPOConfig
from torchrl_sym.recipes.compilation import recorded
from torchrl_sym.recipes.learner import Learner
from torchrl_sym.recipes.networks import make_networks
from torchrl_sym.recipes.ranks import Ranks
from torchrl_sym.recipes.recording import Recorded

CONFIG = PPOConfig(num_envs=8, horizon=8, epochs=4, minibatches=4, desired_kl=1e-4)
MAKE_ENV = functools.partial(tasks.make_env, "cartpole", num_threads=1)
SYMMETRY = MAKE_ENV(num_envs=1, seed=0).symmetry


@pytest.fixture
def cuda(monkeypatch):
    return FakeCuda.install(monkeypatch)


def learned(config, record):
    """Parameters and report after an iteration of 16 updates, of which 12 are replays if recorded."""
    torch.manual_seed(0)
    env = MAKE_ENV(num_envs=config.num_envs, seed=0)
    learner = Learner(config, *make_networks(config, env, SYMMETRY), SYMMETRY)
    with torch.no_grad():
        data = env.rollout(config.horizon, learner.actor)
    if record:
        learner.update = Recorded(learner._update)
    report = learner.learn(data)
    return torch.cat([parameter.detach().flatten() for parameter in learner.parameters]), report


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"augmentation": "none", "adapt_every": "iteration", "clip_value": None},
        {"network": "relaxed", "mirror_coeff": 0.1, "max_grad_norm": 0.01, "autocast": "bfloat16"},
    ],
    ids=str,
)
def test_replays_are_updates(settings, cuda, monkeypatch):
    monkeypatch.setattr(PPOConfig, "accelerated", True)
    config = dataclasses.replace(CONFIG, **settings)
    (plain, expected), (replayed, report) = learned(config, False), learned(config, True)
    torch.testing.assert_close(replayed, plain, rtol=1e-5, atol=1e-6)
    assert report == pytest.approx(expected, rel=1e-4, abs=1e-6)


def test_a_number_of_pythons_would_be_that_of_the_recording(cuda):
    """The way of the CPU, whose rate is a number, cannot be recorded; the fake shows it."""
    (plain, _), (replayed, _) = learned(CONFIG, False), learned(CONFIG, True)
    assert (replayed - plain).abs().max() > 1e-3


def test_recording_begins_when_all_is_settled(cuda):
    seen = []

    def function(batch):
        seen.append(batch["x"])
        return batch["x"] * 2

    double = Recorded(function)
    for number in range(8):
        out = double(TensorDict(x=torch.full((3,), float(number)), batch_size=[3]))
        assert out.tolist() == [2.0 * number] * 3
        if number == 5:
            kept = out
    assert len(seen) == 5  # four calls, and one that was recorded
    assert kept.tolist() == [10.0] * 3  # not written over by the next


def test_an_update_that_waits_is_not_recorded(cuda):
    calls = []

    def function(batch):
        cuda.wait()
        calls.append(batch)
        return batch["x"]

    update, batch = Recorded(function), TensorDict(x=torch.ones(2), batch_size=[2])
    for _ in range(3):
        update(batch)
    with pytest.warns(RuntimeWarning, match="without a CUDA graph.*called a synchronizing CUDA operation"):
        update(batch)
    for _ in range(3):
        update(batch)
    assert len(calls) == 7 and cuda.mode == "default"


def test_other_warnings_of_an_update_are_not_lost(cuda):
    def function(batch):
        torch.warnings.warn("something else", UserWarning, stacklevel=1)
        return batch["x"]

    update, batch = Recorded(function), TensorDict(x=torch.ones(2), batch_size=[2])
    for _ in range(4):
        with pytest.warns(UserWarning, match="something else"):
            update(batch)


def test_a_recording_that_fails_says_how_to_go_on(cuda):
    calls = []

    def function(batch):
        calls.append(batch)
        if len(calls) == 5:
            raise RuntimeError("operation not permitted when stream is capturing\nmore")
        return batch["x"]

    update, batch = Recorded(function), TensorDict(x=torch.ones(2), batch_size=[2])
    for _ in range(4):
        update(batch)
    with pytest.raises(
        RuntimeError, match=r"\(operation not permitted.*capturing\); start again"
    ):
        update(batch)


def test_graphs_are_for_one_process_on_cuda():
    def update(batch):
        return batch["x"]

    assert recorded(update, "cpu", Ranks()) is update
    assert isinstance(recorded(update, "cuda:0", Ranks()), Recorded)
    with pytest.warns(RuntimeWarning, match="not recorded into CUDA graphs, since several processes"):
        assert recorded(update, "cuda", types.SimpleNamespace(count=2)) is update
