"""What equivariant networks cost, beside dense ones on the same rows and on all symmetric copies.

One table of speed.py.
A dense network of as many units is what they replace, and augmentation's N times as many rows are what they
save. The time is that of a forward and a backward pass in one thread, dense and equivariant in turn, and
apart from them the copies, which leave neither cache nor heap as an update finds them.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from statistics import median

import torch
from torch import Tensor, nn
from torchrl.modules import MLP

from measuring import interleave, ratio
from torchrl_sym import PointGroup, Representation
from torchrl_sym.modules import EquivariantMLP
from torchrl_sym.representations import axial, height_map, polar, regular

ROWS = 3072
GROUPS = {
    "C2": PointGroup.reflection("y"),
    "K4": PointGroup.klein_four(),
    "C3": PointGroup.rotation(3),
    "C4": PointGroup.rotation(4),
    "D3": PointGroup.dihedral(3),
    "D4": PointGroup.dihedral(4),
}
SMALL, WIDE = (128, 128, 128), (512, 256, 128)


def body(group: PointGroup, joints: int = 12) -> tuple[Representation, Representation]:
    """About 51 observations and 12 actions, as of the task Push: vectors, and joints that change places."""
    limbs = regular(group, max(1, joints // group.order))
    return polar(group) * 3 + axial(group) * 2 + limbs * 3, limbs


def scan(group: PointGroup) -> Representation:
    """231 heights around the robot, as of the task Climb."""
    return height_map(group, torch.linspace(-1, 1, 21), torch.linspace(-0.5, 0.5, 11))


def cases() -> Iterator[tuple[str, Representation, Representation, tuple[int, ...]]]:
    """Names of groups, representations of inputs and outputs, and sizes of hidden layers."""
    for name, group in GROUPS.items():
        observation, action = body(group)
        for hidden in (SMALL, WIDE):
            yield name, observation, action, tuple(-(-size // group.order) * group.order for size in hidden)
    observation, action = body(GROUPS["K4"])
    for hidden in (SMALL, WIDE):
        yield "K4", observation + scan(GROUPS["K4"]), action, hidden


def update(network: Callable[[Tensor], Tensor], x: Tensor) -> Callable[[], None]:
    """A forward and a backward pass."""

    def run() -> None:
        network(x).square().mean().backward()

    return run


def measure_equivariant(tasks: tuple[str, ...], rounds: int, compiled: bool = False) -> Iterator[dict]:
    """Milliseconds of forward and backward, equivariant and dense, on 3,072 rows and on N times as many."""
    rows = min(ROWS, 256 * rounds)  # few rounds are a quick look
    for name, observation, action, hidden in cases():
        x, n = torch.randn(rows, observation.dim), observation.group.order
        networks: dict[str, nn.Module] = {
            "dense": MLP(observation.dim, action.dim, num_cells=list(hidden), activation_class=nn.ELU),
            "equivariant": EquivariantMLP(observation, action, hidden),
        }
        if compiled:
            networks = {key: torch.compile(network) for key, network in networks.items()}
        variants = {key: update(network, x) for key, network in networks.items()}
        seconds = interleave(variants, rounds, time.process_time)
        copies = {"copies": update(networks["dense"], x.repeat(n, 1))}
        seconds |= interleave(copies, max(1, rounds // 3), time.process_time)
        milliseconds = {key: 1e3 * median(values) for key, values in seconds.items()}
        yield {
            "group": name,
            "layers": "-".join(map(str, (observation.dim, *hidden, action.dim))),
            "rows": rows,
            "compiled": compiled,
            **{f"{key}_ms": value for key, value in milliseconds.items()},
            "over_dense": ratio(seconds, "equivariant", "dense"),
            "over_copies": milliseconds["equivariant"] / milliseconds["copies"],
        }


def measure_compiled(tasks: tuple[str, ...], rounds: int) -> Iterator[dict]:
    """The same under torch.compile, which takes minutes."""
    yield from measure_equivariant(tasks, rounds, compiled=True)
