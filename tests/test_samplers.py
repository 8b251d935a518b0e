"""Copies with prioritized samplers, where each row has one priority, and with samplers of slices."""

import pytest
import torch
from tensordict import TensorDictBase
from torchrl.data import (
    LazyTensorStorage,
    PrioritizedSampler,
    ReplayBuffer,
    SliceSampler,
    TensorDictPrioritizedReplayBuffer,
    TensorDictReplayBuffer,
)

from tests.buffers import (
    DRAWN,
    ROWS,
    SLICE,
    ToldSampler,
    assert_orbits,
    assert_slices,
    elements_of,
    every_slicer,
    filled,
    numbers,
    rows,
    symmetric,
    trajectories,
    with_orbit,
)
from tests.networks import make_symmetry
from torchrl_sym import SymmetryAugment
from torchrl_sym.augment import TRAJECTORY

try:
    import torchrl._torchrl  # noqa: F401
except ImportError as error:
    NO_EXTENSION = f"torchrl's compiled extension does not load: {error}"
else:
    NO_EXTENSION = ""

compiled = pytest.mark.skipif(bool(NO_EXTENSION), reason=NO_EXTENSION[:60])

# --- priorities: the largest of each row, over its copies and whatever their order


def largest(index: list, error: torch.Tensor) -> dict:
    """By hand: the largest error of each index."""
    out: dict = {}
    for row, value in zip(index, error.tolist(), strict=True):
        row = tuple(row) if isinstance(row, list) else row
        out[row] = max(value, out.get(row, 0.0))
    return out


def told(**settings) -> tuple[ToldSampler, TensorDictBase]:
    """A sampler, and a batch of its buffer with random errors."""
    sampler = ToldSampler()
    buffer = symmetric(sampler=sampler, group="K4", **settings)
    batch = buffer.sample()
    batch["td_error"] = torch.rand(len(batch), 1)
    sampler.buffer = buffer
    return sampler, batch


ORDERS = {
    "as sampled": lambda batch: batch,
    "shuffled": lambda batch: batch[torch.randperm(len(batch))],
    "some rows": lambda batch: batch[torch.randperm(len(batch))[:7]],
    "one row": lambda batch: batch[3:4],
    "by element": lambda batch: batch.reshape(4, -1),
    "by anchor": lambda batch: batch.reshape(4, -1).transpose(0, 1),
}


@pytest.mark.parametrize("ndim", [1, 2])
@pytest.mark.parametrize("order", ORDERS.values(), ids=ORDERS)
def test_the_standard_update_keeps_the_largest(order, ndim):
    grid = {"batch": rows(4, 6), "storage": LazyTensorStorage(ROWS, ndim=2)} if ndim == 2 else {}
    sampler, batch = told(**grid)
    batch = order(batch)
    sampler.buffer.update_tensordict_priority(batch)
    index = batch["index"].reshape(-1, 2) if ndim == 2 else batch["index"].flatten()
    expected = largest(index.tolist(), batch["td_error"].flatten())
    assert sampler.last() == expected and len(expected) > 0


@pytest.mark.parametrize("shape", ["(B,)", "(B, 1)"])
@pytest.mark.parametrize("ndim", [1, 2])
def test_update_priority_keeps_the_largest(ndim, shape):
    grid = {"batch": rows(4, 6), "storage": LazyTensorStorage(ROWS, ndim=2)} if ndim == 2 else {}
    sampler, batch = told(**grid)
    index, error = batch["index"], batch["td_error"] if shape == "(B, 1)" else batch["td_error"][:, 0]
    expected = largest(index.tolist(), batch["td_error"].flatten())
    for given in (index, index.unbind(-1)) if ndim == 2 else (index, index.unsqueeze(-1)):
        sampler.buffer.update_priority(given, error)
        found = {
            row[0] if isinstance(row, tuple) and len(row) == 1 else row: value
            for row, value in sampler.last().items()
        }
        assert found == expected


