"""SymmetryReplayBuffer: what a batch has, the order of transforms, what is refused, how it is saved."""

import copy
import pickle
import threading

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import (
    LazyMemmapStorage,
    LazyTensorStorage,
    ListStorage,
    ReplayBuffer,
    ReplayBufferEnsemble,
    SamplerWithoutReplacement,
    SliceSampler,
)
from torchrl.data.replay_buffers import SamplerEnsemble, Sequence
from torchrl.envs import Compose, RenameTransform, Transform

from tests.buffers import (
    DRAWN,
    ROWS,
    assert_images,
    assert_orbits,
    elements_of,
    numbers,
    rows,
    symmetric,
    trajectories,
)
from tests.networks import make_symmetry
from torchrl_sym import Symmetry, SymmetryAugment, SymmetryOrbit, SymmetryReplayBuffer
from torchrl_sym.augment import TRAJECTORY
from torchrl_sym.representations import invariant, pseudoscalar

# --- batches


@pytest.mark.parametrize("group", ["C1", "C2", "K4", "C3"])
def test_a_batch_has_the_copies_of_its_rows(group):
    buffer = symmetric(group=group)
    batch = buffer.sample()
    count = len(batch) // DRAWN
    assert torch.equal(batch["index"], numbers(batch))
    assert torch.equal(batch["symmetry_id"], torch.arange(count).repeat_interleave(DRAWN))
    assert_orbits(batch.split(DRAWN), group)


def test_named_elements_come_after_the_identity():
    batch = symmetric(group="K4", elements=["rot-180"]).sample()
    assert batch["symmetry_id"].tolist() == [0] * DRAWN + [3] * DRAWN
    assert_images(batch[DRAWN:], "K4", 3)


def test_random_elements_are_told():
    torch.manual_seed(0)
    buffer = symmetric(group="K4", elements="random")
    batches = [buffer.sample() for _ in range(50)]
    for batch in batches:
        assert len(batch) == DRAWN and torch.equal(elements_of(batch, "K4"), batch["symmetry_id"])
    count = torch.cat([batch["symmetry_id"] for batch in batches]).bincount(minlength=4)
    assert ((count - 100) ** 2 / 100).sum() < 16.3  # uniform: one in a thousand


def test_stored_sequences_are_mapped_by_one_element():
    torch.manual_seed(0)
    buffer = symmetric(rows(8, 3), elements="random", group="K4")
    batch = buffer.sample()
    assert batch.shape == (DRAWN, 3)
    assert torch.equal(elements_of(batch, "K4"), batch["symmetry_id"])
    assert (batch["symmetry_id"] == batch["symmetry_id"][:, :1]).all()


