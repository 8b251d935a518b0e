"""What TorchRL asks of a transform, for SymmetryAugment; and TorchRL's own tests, for ours.

TorchRL lists the tests that every transform must have in ``TransformBase``, which its tests share. Those of
``ClipPPOLoss`` and ``VecNormV2`` are run where the environment variable TORCHRL_CHECKOUT names a checkout
of TorchRL: :mod:`tests.torchrl_suite` says how, which ones cannot apply, and why.
"""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import LazyTensorStorage, ReplayBuffer, TensorDictReplayBuffer
from torchrl.envs import Compose, DoubleToFloat, ParallelEnv, SerialEnv, TransformedEnv

from tests.networks import make_batch, make_symmetry
from tests.symmetric_policies import GROUPS, feed_forward
from tests.torchrl_suite import FILES
from torchrl_sym import SymmetryAugment

ROOT = Path(__file__).resolve().parents[1]
CHECKOUT = os.environ.get("TORCHRL_CHECKOUT")
with_checkout = pytest.mark.skipif(not CHECKOUT, reason="TORCHRL_CHECKOUT names no checkout of TorchRL")


def make_env():
    return feed_forward(GROUPS["C2"], symmetric=True).make_env()


def transformed_env():
    return TransformedEnv(make_env(), SymmetryAugment(make_symmetry()))


class TestSymmetryAugment:
    """The tests of TransformBase. An environment has no batch to grow, so that it is refused there."""

    def test_single_trans_env_check(self):
        with pytest.raises(RuntimeError, match="cannot be appended to an environment"):
            transformed_env()

    def test_serial_trans_env_check(self):
        with pytest.raises(RuntimeError, match="cannot be appended to an environment"):
            SerialEnv(2, transformed_env)

    def test_parallel_trans_env_check(self):
        with pytest.raises(RuntimeError, match="cannot be appended to an environment"):
            ParallelEnv(2, transformed_env)

    def test_trans_serial_env_check(self):
        with pytest.raises(RuntimeError, match="cannot be appended to an environment"):
            TransformedEnv(SerialEnv(2, make_env), SymmetryAugment(make_symmetry()))

    def test_trans_parallel_env_check(self):
        with pytest.raises(RuntimeError, match="cannot be appended to an environment"):
            TransformedEnv(ParallelEnv(2, make_env), SymmetryAugment(make_symmetry()))

    def test_transform_no_env(self):
        batch, symmetry = make_batch(), make_symmetry()
        out = SymmetryAugment(symmetry)(batch)
        expected = torch.cat([batch, symmetry(batch, "reflect-y")])
        assert set(out.keys(True, True)) == set(batch.keys(True, True))
        assert (out == expected).all()

    def test_transform_compose(self):
        batch, augment = make_batch(), SymmetryAugment(make_symmetry())
        out = Compose(augment, DoubleToFloat(in_keys=["observation"]))(batch.clone())
        assert torch.equal(out["observation"], augment(batch)["observation"].float())

    def test_transform_env(self):
        env = TransformedEnv(make_env())
        with pytest.raises(RuntimeError, match="cannot be appended to an environment"):
            env.append_transform(SymmetryAugment(make_symmetry()))

    def test_transform_model(self):
        batch, augment = make_batch(), SymmetryAugment(make_symmetry())
        module = TensorDictModule(lambda x: x + 1, in_keys=["observation"], out_keys=["more"])
        out = nn.Sequential(augment, module)(batch)
        assert torch.equal(out["more"], augment(batch)["observation"] + 1)

    @pytest.mark.parametrize("when", ["sample", "extend"])
    @pytest.mark.parametrize("appended", [True, False])
    def test_transform_rb(self, when, appended):
        batch, augment = make_batch(), SymmetryAugment(make_symmetry(), when=when)
        own = {} if appended else {"transform": augment}
        buffer = ReplayBuffer(storage=LazyTensorStorage(2 * len(batch)), batch_size=len(batch), **own)
        if appended:
            buffer.append_transform(augment)
        buffer.extend(batch)
        assert len(buffer) == (len(batch) if when == "sample" else 2 * len(batch))
        sample = buffer.sample()
        assert len(sample) == (2 * len(batch) if when == "sample" else len(batch))
        known = augment.augment(batch)["observation"]
        distance = torch.cdist(sample["observation"], known).amin(-1)
        assert torch.equal(distance, torch.zeros_like(distance))

    def test_transform_rb_that_counts_its_records(self):
        settings = {"storage": LazyTensorStorage(12), "batch_size": 4}
        buffer = TensorDictReplayBuffer(**settings, transform=SymmetryAugment(make_symmetry()))
        buffer.extend(make_batch())
        with pytest.raises(RuntimeError, match="modified the shape"):
            buffer.sample()

    def test_transform_inverse(self):
        batch = make_batch()
        assert (SymmetryAugment(make_symmetry()).inv(batch) == batch).all()  # copies come out, not in
        extended = Compose(SymmetryAugment(make_symmetry(), when="extend")).inv(batch)
        assert torch.equal(extended["action"], SymmetryAugment(make_symmetry())(batch)["action"])


@with_checkout
def test_the_list_of_torchrl_is_complete():
    source = (Path(CHECKOUT) / "test/transforms/_transforms_common.py").read_text()
    asked = re.findall(r"@abc.abstractmethod\n    def (test_\w+)", source)
    assert len(asked) >= 11
    assert not [name for name in asked if not hasattr(TestSymmetryAugment, name)]


@with_checkout
@pytest.mark.slow
@pytest.mark.parametrize("elements", ["all", "random"])
def test_tests_of_torchrl(elements):
    checkout = Path(CHECKOUT).resolve()
    command = [sys.executable, "-m", "pytest", "-q", "--tb=short", "-c", str(checkout / "pytest.ini")]
    command += ["-p", "tests.torchrl_suite", "-p", "no:cacheprovider", "--symmetric", elements]
    files = [str(checkout / "test" / name) for name in FILES]
    path = os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])
    ran = subprocess.run(
        [*command, *files],
        cwd=checkout,
        env=os.environ | {"PYTHONPATH": path},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ran.returncode == 0, ran.stdout[-5000:] + ran.stderr[-2000:]
    assert int(re.search(r"(\d+) passed", ran.stdout)[1]) > 500