def test_one_priority_for_all_and_for_one():
    sampler, batch = told()
    sampler.buffer.update_priority(batch["index"], 2.5)
    assert sampler.told[-1][1].item() == 2.5
    sampler.buffer.update_priority(3, 1.5)
    assert (sampler.told[-1][0].item(), sampler.told[-1][1].item()) == (3, 1.5)


@pytest.mark.parametrize("reduction", ["max", "mean"])
@pytest.mark.parametrize(
    "order", [lambda b: b, lambda b: b.reshape(2, DRAWN, 3)], ids=["rows", "by element"]
)
def test_errors_of_a_stored_sequence_are_reduced_as_the_sampler_says(reduction, order):
    sampler = ToldSampler(reduction)
    buffer = symmetric(rows(8, 3), sampler=sampler)
    batch = buffer.sample()
    batch["td_error"] = torch.rand(*batch.shape, 1)
    buffer.update_tensordict_priority(order(batch))
    error = getattr(batch["td_error"].flatten(1), reduction)(1)
    expected = largest(batch["index"][:, 0].tolist(), error if reduction == "mean" else error.values)
    assert sampler.last() == pytest.approx(expected)


@pytest.mark.parametrize("shape, ndim", [((ROWS,), 1), ((4, 6), 2), ((2, 3, 4), 3)], ids=str)
@pytest.mark.parametrize("trailing", [(), (1,)], ids=["", "trailing one"])
def test_errors_that_are_stored_reach_the_sampler_as_without_copies(shape, ndim, trailing):
    found = []
    for buffer in (symmetric, lambda data, **settings: filled(TensorDictReplayBuffer, data, **settings)):
        sampler = ToldSampler()
        data = rows(*shape).set("td_error", torch.arange(ROWS).float().reshape(*shape, *trailing))
        buffer(data, sampler=sampler, storage=LazyTensorStorage(ROWS, ndim=ndim))
        found.append(sampler.last())
    assert found[0] == found[1] and len(found[0]) == ROWS


def test_weights_of_anchors_are_those_of_their_copies():
    _, batch = told()
    assert torch.equal(batch["priority_weight"], 1.0 + batch["index"].float())


def test_stored_copies_have_priorities_of_their_own():
    sampler, batch = told(when="extend", storage=LazyTensorStorage(4 * ROWS))
    sampler.buffer.update_tensordict_priority(batch)
    assert sampler.last() == largest(batch["index"].tolist(), batch["td_error"].flatten())
    assert elements_of(batch, "K4").unique().numel() > 1


@pytest.mark.parametrize("buffer", [ReplayBuffer, TensorDictReplayBuffer])
@pytest.mark.parametrize("elements", ["all", "random"])
def test_an_orbit_in_a_buffer_that_would_keep_the_last_priority_is_refused(buffer, elements):
    out = filled(buffer, sampler=ToldSampler(), **with_orbit(elements=elements))
    with pytest.raises(RuntimeError, match=r"last copy; use SymmetryReplayBuffer\(symmetry, sampler="):
        out.sample()


@pytest.mark.parametrize("sync", [True, False])
def test_an_orbit_in_torchrls_prioritized_buffer_is_refused(sync, monkeypatch):
    monkeypatch.setattr(PrioritizedSampler, "_init", ToldSampler._init)
    monkeypatch.setattr(PrioritizedSampler, "sample", ToldSampler.sample)
    monkeypatch.setattr(PrioritizedSampler, "mark_update", ToldSampler.mark_update)
    out = filled(TensorDictPrioritizedReplayBuffer, alpha=0.7, beta=0.5, sync=sync, **with_orbit())
    with pytest.raises(RuntimeError, match=r"TensorDictPrioritizedReplayBuffer would keep the priority"):
        out.sample()


