"""Exported policies act as the actor does, for any batch size; what cannot be exported is refused."""

import functools

import pytest
import torch
from tensordict.nn import ProbabilisticTensorDictModule, ProbabilisticTensorDictSequential, TensorDictModule
from torch import nn
from torchrl.envs import ObservationNorm, TransformedEnv
from torchrl.modules import NormalParamExtractor, TanhNormal

import tasks
from torchrl_sym.mirror_loss import deterministic_action
from torchrl_sym.recipes import PPOConfig, export_policy, make_actor, train

MAKE_ENV = functools.partial(tasks.make_env, "cartpole", num_threads=1)


class Scaled(nn.Module):
    """A normaliser inside a network, with its numbers in buffers."""

    def __init__(self):
        super().__init__()
        self.register_buffer("loc", torch.tensor([0.5, -1.0, 2.0]))
        self.register_buffer("std", torch.tensor([2.0, 0.1, 3.0]))

    def forward(self, x):
        return (x - self.loc) / self.std


def squashed() -> ProbabilisticTensorDictSequential:
    net = nn.Sequential(Scaled(), nn.Linear(3, 2), nn.Dropout(0.5), NormalParamExtractor())
    return ProbabilisticTensorDictSequential(
        TensorDictModule(net, ["observation"], ["loc", "scale"]),
        ProbabilisticTensorDictModule(["loc", "scale"], ["action"], distribution_class=TanhNormal),
    )


def gaussian_policy() -> ProbabilisticTensorDictSequential:
    return make_actor(PPOConfig(tie_std=False), ["observation"], 3, 1)


def expected(actor, x):
    batch = MAKE_ENV(num_envs=len(x)).reset().set("observation", x)
    return deterministic_action(actor.eval().get_dist(batch.select("observation")))


@pytest.mark.parametrize("make", [gaussian_policy, squashed])
def test_a_program_acts_as_the_actor(make, tmp_path):
    torch.manual_seed(0)
    actor = make()
    path = export_policy(actor, tmp_path / "new" / "policy.pt2", MAKE_ENV(num_envs=4))
    assert actor.training, "the caller's actor was changed"
    program = torch.export.load(path).module()
    for rows in (1, 7):
        x = torch.randn(rows, 3)
        torch.testing.assert_close(program(x), expected(actor, x).detach())
        actor.train()


def test_a_folder_is_exported_in_one_call(tmp_path):
    env = MAKE_ENV(num_envs=2, seed=0)
    config = PPOConfig(iterations=1, num_envs=4, horizon=8, minibatches=2, epochs=1)
    train(config, MAKE_ENV, env.symmetry, folder=tmp_path / "run").run()
    path = export_policy(tmp_path / "run", tmp_path / "policy.pt2", env, env.symmetry)
    assert torch.export.load(path).module()(torch.zeros(3, 3)).shape == (3, 1)
    with pytest.raises(ValueError, match="symmetry: expected that of the training"):
        export_policy(tmp_path / "run", tmp_path / "policy.pt2", env)
    with pytest.raises(FileNotFoundError, match="train there first"):
        export_policy(tmp_path / "nowhere", tmp_path / "policy.pt2", env, env.symmetry)


def test_onnx_runs_the_same_policy(tmp_path):
    pytest.importorskip("onnxscript")
    runtime = pytest.importorskip("onnxruntime")
    actor = gaussian_policy()
    path = export_policy(actor, tmp_path / "policy.onnx", MAKE_ENV(num_envs=1))
    session = runtime.InferenceSession(str(path))
    assert [each.name for each in session.get_inputs()] == ["observation"]
    assert [each.name for each in session.get_outputs()] == ["action"]
    for rows in (1, 7):
        x = torch.randn(rows, 3)
        (action,) = session.run(["action"], {"observation": x.numpy()})
        torch.testing.assert_close(torch.from_numpy(action), expected(actor, x).detach())


def test_onnx_without_its_packages_is_refused(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "onnxscript", None)
    with pytest.raises(ImportError, match=r"pip install 'torchrl_sym\[onnx\]'"):
        export_policy(gaussian_policy(), tmp_path / "policy.onnx", MAKE_ENV(num_envs=1))


class Reversed(nn.Module):
    """Decides in Python: a program would keep the branch it was traced with."""

    calls = 0

    def forward(self, x):
        self.calls += 1
        return x if self.calls < 2 else -x


def test_what_is_not_exported_rightly_is_refused(tmp_path):
    env, path = MAKE_ENV(num_envs=1), tmp_path / "policy.pt2"
    with pytest.raises(ValueError, match=r"one of \['.onnx', '.pt2'\], got 'policy.jit'"):
        export_policy(gaussian_policy(), tmp_path / "policy.jit", env)
    with pytest.raises(ValueError, match=r"also reads \['memory'\]"):
        export_policy(make_actor(PPOConfig(), ["observation", "memory"], 5, 1), path, env)
    normalised = TransformedEnv(env, ObservationNorm(loc=1.0, scale=2.0, in_keys=["observation"]))
    with pytest.raises(ValueError, match=r"\['observation'\] from transforms"):
        export_policy(gaussian_policy(), path, normalised)
    actor = squashed()
    actor[0].module[2] = Reversed()
    with pytest.raises(ValueError, match="differs by"):
        export_policy(actor, path, env)
    assert not path.exists()
