"""Copies in the buffers of TorchRL: by SymmetryAugment when sampling and extending, by SymmetryOrbit."""

import pytest
import torch
from torchrl.data import (
    LazyMemmapStorage,
    LazyTensorStorage,
    ListStorage,
    ReplayBuffer,
    SamplerWithoutReplacement,
    TensorDictReplayBuffer,
)
from torchrl.envs import Compose, RenameTransform

from tests.buffers import (
    DRAWN,
    ROWS,
    assert_images,
    assert_orbits,
    buffers,
    elements_of,
    filled,
    numbers,
    rows,
    with_orbit,
)
from tests.networks import make_actor, make_symmetry
from torchrl_sym import SymmetryAugment, SymmetryOrbit

SETTINGS = {
    "plain": dict,
    "prefetch": lambda: {"prefetch": 2},
    "without replacement": lambda: {"sampler": SamplerWithoutReplacement()},
}

# --- when sampling, in a plain ReplayBuffer


@pytest.mark.parametrize("group", ["C1", "C2", "K4", "C3"])
@pytest.mark.parametrize("settings", SETTINGS.values(), ids=SETTINGS)
def test_sample_adds_the_copies(group, settings):
    buffer = filled(ReplayBuffer, transform=SymmetryAugment(make_symmetry(group)), **settings())
    for _ in range(3):
        assert_orbits(buffer.sample().split(DRAWN), group)


@pytest.mark.parametrize("storage", [LazyTensorStorage, LazyMemmapStorage, ListStorage])
def test_every_storage(storage):
    buffer = filled(ReplayBuffer, storage=storage(ROWS), transform=SymmetryAugment(make_symmetry()))
    assert_orbits(buffer.sample().split(DRAWN))


def test_stacked_copies_keep_the_number_of_records():
    buffer = filled(ReplayBuffer, transform=SymmetryAugment(make_symmetry("K4"), layout="stack"))
    assert buffer.sample().batch_size == (DRAWN, 4)
    assert_orbits(buffer.sample().unbind(-1), "K4")


def test_info_is_about_the_anchors():
    buffer = filled(ReplayBuffer, transform=SymmetryAugment(make_symmetry()))
    batch, info = buffer.sample(return_info=True)
    assert torch.equal(numbers(batch), info["index"].repeat(2))


@pytest.mark.parametrize("layout", ["cat", "stack"])
def test_multidimensional_storage(layout):
    augment = SymmetryAugment(make_symmetry(), layout=layout)
    buffer = filled(ReplayBuffer, rows(4, 6), storage=LazyTensorStorage(ROWS, ndim=2), transform=augment)
    batch = buffer.sample()
    for g, block in enumerate(batch.split(DRAWN) if layout == "cat" else batch.unbind(-1)):
        expected = make_symmetry()(rows(4, 6).reshape(-1)[numbers(block)], g)
        assert torch.equal(block["observation"], expected["observation"])


