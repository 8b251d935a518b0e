"""What we expect of TorchRL's private names."""

import ast
import inspect
import textwrap

import pytest
import torch
from dm_control import suite
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage, ReplayBuffer, SliceSampler, TensorDictReplayBuffer
from torchrl.data.replay_buffers import Transition
from torchrl.envs import GymWrapper, RewardSum, SerialEnv, StepCounter, Transform, TransformedEnv
from torchrl.envs.libs.dm_control import DMControlWrapper

from tasks import make_env
from torchrl_sym import (
    MirrorLoss,
    SymmetricClipPPOLoss,
    SymmetricVecNorm,
    SymmetryAugment,
    SymmetryReplayBuffer,
)
from torchrl_sym._torchrl import (
    INHERITED,
    buffers_sampling_by,
    cuts_by,
    serial_workers,
    wrapped_env,
    wrappers_of,
)


@pytest.mark.parametrize("parent", INHERITED, ids=lambda parent: parent.__name__)
def test_private_methods_are_as_they_were(parent):
    for name, arguments in INHERITED[parent].items():
        member = inspect.getattr_static(parent, name)
        if arguments is None:
            assert isinstance(member, property), name
        else:
            assert list(inspect.signature(member).parameters)[1:] == arguments, name


@pytest.mark.parametrize(
    "child",
    [SymmetricClipPPOLoss, MirrorLoss, SymmetryReplayBuffer, SymmetryAugment, SymmetricVecNorm],
    ids=lambda child: child.__name__,
)
def test_all_that_a_class_takes_from_its_parent_is_listed(child):
    """What its source reads of itself, or defines, and its parent has under a private name."""
    parent = child.__mro__[1]
    tree = ast.parse(textwrap.dedent(inspect.getsource(child)))
    read = {node.attr for node in ast.walk(tree) if isinstance(node, ast.Attribute)}
    defined = {node.name for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)}
    private = {name for name in read | defined if name.startswith("_") and not name.startswith("__")}
    taken = {name for name in private if inspect.getattr_static(parent, name, None) is not None}
    of_torch = {name for name in taken if name in dir(torch.nn.Module)}  # such as _apply
    data = {"_AcceptedKeys", "_schedulable_buffers"}  # of TorchRL's documented way to write a loss
    assert taken - of_torch - data == set(INHERITED[parent])


def test_workers_of_a_serial_environment():
    def summed():
        return TransformedEnv(make_env("cartpole", num_envs=2, num_threads=1), RewardSum())

    def counted():
        return TransformedEnv(make_env("cartpole", num_envs=2, num_threads=1), StepCounter())

    for started in (False, True):
        env = SerialEnv(3, [summed, summed, counted])
        if started:
            env.start()
        kinds = [type(worker.transform) for worker in serial_workers(env)]
        assert kinds == [RewardSum, StepCounter]
        env.close()


def test_buffers_of_a_storage_and_their_sample_unit():
    storage, unit = LazyTensorStorage(8), Transition()
    with_unit = ReplayBuffer(storage=storage, sample_unit=unit)
    ReplayBuffer(storage=storage)
    ReplayBuffer(storage=storage, sample_unit=Transition())
    assert buffers_sampling_by(unit, storage) == [with_unit]
    assert buffers_sampling_by(unit, LazyTensorStorage(8)) == []


def test_what_a_slice_sampler_cuts_by():
    key = ("collector", "traj_ids")
    assert cuts_by(SliceSampler(slice_len=2), key)
    assert cuts_by(SliceSampler(slice_len=2, traj_key=key), key)
    assert not cuts_by(SliceSampler(slice_len=2, traj_key="episode"), key)
    assert not cuts_by(SliceSampler(slice_len=2, end_key=("next", "done")), key)
    # found by itself, before the end of an episode and before "episode"
    data = TensorDict(episode=torch.zeros(8), batch_size=[8])
    data[key] = torch.arange(8) // 2
    data["next", "done"] = torch.zeros(8, 1, dtype=torch.bool)
    buffer = ReplayBuffer(storage=LazyTensorStorage(8), sampler=SliceSampler(slice_len=2), batch_size=8)
    buffer.extend(data)
    assert (buffer.sample()[key].reshape(-1, 2).diff() == 0).all()


def test_a_buffer_samples_by_its_own_method():
    class Spy(TensorDictReplayBuffer):
        def _sample(self, batch_size):
            data, info = super()._sample(batch_size)
            return data.set("seen", torch.ones(batch_size)), info

    for prefetch in (None, 1):
        buffer = Spy(storage=LazyTensorStorage(8), batch_size=2, prefetch=prefetch)
        buffer.extend(TensorDict(episode=torch.zeros(8), batch_size=[8]))
        assert all("seen" in buffer.sample().keys() for _ in range(3))  # noqa: SIM118


def test_the_inverse_of_a_transform_in_a_buffer_is_its_inverse_call():
    class Spy(Transform):
        def _inv_call(self, tensordict):
            return tensordict.set("seen", torch.ones(tensordict.batch_size))

    for kind in (ReplayBuffer, TensorDictReplayBuffer):
        buffer = kind(storage=LazyTensorStorage(8), transform=Spy())
        buffer.extend(TensorDict(episode=torch.zeros(8), batch_size=[8]))
        assert "seen" in buffer[:].keys()  # noqa: SIM118


def test_what_a_wrapper_of_another_library_wraps():
    inner = suite.load("cartpole", "swingup")
    assert wrapped_env(DMControlWrapper(inner)) is inner
    own = make_env("cartpole", num_envs=2, num_threads=1)
    assert wrapped_env(own) is own


def test_gymnasium_wrappers_are_inside_the_environment():
    gym = pytest.importorskip("gymnasium")
    inner = gym.make("CartPole-v1")
    outer = gym.wrappers.NormalizeObservation(inner)
    assert wrappers_of(GymWrapper(outer))[:2] == [outer, inner]
    assert wrappers_of(make_env("cartpole", num_envs=1, num_threads=1)) == []
