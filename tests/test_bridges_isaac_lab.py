"""Isaac Lab's example and TorchRL's wrapper, on a stand-in that answers as Isaac Lab does."""

import re
import runpy
import sys
from pathlib import Path

import pytest
import torch
from torchrl.envs.libs.isaac_lab import IsaacLabWrapper

from tests.foreign import assert_loss_takes_copies
from tests.isaac_lab import LENGTH, TASK, ManagerBasedRLEnv, install, parse_env_cfg
from torchrl_sym.recipes import PPOConfig, train

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def simulator():
    with pytest.MonkeyPatch.context() as patch:
        install(patch.setitem, patch.setattr)
        yield


@pytest.fixture(scope="module")
def example(simulator):
    """What the names of the example stand for, once it has run."""
    with pytest.MonkeyPatch.context() as patch:
        tiny = ["--iterations", "2", "--num-envs", "8", "--device", "cpu", "--headless"]
        patch.setattr(sys, "argv", ["isaac_lab.py", *tiny])
        return runpy.run_path(str(ROOT / "examples/isaac_lab.py"))


def make(example=None):
    env = IsaacLabWrapper(ManagerBasedRLEnv(parse_env_cfg(TASK, "cpu", 4)), device="cpu")
    return env if example is None else env.append_transform(example["LastSeen"](["policy"]))


def test_the_example_trains(example):
    metrics = example["metrics"]
    assert metrics["iteration"] == 2 and metrics["frames"] == 2 * 24 * 8
    assert metrics["return"] < 0 and metrics["loss_critic"] > 0
    assert example["symmetry"].keys() == ["policy", "action"]


@pytest.mark.parametrize(
    ("element", "signs", "legs", "joints"),
    [
        ("reflect-y", [1, -1, 1, -1, 1, -1, 1, -1, 1, 1, -1, -1], [2, 3, 0, 1], [-1, 1, 1]),
        ("reflect-x", [-1, 1, 1, 1, -1, -1, -1, 1, 1, -1, 1, -1], [1, 0, 3, 2], [1, -1, -1]),
    ],
)
def test_what_it_declares_is_isaac_labs_own_table(example, element, signs, legs, joints):
    """Of velocity/mdp/symmetry/anymal.py: both velocities, gravity, command; joints hip by hip first."""
    base, *angles = torch.randn(48).split(12)
    images = [base * torch.tensor(signs)]
    images += [(x.view(3, 4)[:, legs] * torch.tensor(joints)[:, None]).flatten() for x in angles]
    symmetry = example["symmetry"]
    assert (symmetry["policy"](torch.cat([base, *angles]), element) == torch.cat(images)).all()
    assert (symmetry["action"](angles[-1], element) == images[-1]).all()


def test_mirrored_robots_observe_images_through_the_wrapper(example):
    env, symmetry = make(), example["symmetry"]
    td, simulation = env.reset(), env.unwrapped
    for name, frames in simulation.frames.items():
        frames[:] = example["terms"][name].orbit(frames[0])
    simulation.episode_length_buf[:] = 0
    for _ in range(LENGTH - 1):
        td = env.step(td.set("action", symmetry["action"].orbit(torch.randn(12))))["next"]
        torch.testing.assert_close(symmetry["policy"].orbit(td["policy"][0]), td["policy"])
    assert (td["policy"][1:] - td["policy"][0]).abs().amax(-1).min() > 0.1


def test_where_an_episode_ended_is_what_was_seen_last(example):
    torch.manual_seed(0)
    data = make(example).rollout(3 * LENGTH, break_when_any_done=False)
    ended = data["next", "done"].squeeze(-1)
    assert ended[:, :-1].any() and not ended.all()
    assert (data["next", "policy"][ended] == data["policy"][ended]).all()
    goes_on = ~ended[:, :-1]
    assert (data["next", "policy"][:, :-1][goes_on] == data["policy"][:, 1:][goes_on]).all()
    begun = data["policy"][:, 1:][ended[:, :-1]]  # of the next episode
    assert begun.isfinite().all() and (begun[:, -12:] == 0).all()


def test_without_it_the_training_refuses_what_nobody_saw(example):
    config = PPOConfig(iterations=1, num_envs=4, horizon=2 * LENGTH, minibatches=1)
    with pytest.raises(FloatingPointError, match=re.escape("('next', 'policy')")):
        train(config, lambda **_: make(), example["symmetry"]).run()


def test_a_loss_takes_what_it_gives(example):
    torch.manual_seed(0)
    assert_loss_takes_copies(make(example), example["symmetry"], steps=2 * LENGTH)