def test_an_epoch_visits_every_row_once_in_each_copy():
    augment = SymmetryAugment(make_symmetry())
    buffer = filled(ReplayBuffer, sampler=SamplerWithoutReplacement(), transform=augment)
    batches = list(buffer)
    assert [len(batch) for batch in batches] == [2 * DRAWN] * (ROWS // DRAWN)
    for block in zip(*(batch.split(DRAWN) for batch in batches), strict=True):
        assert torch.cat([numbers(part) for part in block]).sort().values.tolist() == list(range(ROWS))


def test_single_records_pass_through_and_slices_are_augmented():
    buffer = filled(ReplayBuffer, transform=SymmetryAugment(make_symmetry()))
    assert torch.equal(buffer[3]["observation"], rows()[3]["observation"])
    assert_orbits(buffer[:].split(ROWS))


def test_works_in_a_compose():
    augment = SymmetryAugment(make_symmetry())
    rename = RenameTransform(["advantage"], ["state_value"], create_copy=True)
    buffer = filled(ReplayBuffer, transform=Compose(Compose(Compose(augment)), rename))
    batch = buffer.sample()
    assert len(batch) == 2 * DRAWN and torch.equal(batch["advantage"], batch["state_value"])


# --- when extending


@buffers
@pytest.mark.parametrize("group", ["C2", "K4", "C3"])
def test_extend_stores_the_copies(buffer, group):
    augment = SymmetryAugment(make_symmetry(group), when="extend")
    n = len(augment.elements)
    out = filled(buffer, storage=LazyTensorStorage(n * ROWS), transform=augment)
    assert len(out) == n * ROWS
    assert_orbits(out[:].select(*rows().keys()).split(ROWS), group)


def test_stored_copies_are_sampled_independently():
    augment = SymmetryAugment(make_symmetry(), when="extend")
    sampler = SamplerWithoutReplacement()
    buffer = filled(ReplayBuffer, storage=LazyTensorStorage(2 * ROWS), sampler=sampler, transform=augment)
    epoch = torch.cat(list(buffer))
    assert numbers(epoch).bincount().tolist() == [2] * ROWS
    assert (numbers(epoch)[:ROWS].bincount(minlength=ROWS) == 1).any()


@pytest.mark.parametrize(
    "layout, ndim, shape",
    [("cat", 2, (8, 6)), ("stack", 1, (4, 6, 2)), ("stack", 2, (4, 6, 2))],
)
def test_extending_fills_a_storage_of_exactly_the_right_size(layout, ndim, shape):
    augment = SymmetryAugment(make_symmetry(), layout=layout, when="extend")
    storage = LazyTensorStorage(torch.Size(shape[:ndim]).numel(), ndim=ndim)
    buffer = filled(ReplayBuffer, rows(4, 6), storage=storage, transform=augment)
    stored = SymmetryAugment(make_symmetry(), layout=layout)(rows(4, 6))
    assert torch.equal(buffer[:]["observation"], stored["observation"])


def test_add_stores_one_record_of_all_copies():
    # TorchRL's add hands over a batch of one row, warns, and stores what comes of it as one record
    augment = SymmetryAugment(make_symmetry("K4"), when="extend")
    out = ReplayBuffer(storage=LazyTensorStorage(ROWS), transform=augment, batch_size=DRAWN)
    with pytest.warns(UserWarning, match="Use `extend\\(\\)`"):
        out.add(rows()[0])
    assert_orbits(out.sample().unbind(-1), "K4")


def test_add_is_refused_where_it_hands_over_a_single_row():
    augment = SymmetryAugment(make_symmetry(), when="extend")
    out = TensorDictReplayBuffer(storage=LazyTensorStorage(ROWS), transform=augment)
    with pytest.raises(RuntimeError, match=r"single row has no place .* use buffer.extend"):
        out.add(rows()[0])
    out.extend(rows()[:1])
    assert len(out) == 2


@buffers
def test_add_works_when_copies_are_made_by_sampling(buffer):
    augment = SymmetryAugment(make_symmetry(), layout="stack")
    out = buffer(storage=LazyTensorStorage(ROWS), batch_size=2, transform=augment)
    out.add(rows()[0])
    assert_orbits(out.sample().select(*rows().keys()).unbind(-1))


# --- the naive rule


def test_log_prob_from_works_when_extending():
    actor = make_actor()
    augment = SymmetryAugment(make_symmetry(), when="extend", log_prob_from=actor)
    copies = filled(ReplayBuffer, storage=LazyTensorStorage(2 * ROWS), transform=augment)[:][ROWS:]
    expected = actor.get_dist(copies.select("observation")).log_prob(copies["action"])
    torch.testing.assert_close(copies["action_log_prob"], expected)


# --- TensorDictReplayBuffer, which fixes the number of records


def test_torchrl_refuses_cat_where_records_are_fixed():
    buffer = filled(TensorDictReplayBuffer, transform=SymmetryAugment(make_symmetry()))
    with pytest.raises(RuntimeError, match=r"one of the transforms has probably modified the shape"):
        buffer.sample()


def test_stacked_copies_share_their_index():
    buffer = filled(TensorDictReplayBuffer, transform=SymmetryAugment(make_symmetry(), layout="stack"))
    batch = buffer.sample()
    assert torch.equal(batch["index"], numbers(batch))
    assert_orbits(batch.select(*rows().keys()).unbind(-1))


@buffers
def test_random_elements_keep_the_number_of_records(buffer):
    torch.manual_seed(0)
    batch = filled(buffer, transform=SymmetryAugment(make_symmetry(), elements="random")).sample()
    flipped = batch["observation"][:, 1] != rows()[numbers(batch)]["observation"][:, 1]
    assert len(batch) == DRAWN and 0 < flipped.sum() < DRAWN
    assert_images(batch[~flipped], "C2", 0)
    assert_images(batch[flipped], "C2", 1)


# --- SymmetryOrbit, by hand


@buffers
@pytest.mark.parametrize("group", ["C1", "C2", "K4", "C3"])
@pytest.mark.parametrize("settings", SETTINGS.values(), ids=SETTINGS)
def test_orbit_adds_the_copies(buffer, group, settings):
    out = filled(buffer, **settings(), **with_orbit(group))
    for _ in range(2):
        batch, info = out.sample(return_info=True)
        assert torch.equal(info["index"], numbers(batch))
        assert torch.equal(info["symmetry_id"], torch.arange(len(batch) // DRAWN).repeat_interleave(DRAWN))
        assert_orbits(batch.select(*rows().keys()).split(DRAWN), group)


def test_orbit_writes_index_and_element_into_every_record():
    batch = filled(TensorDictReplayBuffer, **with_orbit("K4", ["rot-180"])).sample()
    assert torch.equal(batch["index"], numbers(batch))
    assert batch["symmetry_id"].tolist() == [0] * DRAWN + [3] * DRAWN
    assert_images(batch[DRAWN:], "K4", 3)


@buffers
def test_orbit_in_a_multidimensional_storage(buffer):
    out = filled(buffer, rows(4, 6), storage=LazyTensorStorage(ROWS, ndim=2), **with_orbit())
    original, mirrored = out.sample().select(*rows().keys()).split(DRAWN)
    assert torch.equal(numbers(original), numbers(mirrored))
    assert torch.equal(mirrored["observation"], make_symmetry()(original, 1)["observation"])


@buffers
def test_orbit_with_random_elements(buffer):
    torch.manual_seed(0)
    out = filled(buffer, **with_orbit("K4", "random"))
    batch, info = out.sample(return_info=True)
    assert len(batch) == DRAWN
    assert torch.equal(elements_of(batch, "K4"), info["symmetry_id"])
    assert info["symmetry_id"].unique().numel() > 1


@buffers
def test_rows_are_read_by_index_as_stored(buffer):
    out = filled(buffer, **with_orbit())
    out.sample()
    for index in (3, slice(None), slice(4, 8), torch.tensor([5, 1])):
        assert torch.equal(out[index]["observation"], rows()[index]["observation"])
    assert_orbits(out.sample().split(DRAWN))


def test_buffers_that_share_storage_and_orbit():
    pair, storage = with_orbit(), LazyTensorStorage(ROWS)
    first = filled(ReplayBuffer, storage=storage, **pair)
    other = {"sample_unit": pair["sample_unit"], "transform": pair["sample_unit"].transform()}
    second = ReplayBuffer(storage=storage, batch_size=DRAWN, **other)
    plain = ReplayBuffer(storage=storage, batch_size=DRAWN)
    for buffer in (first, second, first):
        assert_orbits(buffer.sample().split(DRAWN))
    assert_orbits([plain.sample()], "C1")


@buffers
@pytest.mark.parametrize("others", [None, lambda: with_orbit("C3")["transform"]], ids=["none", "another's"])
def test_an_orbit_without_its_transform_is_refused(buffer, others):
    out = filled(buffer, **with_orbit() | {"transform": others and others()})
    found = "that of another orbit" if others else "none"
    with pytest.raises(RuntimeError, match=f"own transform in the buffer, got {found}; .*orbit.transform"):
        out.sample()


@buffers
def test_a_transform_without_its_orbit_is_refused(buffer):
    out = filled(buffer, batch_size=5, transform=SymmetryOrbit(make_symmetry()).transform())
    with pytest.raises(RuntimeError, match=r"as they are stored; pass that orbit .* sample_unit=orbit"):
        out.sample()


def test_a_transform_that_changes_the_number_of_rows_is_refused():
    pair = with_orbit()
    pair["transform"] = Compose(lambda td: td[:5], pair["transform"])
    with pytest.raises(RuntimeError, match=r"expected the 16 rows that were sampled, got 5.*put it behind"):
        filled(ReplayBuffer, **pair).sample()


def test_an_orbit_in_a_storage_that_was_set_later_is_refused():
    out = filled(ReplayBuffer, **with_orbit())
    out.set_storage(LazyTensorStorage(ROWS))
    out.writer.register_storage(out.storage)
    out.extend(rows())
    with pytest.raises(RuntimeError, match=r"one storage from the start.* use one SymmetryReplayBuffer"):
        out.sample()
    out.storage.attach(out)
    assert_orbits(out.sample().split(DRAWN))


def test_the_batch_must_have_what_the_symmetry_declares():
    with pytest.raises(KeyError, match=r"the batch lacks \['action'\]"):
        filled(ReplayBuffer, rows().exclude("action"), **with_orbit()).sample()
