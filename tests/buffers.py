"""Replay buffers of numbered rows, and the check that what they give are rows and their images."""

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import LazyTensorStorage, ReplayBuffer, TensorDictReplayBuffer

from tests.networks import make_batch, make_symmetry
from torchrl_sym import SymmetryOrbit

ROWS, DRAWN = 24, 8

buffers = pytest.mark.parametrize("buffer", [ReplayBuffer, TensorDictReplayBuffer])


def rows(*shape: int) -> TensorDict:
    """A batch whose rows are numbered in ``step_count``."""
    shape = shape or (ROWS,)
    numbers = torch.arange(torch.Size(shape).numel()).reshape(*shape, 1)
    return make_batch(*shape).set("step_count", numbers)


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


def filled(buffer: type[ReplayBuffer], batch: TensorDictBase | None = None, **settings) -> ReplayBuffer:
    settings = {"storage": LazyTensorStorage(ROWS), "batch_size": DRAWN, **settings}
    out = buffer(**settings)
    out.extend(rows() if batch is None else batch)
    return out


def with_orbit(group: str = "C2", elements="all") -> dict:
    orbit = SymmetryOrbit(make_symmetry(group), elements)
    return {"sample_unit": orbit, "transform": orbit.transform()}
