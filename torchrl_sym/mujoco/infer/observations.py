"""How observations transform: from samples to a representation for every key."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from tensordict import NestedKey

from torchrl_sym.entries import Exchanged, opposites
from torchrl_sym.groups import PointGroup
from torchrl_sym.mujoco.infer.columns import Flags
from torchrl_sym.mujoco.infer.errors import InferenceError
from torchrl_sym.mujoco.infer.quantities import labels_of, names_of
from torchrl_sym.mujoco.infer.samples import Sampler, Samples
from torchrl_sym.mujoco.infer.solve import Solution, solve
from torchrl_sym.mujoco.model.types import Array
from torchrl_sym.representations import Representation
from torchrl_sym.representations.blocks import SignedPermutation

_SINGLE, _DOUBLE = 4e-6, 1e-10  # what single and double precision round, relative to the entry
_FEW = 4  # samples in which an entry must differ, to be told from others that agree with it
_ROUNDS = 5  # how often samples are drawn, where that may help: each time as many as there are

Keys = tuple[NestedKey, ...]


class ObservationFinder:
    """Finds how every key of an observation transforms.

    Attributes:
        samples: what was observed.
        solutions: what was found, by the keys that change places.
        labels: what the entries of each key seem to be.
    """

    def __init__(self, sampler: Sampler, group: PointGroup, tolerance: float) -> None:
        self.sampler, self.group, self.tolerance = sampler, group, tolerance
        self.samples: Samples = sampler.samples
        self.solutions: dict[Keys, Solution] = {}
        self.labels: dict[NestedKey, list[str]] = {}

    def find(self, count: int) -> None:
        """Draw samples until all is clear, or no more becomes so.

        What is found from some samples is checked on others; where these are a surprise, it is found anew
        from all, and checked on as many more.
        """
        self.samples = self.sampler.draw(count)
        self._check_kinds()
        known = 2 * self.samples.count // 3
        for number in range(_ROUNDS):
            self.solutions = self._solutions(known)
            found = self.solutions.values()
            still = any(s.constant.any() for s in found) and number == 0
            if not still and not any(s.surprised.any() or unclear(s) for s in found):
                break
            known = self.samples.count
            self.sampler.draw(known)
            if number == 0 and not self.sampler.subject.whole:
                self.sampler.draw_patiently()
        names, quantities = names_of(self.sampler.subject), self.samples.quantities
        assert quantities is not None
        for key, x in self.samples.values.items():
            labels = labels_of(names, quantities.numpy(), x[0].numpy(), self.rounding(key))
            self.labels[key] = labels

    def margin(self, key: NestedKey) -> Array:
        """Largest difference of each entry from its image that counts as none."""
        return np.maximum(self.tolerance * self.size(key), self.rounding(key))

    def rounding(self, key: NestedKey) -> Array:
        """Largest difference of each entry that is no more than rounding."""
        single = self.samples.dtypes[key] in (torch.float32, torch.float16, torch.bfloat16)
        return (_SINGLE if single else _DOUBLE) * self.size(key)

    def size(self, key: NestedKey) -> Array:
        """Largest value of each entry."""
        return np.maximum(self.samples.values[key].abs().amax(dim=(0, 1)).numpy(), 1e-6)

    def hidden(self, key: NestedKey) -> Flags:
        """Entries that differ between two observations of one state, ``(d,)`` bool."""
        return self.samples.hidden[key].numpy() > self.margin(key)

    def _check_kinds(self) -> None:
        for key, shape in self.samples.shapes.items():
            if self.samples.dtypes[key] == torch.uint8 and len(shape) > 1:
                raise InferenceError(
                    f"{key!r}: expected numbers of a state, got an image {tuple(shape)}; leave it out with "
                    "observe=..., and declare it with torchrl_sym.representations.image"
                )

    def _solutions(self, known: int) -> dict[Keys, Solution]:
        """One for each key; those of keys that have none by themselves together, if that helps."""
        found = {keys: self._solve(keys, known) for keys in self._sides()}
        alone = [keys for keys, solution in found.items() if not solution.complete]
        if len(alone) < 2:
            return found
        together = tuple(key for keys in alone for key in keys)
        joint = self._solve(together, known)
        for keys in _exchanged(joint, [self.samples.values[key].shape[-1] for key in together], together):
            if len(keys) > 1 and (part := self._solve(keys, known)).complete:
                found = {old: s for old, s in found.items() if old[0] not in keys} | {keys: part}
        return found

    def _sides(self) -> list[Keys]:
        """Each key by itself; those named after sides that an element exchanges together."""
        keys = list(self.samples.values)
        turned = self.group.matrices.diagonal(dim1=-2, dim2=-1) < -1 + 1e-9
        pairs = [(a, b) for a, b, axis in opposites(keys) if turned[:, axis].any()]
        owner = {key: key for key in keys}
        for a, b in pairs:
            old, new = owner[b], owner[a]
            owner = {key: new if first == old else first for key, first in owner.items()}
        return [
            tuple(key for key in keys if owner[key] == first) for first in dict.fromkeys(owner.values())
        ]

    def _solve(self, keys: Keys, known: int) -> Solution:
        """From the samples known, checked on the rest."""
        values = torch.cat([self.samples.values[key] for key in keys], -1).numpy()
        margin, rounding, size = (
            np.concatenate([of(key) for key in keys]) for of in (self.margin, self.rounding, self.size)
        )
        solution = solve(self.group, values[:, :known], margin, rounding)
        images = np.einsum("nk,gik->gni", values[0], solution.matrices)
        off = np.abs(values - images).max(axis=1, initial=0.0)
        solution.surprised = (off > 3 * margin) & ~solution.failed
        solution.failed |= solution.surprised
        solution.failed &= ~np.concatenate([self.hidden(key) for key in keys])
        solution.off = np.where(solution.failed, 0.0, off / size).max(axis=0)
        return solution

    def representations(self) -> dict[NestedKey | Exchanged, Representation]:
        """Those found, by key, or by keys that change places."""
        found: dict[NestedKey | Exchanged, Representation] = {}
        for keys, solution in self.solutions.items():
            if not solution.complete or any(self.hidden(key).any() for key in keys):
                continue
            shapes = [tuple(self.samples.shapes[key]) for key in keys]
            representation = self._representation(solution)
            if len(keys) == 1:
                found[keys[0]] = representation.unflatten(shapes[0])
            elif all(len(shape) == 1 for shape in shapes):
                found[Exchanged(*keys)] = representation
            elif len(set(shapes)) == 1:
                found[Exchanged(*keys)] = representation.unflatten((len(keys), *shapes[0]))
            else:
                raise InferenceError(
                    f"{keys} change places, but have the shapes {shapes}; flatten them with observe=..."
                )
        return found

    def _representation(self, solution: Solution) -> Representation:
        matrices = torch.as_tensor(solution.matrices)
        if matrices.shape[-1] == 0:
            empty = torch.zeros(self.group.order, 0)
            return Representation.from_blocks(self.group, [SignedPermutation(empty, empty)], check=False)
        return Representation(self.group, matrices)


def unclear(solution: Solution) -> list[list[int]]:
    """Entries that agree with others for want of events: they hardly ever change, or lie side by side.

    Copies of an entry, in a goal or a history, are apart; a height scan over flat ground is not.
    """
    return [
        members
        for members in solution.twins
        if solution.events[members].min() < _FEW
        or any(c - a == 2 for a, c in zip(members, members[2:], strict=False))
    ]


def _exchanged(solution: Solution, sizes: Sequence[int], keys: Keys) -> list[Keys]:
    """Which keys have entries that change places."""
    owner = np.repeat(np.arange(len(keys)), sizes)
    label = np.arange(len(keys))
    for _, i, j in np.argwhere(solution.matrices):
        a, b = label[owner[i]], label[owner[j]]
        label[label == max(a, b)] = min(a, b)
    return [tuple(keys[k] for k in np.flatnonzero(label == first)) for first in np.unique(label)]