def test_stacked_copies_share_the_largest_priority():
    sampler = ToldSampler()
    stack = SymmetryAugment(make_symmetry("K4"), layout="stack")
    buffer = filled(TensorDictReplayBuffer, sampler=sampler, transform=stack)
    batch = buffer.sample(3)
    batch["td_error"] = torch.rand(3, 4, 1)
    buffer.update_tensordict_priority(batch)
    assert torch.equal(sampler.told[-1][1], batch["td_error"].flatten(1).amax(1))


@compiled
def test_torchrls_prioritized_sampler():
    sampler = PrioritizedSampler(ROWS, alpha=1.0, beta=1.0, eps=0.0)
    buffer = symmetric(group="K4", sampler=sampler, batch_size=256)
    buffer.update_priority(torch.arange(ROWS), torch.full((ROWS,), 1e-6))
    buffer.update_priority(torch.tensor([3, 5, 3, 5]), torch.tensor([100.0, 1e-6, 1e-6, 100.0]))
    batch = buffer.sample()
    assert_orbits(batch.split(256), "K4")
    assert set(numbers(batch).tolist()) == {3, 5}
    original, *mirrored = batch["priority_weight"].split(256)
    assert all(torch.equal(original, weight) for weight in mirrored)


# --- slices of trajectories: whole, consecutive, under one element

HOW = {
    "augment": lambda slicer, **settings: filled(
        ReplayBuffer,
        trajectories(12, 12),
        sampler=slicer,
        transform=SymmetryAugment(make_symmetry("K4"), **settings),
    ),
    "orbit": lambda slicer, elements="all": filled(
        TensorDictReplayBuffer, trajectories(12, 12), sampler=slicer, **with_orbit("K4", elements)
    ),
    "buffer": lambda slicer, **settings: symmetric(
        trajectories(12, 12), sampler=slicer, group="K4", **settings
    ),
}


@every_slicer
@pytest.mark.parametrize("make", HOW.values(), ids=HOW)
def test_sampled_slices_stay_whole(slicer, make):
    buffer = make(slicer(slice_len=SLICE))
    for _ in range(3):
        batch = buffer.sample()
        assert_slices(batch, "K4")
        assert_orbits(batch.split(DRAWN), "K4")


@every_slicer
@pytest.mark.parametrize("make", HOW.values(), ids=HOW)
def test_a_slice_draws_one_element(slicer, make):
    torch.manual_seed(0)
    buffer, found = make(slicer(slice_len=SLICE), elements="random"), set()
    for _ in range(20):
        batch = buffer.sample()
        assert len(batch) == DRAWN
        assert_slices(batch, "K4")
        found |= {tuple(pair) for pair in elements_of(batch, "K4")[::SLICE][None].tolist()}
    assert len(found) > 6  # of 16 pairs of elements


def test_slices_draw_independently():
    torch.manual_seed(0)
    sampler = SliceSampler(slice_len=SLICE)
    buffer = symmetric(trajectories(12, 12), "K4", sampler=sampler, elements="random", batch_size=1600)
    element = buffer.sample()["symmetry_id"][::SLICE]
    assert abs((element.diff() == 0).float().mean() - 0.25) < 0.1  # 0.022 is its standard deviation


@every_slicer
@pytest.mark.parametrize("make", [HOW["orbit"], HOW["buffer"]], ids=["orbit", "buffer"])
def test_ends_of_slices_are_marked_in_every_copy(slicer, make):
    batch = make(slicer(slice_len=SLICE)).sample()
    ends = batch["next", "truncated"].reshape(-1, SLICE)
    assert ends[:, -1].all() and not ends[:, :-1].any()


def test_slices_without_trajectory_ids_draw_one_element():
    torch.manual_seed(0)
    sampler = SliceSampler(slice_len=SLICE, end_key=("next", "done"), truncated_key=None)
    buffer = symmetric(trajectories(12, 12, ids=False), "K4", sampler=sampler, elements="random")
    for _ in range(20):
        assert_slices(buffer.sample(), "K4")


