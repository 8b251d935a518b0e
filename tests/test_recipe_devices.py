"""Training where the host would wait for each number it asks for: it asks once per iteration."""

import contextlib
import copy
import dataclasses
import functools
import math

import pytest
import torch

import tasks
from tests.waits import Answers, Resident, Waits
from torchrl_sym.recipes import PPOConfig, learner, train, training
from torchrl_sym.recipes.fetching import pack, unpack
from torchrl_sym.recipes.optimizer import FusedAdam
from torchrl_sym.recipes.rate import AdaptiveRate
from torchrl_sym.recipes.training import _Run

TINY = PPOConfig(iterations=2, num_envs=8, horizon=4, epochs=1, minibatches=2)
MAKE_ENV = functools.partial(tasks.make_env, "cartpole", num_threads=1)
SYMMETRY = MAKE_ENV(num_envs=1, seed=0).symmetry
SETTINGS = [
    {},
    {"augmentation": "random", "mirror_coeff": 0.1, "adapt_every": "iteration"},
    {"augmentation": "naive", "autocast": "bfloat16"},
    {"augmentation": "none", "normalize_observations": True, "normalize_rewards": True},
    {"network": "equivariant", "augmentation": "none", "desired_kl": None},
    {"network": "relaxed", "mirror_coeff": 0.1, "std_schedule": (0.4, 0.1)},
]


@pytest.fixture
def accelerated(monkeypatch):
    """The CPU, used as if the host had to wait for it."""
    monkeypatch.setattr(PPOConfig, "accelerated", True)


def make_resident(*, num_envs, seed, device="cpu"):
    return Resident(num_envs, device)


def waits_of_an_iteration(config, monkeypatch, spoil=None):
    """What is waited for in the second iteration before its numbers are fetched, and how often that is."""
    waits, fetches = Waits(), []

    def fetch(pending):
        fetches.append(list(waits.found))
        return pending

    monkeypatch.setattr(training, "fetch", fetch)
    with contextlib.closing(train(config, make_resident, SYMMETRY)) as rows:
        next(rows)
        if spoil is not None:
            spoil()
        with waits:
            row = next(rows)
    assert row["success"] == 0.25 and math.isfinite(row["kl"])
    return fetches[1:]


@pytest.mark.parametrize("settings", SETTINGS, ids=str)
def test_an_iteration_waits_once(settings, accelerated, monkeypatch):
    assert waits_of_an_iteration(dataclasses.replace(TINY, **settings), monkeypatch) == [[]]


@pytest.mark.parametrize(
    ("place", "wait", "found"),
    [
        ((learner.SymmetricClipPPOLoss, "forward"), lambda x: x.item(), "_local_scalar_dense"),
        ((learner.GAE, "forward"), lambda x: x[x.isnan()], "index"),
        ((AdaptiveRate, "step"), lambda x: x.nonzero(), "nonzero"),
        ((Resident, "step"), lambda x: bool(x), "_local_scalar_dense"),
    ],
)
def test_a_planted_wait_is_found(place, wait, found, accelerated, monkeypatch):
    owner, name = place
    method = getattr(owner, name)

    def waiting(*args, **kwargs):
        wait(torch.zeros(1))
        return method(*args, **kwargs)

    spoil = functools.partial(monkeypatch.setattr, owner, name, waiting)
    (waits,) = waits_of_an_iteration(TINY, monkeypatch, spoil)
    assert set(waits) == {f"aten::{found}"}


def learn_on_meta(config, monkeypatch):
    """Everything after the collector, where there are no numbers; what was fetched, each time."""
    fetched = []

    def fetch(pending):
        fetched.append(pending)
        return {
            name: torch.ones(value.shape, dtype=value.dtype) if value.device.type == "meta" else value
            for name, value in pending.items()
        }

    monkeypatch.setattr(training, "fetch", fetch)
    monkeypatch.setattr(FusedAdam, "step", lambda self: None)  # fused kernels know devices that compute
    config = dataclasses.replace(config, device="meta", autocast=None)  # which "meta" has not
    with Answers():
        run = _Run(config, functools.partial(make_resident, device="meta"), SYMMETRY, None, None)
    env, state = run.env, run.env.reset()
    with torch.no_grad():
        steps = []
        for _ in range(config.horizon):
            step, state = env.step_and_maybe_reset(run.learner.actor(state))
            steps.append(step)
    assert run._learn(torch.stack(steps, 1))["success"] == 1.0
    return fetched


