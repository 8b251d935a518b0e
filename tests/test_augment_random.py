"""SymmetryAugment with random elements: what shares an element, and on which device all that happens."""

import copy

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torch.utils._python_dispatch import TorchDispatchMode
from torchrl.data import LazyTensorStorage

from tests.buffers import MAPPED, drawn_elements, same
from tests.networks import make_batch, make_symmetry
from torchrl_sym import PointGroup, Symmetry, SymmetryAugment, SymmetryReplayBuffer
from torchrl_sym.representations import invariant, pseudoscalar

every_shape = pytest.mark.parametrize("shape", [(8,), (8, 4)], ids=str)

# --- random elements


@every_shape
def test_random_maps_observation_and_action_of_a_row_by_one_element(shape):
    batch, symmetry = make_batch(*shape), make_symmetry("K4")
    out = SymmetryAugment(symmetry, elements="random")(batch)
    assert drawn_elements(out, batch, symmetry).shape == shape


def test_random_elements_are_uniform():
    torch.manual_seed(0)
    batch, symmetry = make_batch(4000), make_symmetry("K4")
    out = SymmetryAugment(symmetry, elements="random")(batch)
    count = drawn_elements(out, batch, symmetry).bincount(minlength=4)
    chi_square = ((count - 1000) ** 2 / 1000).sum()
    assert chi_square < 16.3  # one in a thousand with three degrees of freedom


def test_random_elements_are_drawn_anew():
    torch.manual_seed(0)
    augment, batch = SymmetryAugment(make_symmetry("K4"), elements="random"), make_batch(64)
    assert not same(augment(batch), augment(batch))


# --- random elements of what is read in order


def recurrent(batch: TensorDictBase) -> TensorDictBase:
    return batch.set("is_init", torch.zeros(*batch.shape, 1, dtype=torch.bool))


def with_ids(batch: TensorDictBase, ids: torch.Tensor) -> TensorDictBase:
    batch["collector", "traj_ids"] = ids
    return batch


@pytest.mark.parametrize(
    "mark",
    [
        recurrent,
        lambda batch: batch.set(("next", "is_init"), torch.zeros(*batch.shape, 1, dtype=torch.bool)),
        lambda batch: batch.set("recurrent_state_h", torch.zeros(*batch.shape, 5)),
    ],
    ids=["is_init", "next is_init", "memory"],
)
def test_a_sequence_is_mapped_by_one_element(mark):
    torch.manual_seed(0)
    batch, declared = mark(make_batch(64, 5)), make_symmetry("K4")
    entries = {key: declared[key] for key in MAPPED} | {"recurrent_state_h": invariant(declared.group, 5)}
    found = set(batch.keys())
    symmetry = Symmetry(declared.group, {key: rho for key, rho in entries.items() if key in found})
    element = drawn_elements(SymmetryAugment(symmetry, elements="random")(batch), batch, symmetry)
    assert (element == element[:, :1]).all()
    assert element[:, 0].unique().tolist() == [0, 1, 2, 3]


def test_a_sequence_runs_along_the_dimension_that_is_named_time():
    torch.manual_seed(0)
    batch, symmetry = recurrent(make_batch(5, 64)), make_symmetry("K4")
    batch.names = ["time", None]
    element = drawn_elements(SymmetryAugment(symmetry, elements="random")(batch), batch, symmetry)
    assert (element == element[:1]).all() and element.unique().numel() == 4


@pytest.mark.parametrize("shape", [(12,), (12, 1), (3, 12), (3, 12, 1)], ids=str)
def test_a_trajectory_is_mapped_by_one_element(shape):
    torch.manual_seed(0)
    symmetry, lengths = make_symmetry("K4"), torch.tensor([3, 4, 5])
    ids = torch.arange(3).repeat_interleave(lengths)
    lanes = shape[0] if shape[0] == 3 else None
    batch = make_batch(12) if lanes is None else make_batch(lanes, 12)
    ids = ids.reshape(12, 1) if shape[-1] == 1 else ids
    batch = with_ids(batch, ids.expand(shape) if lanes is None else ids.expand(lanes, *ids.shape))
    found = set()
    for _ in range(20):
        out = SymmetryAugment(symmetry, elements="random")(batch)
        element = drawn_elements(out, batch, symmetry)
        for piece in element.split(lengths.tolist(), dim=-1):
            assert (piece == piece[..., :1]).all()
        found |= {tuple(row) for row in element.reshape(-1, 12)[:, [0, 3, 7]].tolist()}
        new = out["collector", "traj_ids"].reshape(batch.shape)  # images under two elements are two
        assert torch.equal(new, ids.reshape(12) * 4 + element)
    assert len(found) > 3  # trajectories draw independently


def test_select_may_drop_what_tells_trajectories_apart():
    torch.manual_seed(0)
    symmetry, batch = make_symmetry("K4"), with_ids(make_batch(8), torch.zeros(8, dtype=torch.long))
    out = SymmetryAugment(symmetry, elements="random", select=MAPPED)(batch)
    assert drawn_elements(out, batch, symmetry).unique().numel() == 1