def test_an_epoch_visits_every_row_once_in_each_copy():
    batches = list(symmetric(sampler=SamplerWithoutReplacement()))
    assert [len(batch) for batch in batches] == [2 * DRAWN] * (ROWS // DRAWN)
    for block in zip(*(batch.split(DRAWN) for batch in batches), strict=True):
        assert torch.cat([numbers(part) for part in block]).sort().values.tolist() == list(range(ROWS))


def test_copies_are_trajectories_of_their_own():
    batch = symmetric(trajectories(12, 12), "K4", batch_size=64).sample()
    ids = [set(block[TRAJECTORY].tolist()) for block in batch.split(64)]
    assert len(set.union(*ids)) == sum(map(len, ids)) == 8


def test_rows_are_read_by_index_as_stored():
    buffer = symmetric()
    for _ in range(2):
        for index in (3, slice(None), slice(4, 8), torch.tensor([5, 1]), "observation"):
            found, expected = buffer[index], rows()[index]
            pair = (found, expected) if index == "observation" else (found["action"], expected["action"])
            assert torch.equal(*pair)
        assert_orbits(buffer.sample().split(DRAWN))


def test_prefetching_threads_and_the_main_one_do_not_disturb_each_other():
    buffer = symmetric(group="K4", prefetch=3)
    for start in range(ROWS - 4):
        assert_orbits(buffer.sample().split(DRAWN), "K4")
        assert_images(buffer[start : start + 4], "K4", 0)


def test_threads_sample_and_read_at_once():
    buffer, failures = symmetric(group="K4"), []

    def work(read: bool) -> None:
        try:
            for _ in range(10):
                if read:
                    assert_images(buffer[2:10], "K4", 0)
                else:
                    assert_orbits(buffer.sample().split(DRAWN), "K4")
        except BaseException as error:
            failures.append(error)

    threads = [threading.Thread(target=work, args=(read,)) for read in (True, False) * 2]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not failures


def test_a_sample_that_fails_leaves_nothing_behind():
    broken = []

    def collate(data):
        if broken:
            raise OSError("the disk is full")
        return data

    buffer = symmetric(collate_fn=collate)
    for read in (buffer.sample, lambda: buffer[4:8]):
        broken.append(True)
        with pytest.raises(OSError, match="disk is full"):
            read()
        broken.clear()
        with pytest.raises(RuntimeError, match="rows as they are stored"):
            buffer.transform[0](rows())
        assert_images(buffer[: 2 * DRAWN], "C2", 0)
        assert_orbits(buffer.sample().split(DRAWN))


# --- the user's own transforms


class Shift(Transform):
    """Normalises by constants that are not symmetric, and keeps every second row that comes in."""

    def forward(self, tensordict):
        return tensordict.set("observation", tensordict["observation"] + 10.0)

    def _inv_call(self, tensordict):
        return tensordict[::2]


def test_own_transforms_see_the_copies():
    batch = symmetric(transform=Shift()).sample()
    assert_orbits(batch.set("observation", batch["observation"] - 10.0).split(DRAWN))
    batch = symmetric(transform=lambda td: td.set("observation", td["observation"] + 10.0)).sample()
    assert_orbits(batch.set("observation", batch["observation"] - 10.0).split(DRAWN))


def test_own_transforms_precede_the_copies_that_are_stored():
    buffer = symmetric(transform=Shift(), when="extend")
    stored = buffer.storage[:]
    assert len(stored) == ROWS
    assert numbers(stored).tolist() == list(range(0, ROWS, 2)) * 2
    assert_orbits(stored.split(ROWS // 2))


def test_transforms_may_be_appended():
    buffer = symmetric()
    buffer.append_transform(RenameTransform(["advantage"], ["gae"]))
    assert "gae" in buffer.sample().keys()  # noqa: SIM118
    assert_orbits(symmetric(transform=Compose()).sample().split(DRAWN))


# --- stored copies


def test_copies_are_stored_and_sampled_independently():
    buffer = symmetric(group="K4", when="extend", storage=LazyTensorStorage(4 * ROWS))
    assert_orbits(buffer[:].split(ROWS), "K4")
    batch = buffer.sample()
    assert len(batch) == DRAWN
    assert_images(batch[:0], "K4", 0)
    assert elements_of(batch, "K4").unique().numel() > 1


@pytest.mark.parametrize("shape, ndim", [((ROWS,), 1), ((4, 6), 2)], ids=str)
def test_a_storage_that_is_too_small_is_refused_and_stays_empty(shape, ndim):
    buffer = SymmetryReplayBuffer(
        make_symmetry(), when="extend", storage=LazyTensorStorage(2 * ROWS - 1, ndim=ndim)
    )
    with pytest.raises(RuntimeError, match=r"holds 47 rows, but 48 .* make the storage that large"):
        buffer.extend(rows(*shape))
    assert len(buffer) == 0


def test_a_storage_that_is_full_goes_round():
    buffer = symmetric(when="extend", storage=LazyTensorStorage(2 * ROWS))
    buffer.extend(rows()[:4])
    assert_orbits(buffer[:8].split(4))


def test_add():
    buffer = SymmetryReplayBuffer(make_symmetry(), storage=LazyTensorStorage(ROWS), batch_size=3)
    buffer.add(rows()[0])
    assert_orbits(buffer.sample().split(3))
    buffer = SymmetryReplayBuffer(make_symmetry(), storage=LazyTensorStorage(ROWS), when="extend")
    with pytest.raises(RuntimeError, match=r"single row has no place .* use buffer.extend"):
        buffer.add(rows()[0])


@pytest.mark.parametrize("settings", [{"end_key": ("next", "done")}, {"traj_key": "done"}], ids=str)
def test_slices_that_are_not_cut_between_stored_copies_are_refused(settings):
    with pytest.raises(ValueError, match=r"run from one stored copy into the next.*use when='sample'"):
        SymmetryReplayBuffer(
            make_symmetry(),
            when="extend",
            storage=LazyTensorStorage(2 * ROWS),
            sampler=SliceSampler(slice_len=4, **settings),
        )


def test_stored_copies_need_trajectory_ids_to_be_sliced():
    buffer = SymmetryReplayBuffer(
        make_symmetry(),
        when="extend",
        storage=LazyTensorStorage(2 * ROWS),
        sampler=SliceSampler(slice_len=4),
    )
    with pytest.raises(RuntimeError, match=r"run from one stored copy into the next.*use when='sample'"):
        buffer.extend(trajectories(24, ids=False))
    assert len(buffer) == 0


# --- refusals


@pytest.mark.parametrize(
    "settings, error, message",
    [
        ({"when": "add"}, ValueError, r"when: expected one of"),
        ({"elements": ["reflect-z"]}, KeyError, "no element 'reflect-z'"),
        ({"sample_unit": Sequence(2)}, TypeError, "among .*got 'sample_unit'"),
        ({"transform_factory": Shift}, TypeError, "among .*got 'transform_factory'"),
        ({"samplr": SamplerWithoutReplacement()}, TypeError, "did you mean 'sampler'"),
        ({"transform": SymmetryAugment(make_symmetry())}, ValueError, "makes copies; leave it out"),
        ({"transform": SymmetryOrbit(make_symmetry()).transform()}, ValueError, "makes copies; leave it"),
        ({"sampler": SamplerEnsemble(SamplerWithoutReplacement())}, ValueError, "got an ensemble; make"),
    ],
    ids=lambda value: ", ".join(value) if isinstance(value, dict) else "",  # no addresses of objects
)
def test_parts_that_do_not_go_together_are_refused(settings, error, message):
    with pytest.raises(error, match=message):
        SymmetryReplayBuffer(make_symmetry("K4"), **{"storage": LazyTensorStorage(ROWS)} | settings)


def test_a_symmetry_is_asked_for():
    with pytest.raises(TypeError, match="symmetry: expected Symmetry, got None"):
        SymmetryReplayBuffer(None, storage=LazyTensorStorage(ROWS))


def test_an_ensemble_of_buffers_is_refused():
    ensemble = ReplayBufferEnsemble(symmetric(), symmetric(), batch_size=4)
    with pytest.raises(RuntimeError, match="rows as they are stored"):
        ensemble.sample()


def test_what_the_symmetry_does_not_know_is_refused():
    with pytest.raises(KeyError, match="torque"):
        symmetric(rows().set("torque", torch.zeros(ROWS, 2))).sample()
    with pytest.raises(KeyError, match=r"lacks \['action'\]"):
        symmetric(rows().exclude("action")).sample()


def test_the_symmetry_stays_its_owners():
    symmetry = make_symmetry("C3")
    buffer = SymmetryReplayBuffer(symmetry, storage=LazyTensorStorage(ROWS), batch_size=2)
    assert not list(buffer.transform.buffers())
    buffer.transform.to("meta")
    buffer.extend(rows())
    assert_orbits(buffer.sample().split(2), "C3")


def test_nested_keys():
    group = make_symmetry().group
    sign = pseudoscalar(group)
    keys = {("agents", "observation"): sign * 3, ("agents", "action"): sign, "goal": invariant(group, 2)}
    data = TensorDict(
        agents=TensorDict(observation=torch.randn(ROWS, 3), action=torch.randn(ROWS, 1)),
        goal=torch.randn(ROWS, 2),
        batch_size=[ROWS],
    )
    buffer = SymmetryReplayBuffer(Symmetry(group, keys), storage=LazyTensorStorage(ROWS), batch_size=5)
    buffer.extend(data)
    original, mirrored = buffer.sample().split(5)
    assert torch.equal(mirrored["agents", "action"], -original["agents", "action"])
    assert torch.equal(mirrored["goal"], original["goal"])


# --- saving

RUNS = pytest.mark.parametrize("settings", [{}, {"elements": "random"}, {"prefetch": 2}], ids=str)


def assert_continues(buffer: ReplayBuffer) -> None:
    assert len(buffer) == ROWS
    for _ in range(4):
        batch = buffer.sample()
        assert torch.equal(elements_of(batch, "K4"), batch["symmetry_id"])
        assert torch.equal(batch["index"], numbers(batch))
    assert_images(buffer[4:8], "K4", 0)


@pytest.mark.parametrize("storage", [LazyTensorStorage, LazyMemmapStorage, ListStorage])
@RUNS
def test_state_dict(storage, settings):
    buffer = symmetric(group="K4", storage=storage(ROWS), **settings)
    buffer.sample()
    other = SymmetryReplayBuffer(make_symmetry("K4"), storage=storage(ROWS), batch_size=2, **settings)
    other.load_state_dict(buffer.state_dict())
    assert_continues(other)


@pytest.mark.parametrize("storage", [LazyTensorStorage, LazyMemmapStorage])
@RUNS
def test_dumps_and_loads(storage, settings, tmp_path):
    buffer = symmetric(group="K4", storage=storage(ROWS), **settings)
    buffer.sample()
    buffer.dumps(tmp_path)
    other = SymmetryReplayBuffer(make_symmetry("K4"), storage=storage(ROWS), batch_size=2, **settings)
    other.loads(tmp_path)
    assert_continues(other)


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda b: pickle.loads(pickle.dumps(b))])
@pytest.mark.parametrize("when", ["sample", "extend"])
def test_copies_of_a_buffer_act_alike(duplicate, when):
    buffer = symmetric(group="K4", when=when, storage=LazyTensorStorage(4 * ROWS))
    other = duplicate(buffer)
    other.empty()
    other.extend(rows()[:DRAWN])
    assert len(buffer) == (4 * ROWS if when == "extend" else ROWS)
    for one in (other, buffer):
        elements_of(one.sample(), "K4")
        assert_images(one[:DRAWN], "K4", 0)
    assert numbers(other[:]).max() < DRAWN
