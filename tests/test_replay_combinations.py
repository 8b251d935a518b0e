"""Every combination of buffer, sampler, storage, elements, layout and time: exactly right, or refused.

Rows are numbered and in general position, so that each row of a batch tells which row it is the image of,
and under which element. What TorchRL itself refuses without copies is left out.
"""

import itertools

import pytest
import torch
from tensordict import TensorDictBase
from torchrl.data import (
    LazyMemmapStorage,
    LazyTensorStorage,
    ListStorage,
    RandomSampler,
    ReplayBuffer,
    SamplerWithoutReplacement,
    SliceSampler,
    SliceSamplerWithoutReplacement,
    TensorDictReplayBuffer,
)

from tests.buffers import (
    DRAWN,
    ROWS,
    SLICE,
    ToldSampler,
    assert_slices,
    elements_of,
    filled,
    numbers,
    trajectories,
)
from tests.networks import make_symmetry
from torchrl_sym import SymmetryAugment, SymmetryReplayBuffer

N = 4
SAMPLERS = {
    "random": RandomSampler,
    "without replacement": SamplerWithoutReplacement,
    "slices": lambda: SliceSampler(slice_len=SLICE),
    "slices without replacement": lambda: SliceSamplerWithoutReplacement(slice_len=SLICE),
    "prioritized": ToldSampler,
}
STORAGES = {
    "tensor": LazyTensorStorage,
    "memmap": LazyMemmapStorage,
    "list": ListStorage,
    "lanes": lambda size: LazyTensorStorage(size, ndim=2),
}
POSSIBLE = [
    (sampler, storage)
    for sampler, storage in itertools.product(SAMPLERS, STORAGES)
    if not (storage == "list" and "slices" in sampler)
]

# What TorchRL refuses: other numbers of rows in a TensorDictReplayBuffer, records with a dimension more.
METADATA, DIMENSIONS = "Failed to set the metadata", "Expected the end-of-traj|batch dimension mismatch"


def stored(storage: str) -> TensorDictBase:
    return trajectories(6, 6, 6, 6).reshape(4, 6) if storage == "lanes" else trajectories(12, 12)


def refusal(buffer: type, sampler: str, storage: str, elements, layout: str, when: str) -> str:
    """What the refusal of a combination says, empty if it is right."""
    if elements == "random" or buffer is SymmetryReplayBuffer:
        return ""
    tensordicts, sliced = buffer is TensorDictReplayBuffer, "slices" in sampler
    if when == "extend":
        return DIMENSIONS if layout == "stack" and (sliced or (tensordicts and storage == "lanes")) else ""
    if not tensordicts:
        return ""
    return METADATA if layout == "cat" or sliced or storage == "lanes" else ""


def sampled(buffer: type, sampler: str, storage: str, elements, layout: str, when: str) -> TensorDictBase:
    symmetry = make_symmetry("K4")
    grows = when == "extend" and layout == "cat" and elements != "random"
    parts = {"sampler": SAMPLERS[sampler](), "storage": STORAGES[storage](ROWS * (N if grows else 1))}
    if buffer is SymmetryReplayBuffer:
        out = SymmetryReplayBuffer(symmetry, elements=elements, when=when, batch_size=DRAWN, **parts)
        out.extend(stored(storage))
    else:
        augment = SymmetryAugment(symmetry, elements=elements, when=when, layout=layout)
        out = filled(buffer, stored(storage), transform=augment, **parts)
    assert len(out) == ROWS * (N if grows else 1)
    return out.sample()


@pytest.mark.parametrize("sampler, storage", POSSIBLE, ids=str)
@pytest.mark.parametrize("buffer", [ReplayBuffer, TensorDictReplayBuffer, SymmetryReplayBuffer])
def test_right_or_refused(buffer, sampler, storage):
    torch.manual_seed(0)
    layouts = ["cat"] if buffer is SymmetryReplayBuffer else ["cat", "stack"]
    for elements, layout, when in itertools.product(["all", "random"], layouts, ["sample", "extend"]):
        combination = (buffer, sampler, storage, elements, layout, when)
        message = refusal(*combination)
        if message:
            with pytest.raises(RuntimeError, match=message):
                sampled(*combination)
            continue
        batch = sampled(*combination)
        element = elements_of(batch, "K4")  # fails unless every row is an image
        if elements == "random":
            assert batch.shape == (DRAWN,)
        elif layout == "stack":
            assert batch.shape == (DRAWN, N)
            assert (element == torch.arange(N)).all() and (numbers(batch) == numbers(batch)[:, :1]).all()
        elif when == "sample":
            assert batch.shape == (N * DRAWN,)
            assert torch.equal(element, torch.arange(N).repeat_interleave(DRAWN))
            assert torch.equal(numbers(batch), numbers(batch)[:DRAWN].repeat(N))
        else:
            assert batch.shape == (DRAWN,)
        if "slices" in sampler:
            for lane in batch.unbind(1) if layout == "stack" and elements == "all" else [batch]:
                assert_slices(lane, "K4")
        if buffer is SymmetryReplayBuffer and when == "sample":
            assert torch.equal(batch["symmetry_id"], element)
            index = batch["index"]
            if storage == "lanes":  # time first
                index = index[:, 1] * 6 + index[:, 0]
            assert torch.equal(index.flatten(), numbers(batch))


def test_every_kind_of_combination_is_met():
    everything = itertools.product(
        [ReplayBuffer, TensorDictReplayBuffer, SymmetryReplayBuffer],
        SAMPLERS,
        STORAGES,
        ["all", "random"],
        ["cat", "stack"],
        ["sample", "extend"],
    )
    assert {refusal(*combination) for combination in everything} == {"", METADATA, DIMENSIONS}