def test_a_flat_recurrent_batch_without_trajectories_is_refused():
    augment = SymmetryAugment(make_symmetry(), elements="random")
    with pytest.raises(RuntimeError, match=r"flat batch in order.*traj_ids.*reshape .* \[B, T\]"):
        augment(recurrent(make_batch(8)))
    assert augment(with_ids(recurrent(make_batch(8)), torch.zeros(8, dtype=torch.long))).shape == (8,)


@pytest.mark.parametrize("elements", ["all", "random"])
def test_an_empty_batch_stays_empty(elements):
    batch = with_ids(make_batch(8), torch.zeros(8, dtype=torch.long))[:0]
    assert SymmetryAugment(make_symmetry("K4"), elements=elements)(batch).shape == (0,)


# --- devices


class HostForbidden(TorchDispatchMode):
    """Fails on what makes a GPU wait for the host, or the host for a GPU."""

    FORBIDDEN = ("_local_scalar_dense", "nonzero", "equal", "is_nonzero", "unique", "masked_select", "lift")

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = func.overloadpacket.__name__
        assert not any(name.startswith(word) for word in self.FORBIDDEN), name
        return func(*args, **(kwargs or {}))


SETTINGS = [
    {},
    {"layout": "stack"},
    {"elements": ["rot-180"]},
    {"elements": "random"},
    {"select": MAPPED},
]


@pytest.mark.parametrize("prepare", [lambda b: b, recurrent], ids=["rows", "sequences"])
@pytest.mark.parametrize("settings", SETTINGS, ids=str)
def test_everything_stays_on_the_device_of_the_data(settings, prepare):
    batch = with_ids(prepare(make_batch(8, 4)), torch.zeros(8, 4, dtype=torch.long))
    augment = SymmetryAugment(copy.deepcopy(make_symmetry("K4")).to("meta"), **settings)
    batch = batch.to("meta").clear_device_()
    with HostForbidden():
        out = augment(batch)
    assert {value.device.type for value in out.values(True, True)} == {"meta"}


@pytest.mark.parametrize("wait", [lambda: bool(torch.ones(1).sum()), lambda: torch.tensor([0, 3])])
def test_waiting_would_be_noticed(wait):
    with pytest.raises(AssertionError), HostForbidden():
        wait()


def test_moving_the_transform_leaves_the_symmetry_to_its_owner():
    symmetry, batch = make_symmetry("C3"), make_batch(8)
    augment = SymmetryAugment(symmetry)
    expected = augment(batch)
    assert not list(augment.modules())[1:] and not augment.state_dict()
    augment.to("meta").to(torch.bfloat16)
    assert augment.symmetry is symmetry and same(augment(batch), expected)


GROUP = PointGroup.reflection("y")
RECURRENT = Symmetry(GROUP, {"observation": pseudoscalar(GROUP), "recurrent_state": invariant(GROUP, 2)})


def recurrent_batch(*size: int, stored: float) -> TensorDict:
    td = TensorDict(
        observation=torch.ones(*size, 1), recurrent_state=torch.ones(*size, 1, 2), batch_size=size
    )
    td["recurrent_state"][:, 0] = stored
    td["is_init"] = torch.zeros(*size, 1, dtype=torch.bool)
    td["is_init"][:, 0] = stored == 0
    return td


@pytest.mark.parametrize("elements", ["all", "random"])
def test_copies_of_sequences_begin_from_zero_memory_or_are_refused(elements):
    augment = SymmetryAugment(RECURRENT, elements=elements)
    torch.manual_seed(0)
    out = augment(recurrent_batch(8, 3, stored=0.0))
    mirrored = out["observation"][:, 0, 0] < 0
    assert mirrored.any() and not mirrored.all()
    assert (out["recurrent_state"][mirrored] == 0).all()
    assert (out["recurrent_state"][~mirrored, 1:] == 1).all()
    with pytest.raises(ValueError, match="stored memory that is not zero"):
        augment(recurrent_batch(8, 3, stored=1.0))


@pytest.mark.parametrize("elements", ["all", "random"])
def test_the_memory_of_next_states_is_not_that_of_the_unmirrored_history(elements):
    td = recurrent_batch(8, 3, stored=0.0)
    td["next", "recurrent_state"] = torch.ones(8, 3, 1, 2)
    assert ("next", "recurrent_state") not in SymmetryAugment(RECURRENT, elements=elements)(td).keys(True)
    equivariant = Symmetry(
        GROUP, {"observation": pseudoscalar(GROUP), "recurrent_state": pseudoscalar(GROUP) * 2}
    )
    out = SymmetryAugment(equivariant)(td)
    assert (out["next", "recurrent_state"][8:] == -1).all()


def test_flat_slices_with_a_stored_memory_are_refused_by_the_buffer():
    buffer = SymmetryReplayBuffer(RECURRENT, storage=LazyTensorStorage(8), batch_size=4)
    buffer.extend(recurrent_batch(8, 1, stored=1.0)[:, 0])
    with pytest.raises(RuntimeError, match="leave it out of the buffer"):
        buffer.sample()


def test_flat_slices_without_their_memory_are_copied():
    buffer = SymmetryReplayBuffer(RECURRENT, storage=LazyTensorStorage(8), batch_size=4)
    buffer.extend(recurrent_batch(8, 1, stored=1.0)[:, 0].exclude("recurrent_state"))
    assert (buffer.sample()["observation"][4:] == -1).all()