@pytest.mark.parametrize("settings", SETTINGS, ids=str)
def test_learning_runs_where_there_are_no_numbers(settings, monkeypatch):
    (pending,) = learn_on_meta(dataclasses.replace(TINY, **settings), monkeypatch)
    assert {value.device.type for value in pending.values()} == {"meta"}


@pytest.mark.parametrize("ask", [torch.Tensor.tolist, torch.Tensor.cpu, torch.Tensor.numpy, float])
def test_there_whoever_asks_fails(ask, monkeypatch):
    original = training.observe
    monkeypatch.setattr(training, "observe", lambda *a: (ask(a[1]["action"].sum()), original(*a)))
    with pytest.raises((RuntimeError, NotImplementedError, TypeError), match="meta"):
        learn_on_meta(TINY, monkeypatch)


@pytest.mark.parametrize("settings", SETTINGS, ids=str)
def test_both_ways_learn_the_same(settings, monkeypatch):
    config = dataclasses.replace(TINY, **settings)
    plain = list(train(config, MAKE_ENV, SYMMETRY))
    monkeypatch.setattr(PPOConfig, "accelerated", True)
    for mine, other in zip(train(config, MAKE_ENV, SYMMETRY), plain, strict=True):
        for name in ("loss_objective", "loss_critic", "kl", "gradient_norm", "learning_rate", "std"):
            assert mine[name] == pytest.approx(other[name], rel=2e-3, abs=1e-5), name


def test_what_is_not_finite_is_named_when_it_is_fetched(accelerated, monkeypatch):
    forward = learner.SymmetricClipPPOLoss.forward

    def spoilt(self, batch):
        out = forward(self, batch)
        return out.set("loss_critic", out["loss_critic"] * math.inf)

    with monkeypatch.context() as patch:
        patch.setattr(learner.SymmetricClipPPOLoss, "forward", spoilt)
        with pytest.raises(FloatingPointError, match="'loss_critic': inf"):
            train(TINY, make_resident, SYMMETRY).run()

    def spoil(x):
        return x.log() if x.is_floating_point() else x

    state = Resident._state
    monkeypatch.setattr(Resident, "_state", lambda *a, **k: state(*a, **k).apply(spoil))
    with pytest.raises(FloatingPointError, match=r"'observation' of \d+ of 32 samples"):
        train(TINY, make_resident, SYMMETRY).run()


def test_numbers_of_all_kinds_come_in_one_piece():
    tensors = {
        "reward": torch.randn(3, 4, 1),
        "done": torch.tensor([True, False, True]),
        "kl": torch.tensor(0.1),
        "count": torch.tensor([3, 4]),
    }
    again = unpack(pack(tensors), tensors)
    for name, value in tensors.items():
        assert again[name].dtype == value.dtype
        assert torch.equal(again[name], value)


def test_a_rate_that_is_a_tensor_follows_the_same_rule():
    weight = torch.nn.Parameter(torch.zeros(2))
    both = [FusedAdam([weight], 1e-3, accelerated=accelerated) for accelerated in (False, True)]
    rates = [AdaptiveRate(optimizer, 0.01, low=5e-4, high=2e-3) for optimizer in both]
    tensor = both[1].param_groups[0]["lr"]
    for kl in (0.03, 0.03, 0.012, 0.001, 0.001, 0.001, 0.001, 0.0, math.nan, -1.0):
        for rate in rates:
            rate.step(torch.tensor(kl))
        assert float(both[1].rate) == pytest.approx(float(both[0].rate), rel=1e-6), kl
    assert both[1].param_groups[0]["lr"] is tensor  # a recorded graph reads it there


@pytest.mark.parametrize("stored", [False, True])
def test_the_optimizer_goes_on_elsewhere(stored):
    weights = [torch.nn.Parameter(torch.ones(2)) for _ in range(2)]
    first, second = (
        FusedAdam([weight], rate, accelerated=accelerated)
        for weight, rate, accelerated in zip(weights, (0.25, 0.5), (stored, not stored), strict=True)
    )
    tensor = second.param_groups[0]["lr"]
    weights[0].grad = torch.ones(2)
    first.step()
    state = copy.deepcopy(first.state_dict())  # which shares its tensors
    assert state["param_groups"][0]["lr"] == 0.25 and not state["param_groups"][0]["capturable"]
    second.load_state_dict(state)
    assert float(second.rate) == 0.25
    assert isinstance(tensor, float) or second.param_groups[0]["lr"] is tensor
    weights[1].data.copy_(weights[0].data)
    for weight, optimizer in zip(weights, (first, second), strict=True):
        weight.grad = torch.full((2,), 0.5)
        optimizer.step()
    torch.testing.assert_close(*weights)