def test_slices_of_lanes_draw_one_element():
    torch.manual_seed(0)
    data = trajectories(6, 6, 6, 6).reshape(4, 6)
    storage, sampler = LazyTensorStorage(ROWS, ndim=2), SliceSampler(slice_len=SLICE)
    buffer = symmetric(data, "K4", storage=storage, sampler=sampler, elements="random")
    for _ in range(20):
        assert_slices(buffer.sample(), "K4")


def test_slices_across_the_end_of_a_full_storage_draw_one_element():
    torch.manual_seed(0)
    buffer = symmetric(trajectories(24), "K4", sampler=SliceSampler(slice_len=SLICE), elements="random")
    buffer.extend(trajectories(24)[:10])  # rows 10 to 23 are the older ones, then 0 to 9
    for _ in range(40):
        batch = buffer.sample()
        for piece in batch.reshape(-1, SLICE):
            assert ((piece["index"].flatten().diff() % ROWS) == 1).all()
            assert elements_of(piece, "K4").unique().numel() == 1


def test_padded_slices_draw_one_element():
    torch.manual_seed(0)
    sampler = SliceSampler(slice_len=SLICE, strict_length=False, pad_output=True)
    buffer = symmetric(trajectories(2, 3, 2, 3, 14), "K4", sampler=sampler, elements="random")
    for _ in range(20):
        for piece in buffer.sample().reshape(-1, SLICE):
            assert elements_of(piece, "K4").unique().numel() == 1


def test_slices_in_fragments_are_refused_with_random_elements():
    data = trajectories(12, 12).set("step_count", torch.arange(12).repeat(2)[:, None])
    sampler = SliceSampler(slice_len=SLICE, fragmented=True)
    settings = {"sampler": sampler, "storage": LazyTensorStorage(ROWS)}
    symmetric(data, **settings).sample()
    with pytest.raises(RuntimeError, match=r"need not do with fragmented=True; use elements='all'"):
        symmetric(data, elements="random", **settings | {"storage": LazyTensorStorage(ROWS)}).sample()


@every_slicer
@pytest.mark.parametrize("elements", ["all", "random"])
@pytest.mark.parametrize("lengths", [(24,), (12, 12)], ids=str)
@pytest.mark.parametrize("how", ["augment", "buffer"])
def test_slices_of_stored_copies_never_run_into_the_next_copy(how, slicer, elements, lengths):
    torch.manual_seed(0)
    settings = {
        "storage": LazyTensorStorage(4 * ROWS),
        "sampler": slicer(slice_len=SLICE),
        "batch_size": 16,
    }
    augment = SymmetryAugment(make_symmetry("K4"), when="extend", elements=elements)
    if how == "augment":
        out = filled(TensorDictReplayBuffer, trajectories(*lengths), transform=augment, **settings)
    else:
        out = symmetric(trajectories(*lengths), "K4", when="extend", elements=elements, **settings)
    for _ in range(8):
        assert_slices(out.sample(), "K4")


def test_a_trajectory_that_is_stored_in_parts_is_not_mapped_by_two_elements():
    torch.manual_seed(0)
    buffer = symmetric(
        trajectories(12, 12)[:6],
        "K4",
        when="extend",
        elements="random",
        sampler=SliceSampler(slice_len=SLICE),
    )
    for start in (6, 12, 18):
        buffer.extend(trajectories(12, 12)[start : start + 6])
    assert buffer[:][TRAJECTORY].unique().numel() > 2
    for _ in range(20):
        assert_slices(buffer.sample(), "K4")


def test_torchrl_refuses_stacked_slices_in_a_tensordict_buffer():
    stack = SymmetryAugment(make_symmetry("K4"), layout="stack")
    sampler = SliceSampler(slice_len=SLICE)
    with pytest.raises(RuntimeError, match="one of the transforms has probably modified the shape"):
        filled(TensorDictReplayBuffer, trajectories(12, 12), sampler=sampler, transform=stack).sample()
