"""Augmentation with prioritized samplers and with samplers of slices of trajectories."""

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import (
    LazyTensorStorage,
    PrioritizedSampler,
    ReplayBuffer,
    SliceSampler,
    SliceSamplerWithoutReplacement,
    TensorDictPrioritizedReplayBuffer,
    TensorDictReplayBuffer,
)

from tests.buffers import DRAWN, ROWS, assert_orbits, buffers, filled, numbers, rows, with_orbit
from tests.networks import make_symmetry
from torchrl_sym import SymmetryAugment, SymmetryOrbit

try:
    import torchrl._torchrl  # noqa: F401
except ImportError as error:
    NO_EXTENSION = f"torchrl's compiled extension does not load: {error}"
else:
    NO_EXTENSION = ""

prioritized = pytest.mark.skipif(bool(NO_EXTENSION), reason=NO_EXTENSION)


def trajectories(*lengths: int, ids: bool = True) -> TensorDict:
    """Unfinished trajectories of these lengths, one after the other."""
    batch = rows(sum(lengths))
    batch["next", "done"] = torch.zeros(sum(lengths), 1, dtype=torch.bool)
    if ids:
        batch["collector", "traj_ids"] = torch.arange(len(lengths)).repeat_interleave(torch.tensor(lengths))
    return batch


# --- prioritized sampling


def priorities() -> torch.Tensor:
    return torch.linspace(0, 1, ROWS) ** 4


@prioritized
def test_prioritized_sampler_weighs_the_anchors():
    sampler = PrioritizedSampler(ROWS, alpha=0.7, beta=0.5)
    buffer = filled(ReplayBuffer, sampler=sampler, transform=SymmetryAugment(make_symmetry()))
    buffer.update_priority(torch.arange(ROWS), priorities())
    batch, info = buffer.sample(return_info=True)
    assert_orbits(batch.split(DRAWN))
    assert info["priority_weight"].shape == (DRAWN,)


@prioritized
def test_prioritized_buffer_refuses_cat():
    augment = SymmetryAugment(make_symmetry())
    buffer = filled(TensorDictPrioritizedReplayBuffer, alpha=0.7, beta=0.5, transform=augment)
    with pytest.raises(RuntimeError, match="TensorDictPrioritizedReplayBuffer fixes the number of records"):
        buffer.sample()


@prioritized
@pytest.mark.parametrize("how", ["stack", "orbit"])
def test_copies_share_weight_and_priority(how):
    stack = {"transform": SymmetryAugment(make_symmetry(), layout="stack")}
    settings = stack if how == "stack" else with_orbit()
    buffer = filled(TensorDictPrioritizedReplayBuffer, alpha=0.7, beta=0.5, **settings)
    buffer.update_priority(torch.arange(ROWS), priorities())
    batch = buffer.sample()
    original, mirrored = batch.unbind(-1) if how == "stack" else batch.split(DRAWN)
    assert torch.equal(original["priority_weight"], mirrored["priority_weight"])
    assert original["priority_weight"].unique().numel() > 1
    batch["td_error"] = torch.full(batch.batch_size, 1e12)
    buffer.update_tensordict_priority(batch)
    assert set(numbers(buffer.sample()).flatten().tolist()) <= set(numbers(original).tolist())


@prioritized
def test_folded_priorities_are_the_largest_of_each_anchor():
    orbit = SymmetryOrbit(make_symmetry())
    settings = {"sample_unit": orbit, "transform": orbit.transform()}
    buffer = filled(TensorDictPrioritizedReplayBuffer, alpha=1, beta=1, eps=0, batch_size=256, **settings)
    buffer.update_priority(torch.arange(ROWS), torch.full((ROWS,), 1e-6))
    buffer.update_priority(torch.tensor([3, 5]), orbit.fold(torch.tensor([100.0, 1e-6, 1e-6, 100.0])))
    assert set(numbers(buffer.sample()).tolist()) == {3, 5}


# --- slices of trajectories


def assert_slices(batch: TensorDictBase, length: int = 4) -> None:
    """Every slice has consecutive rows of one trajectory."""
    for piece in batch.reshape(-1, length):
        assert (numbers(piece).diff() == 1).all()
        assert piece["collector", "traj_ids"].unique().numel() == 1


every_slicer = pytest.mark.parametrize("slicer", [SliceSampler, SliceSamplerWithoutReplacement])
HOW = {"transform": lambda: {"transform": SymmetryAugment(make_symmetry())}, "orbit": with_orbit}


@every_slicer
@pytest.mark.parametrize("how", HOW.values(), ids=HOW)
def test_sampled_slices_stay_whole(slicer, how):
    buffer = filled(ReplayBuffer, trajectories(12, 12), sampler=slicer(slice_len=4), **how())
    for _ in range(3):
        batch = buffer.sample()
        assert_slices(batch)
        assert_orbits(batch.split(DRAWN))


@every_slicer
@buffers
@pytest.mark.parametrize("lengths", [(24,), (12, 12)], ids=str)
def test_slices_of_stored_copies_never_run_into_the_next_copy(buffer, slicer, lengths):
    augment = SymmetryAugment(make_symmetry("K4"), when="extend")
    settings = {"storage": LazyTensorStorage(4 * ROWS), "sampler": slicer(slice_len=4), "batch_size": 16}
    out = filled(buffer, trajectories(*lengths), transform=augment, **settings)
    for _ in range(20):
        assert_slices(out.sample())


@pytest.mark.parametrize("settings", [{}, {"end_key": ("next", "done")}, {"traj_key": "done"}], ids=str)
def test_stored_copies_need_trajectory_ids_to_be_sliced(settings):
    augment = SymmetryAugment(make_symmetry(), when="extend")
    sampler = SliceSampler(slice_len=4, **settings)
    out = ReplayBuffer(storage=LazyTensorStorage(2 * ROWS), sampler=sampler, transform=augment)
    with pytest.raises(RuntimeError, match=r"run from one symmetric copy into the next.*use when='sample'"):
        out.extend(trajectories(24, ids=bool(settings)))


def test_slices_in_a_tensordict_buffer_need_the_orbit():
    def make(**settings):
        sampler = SliceSampler(slice_len=4)
        return filled(TensorDictReplayBuffer, trajectories(12, 12), sampler=sampler, **settings)

    assert_slices(make(**with_orbit()).sample())
    stack = SymmetryAugment(make_symmetry(), layout="stack")
    with pytest.raises(RuntimeError, match=r"its slices cannot be stacked.*SymmetryOrbit\(symmetry\)"):
        make(transform=stack).sample()
