"""The point groups that the tests run on, and a few lines of linear algebra for them."""

import pytest
import torch

from torchrl_sym import PointGroup

QUARTER_TURN = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
CYCLE_AXES = torch.tensor([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])  # 120 degrees about (1, 1, 1)


def cube() -> PointGroup:
    """The 24 rotations of the cube, which do not fix the vertical axis."""
    generators = {"turn": QUARTER_TURN, "cycle": CYCLE_AXES}
    return PointGroup.generate(generators, fixes_vertical=False)


GROUPS = {
    "trivial": PointGroup.trivial(),
    "reflect-x": PointGroup.reflection("x"),
    "reflect-y": PointGroup.reflection("y"),
    "C2": PointGroup.rotation(2),
    "C3": PointGroup.rotation(3),
    "K4": PointGroup.klein_four(),
    "C4": PointGroup.rotation(4),
    "D3": PointGroup.dihedral(3),
    "D4": PointGroup.dihedral(4),
    "C5": PointGroup.rotation(5),
    "D6": PointGroup.dihedral(6),
    "cube": cube(),
}
VERTICAL = set(GROUPS) - {"cube"}  # fix the vertical axis
PROPER = {"trivial", "C2", "C3", "C4", "C5", "cube"}  # have rotations only
ODD = {"trivial", "C3", "C5"}  # have rotations of odd order only

every_group = pytest.mark.parametrize("group", GROUPS.values(), ids=GROUPS)
every_vertical_group = pytest.mark.parametrize(
    "group", [GROUPS[name] for name in GROUPS if name in VERTICAL], ids=[n for n in GROUPS if n in VERTICAL]
)


def random(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def assert_close(actual: torch.Tensor, expected: torch.Tensor, atol: float = 1e-12) -> None:
    torch.testing.assert_close(actual, expected, rtol=0, atol=atol)


def scattered(group: PointGroup) -> torch.Tensor:
    """One point in general position and all of its images: ``(N, 3)``."""
    return group.matrices @ torch.tensor([0.3, 0.1, 0.7], dtype=torch.float64, device="cpu")
