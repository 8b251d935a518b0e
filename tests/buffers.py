"""Batches and replay buffers of numbered rows, and checks that what comes of them are their images."""

from typing import Any

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import (
    LazyTensorStorage,
    PrioritizedSampler,
    ReplayBuffer,
    SliceSampler,
    SliceSamplerWithoutReplacement,
    TensorDictReplayBuffer,
)

from tests.networks import make_batch, make_symmetry
from torchrl_sym import Symmetry, SymmetryOrbit, SymmetryReplayBuffer
from torchrl_sym.augment import TRAJECTORY

ROWS, DRAWN, SLICE = 24, 8, 4
MAPPED = ("observation", "action")
SHARED = ("action_log_prob", "advantage", "value_target", "state_value")

buffers = pytest.mark.parametrize("buffer", [ReplayBuffer, TensorDictReplayBuffer])
every_slicer = pytest.mark.parametrize("slicer", [SliceSampler, SliceSamplerWithoutReplacement])


class ToldSampler(PrioritizedSampler):
    """Samples uniformly and keeps what it is told; a prioritized sampler without TorchRL's C++ part."""

    def __init__(self, reduction: str = "max") -> None:
        super().__init__(ROWS, alpha=1.0, beta=1.0, reduction=reduction)
        self.told: list[tuple[torch.Tensor, torch.Tensor]] = []

    def _init(self) -> None:
        self._sum_tree = self._min_tree = None

    def sample(self, storage, batch_size: int):
        index = storage._rand_given_ndim(batch_size)
        first = index[0] if isinstance(index, tuple) else index
        return index, {"priority_weight": 1.0 + first.float()}

    def mark_update(self, index, *, storage=None) -> None:
        pass

    def update_priority(self, index, priority, *, storage=None) -> None:
        self.told.append((index, priority))

    def last(self) -> dict[Any, float]:
        """The priority of each row by its index, as the last update left it; fails if a row came twice."""
        index, priority = self.told[-1]
        rows = [tuple(row) if isinstance(row, list) else row for row in index.tolist()]
        assert len(set(rows)) == len(rows)
        return dict(zip(rows, priority.flatten().tolist(), strict=True))


def rows(*shape: int) -> TensorDict:
    """A batch whose rows are numbered in ``step_count``."""
    shape = shape or (ROWS,)
    numbers = torch.arange(torch.Size(shape).numel()).reshape(*shape, 1)
    return make_batch(*shape).set("step_count", numbers)


def trajectories(*lengths: int, ids: bool = True) -> TensorDict:
    """Unfinished trajectories of these lengths, one after the other."""
    batch = rows(sum(lengths))
    batch["next", "done"] = torch.zeros(sum(lengths), 1, dtype=torch.bool)
    if ids:
        batch[TRAJECTORY] = torch.arange(len(lengths)).repeat_interleave(torch.tensor(lengths))
    return batch


def numbers(batch: TensorDictBase) -> torch.Tensor:
    return batch["step_count"][..., 0]


def assert_images(batch: TensorDictBase, group: str, g: int) -> None:
    """Every row is the image under g of the row of that number."""
    originals = rows()[numbers(batch)]
    expected = make_symmetry(group)(originals, g)
    for key in expected.keys(True, True):
        torch.testing.assert_close(batch[key], expected[key], rtol=0, atol=1e-12)


def assert_orbits(blocks: list[TensorDictBase], group: str = "C2") -> None:
    """The blocks are the images of the same rows under all elements, in order."""
    assert len(blocks) == len(make_symmetry(group).group)
    for g, block in enumerate(blocks):
        assert torch.equal(numbers(block), numbers(blocks[0]))
        assert_images(block, group, g)


def same(actual: TensorDictBase, expected: TensorDictBase) -> bool:
    return actual.batch_size == expected.batch_size and bool((actual == expected).all())


def drawn_elements(out: TensorDictBase, batch: TensorDictBase, symmetry: Symmetry) -> torch.Tensor:
    """Which element each row was mapped by; fails unless every row is exactly one of its images."""
    images = symmetry.orbit(batch)
    matches = torch.stack(
        [torch.isclose(images[key], out[key], rtol=0, atol=1e-12).all(-1) for key in MAPPED]
    ).all(0)
    assert (matches.sum(0) == 1).all()
    kept = [key for key in SHARED if key in out.keys()]  # noqa: SIM118
    assert same(out.select(*kept), batch.select(*kept))
    return matches.long().argmax(0)


def elements_of(batch: TensorDictBase, group: str = "C2") -> torch.Tensor:
    """Which element each row was mapped by, of the row of its number."""
    return drawn_elements(batch, rows()[numbers(batch)], make_symmetry(group))


def assert_slices(batch: TensorDictBase, group: str = "C2") -> None:
    """Every slice has consecutive rows of one trajectory, all mapped by one element."""
    assert len(batch) % SLICE == 0
    for piece in batch.reshape(-1, SLICE):
        assert (numbers(piece).diff() == 1).all()
        assert elements_of(piece, group).unique().numel() == 1
        if TRAJECTORY in piece.keys(True):
            assert piece[TRAJECTORY].unique().numel() == 1


def filled(buffer: type[ReplayBuffer], batch: TensorDictBase | None = None, **settings) -> ReplayBuffer:
    settings = {"storage": LazyTensorStorage(ROWS), "batch_size": DRAWN, **settings}
    out = buffer(**settings)
    out.extend(rows() if batch is None else batch)
    return out


def symmetric(batch: TensorDictBase | None = None, group: str = "C2", **settings) -> SymmetryReplayBuffer:
    """A SymmetryReplayBuffer that has been filled."""
    settings = {"storage": LazyTensorStorage(ROWS), "batch_size": DRAWN, **settings}
    out = SymmetryReplayBuffer(make_symmetry(group), **settings)
    out.extend(rows() if batch is None else batch)
    return out


def with_orbit(group: str = "C2", elements="all") -> dict:
    orbit = SymmetryOrbit(make_symmetry(group), elements)
    return {"sample_unit": orbit, "transform": orbit.transform()}
