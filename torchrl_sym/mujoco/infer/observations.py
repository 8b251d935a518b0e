"""How observations transform: from samples to a representation for every key."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from tensordict import NestedKey

from torchrl_sym.entries import Exchanged
from torchrl_sym.groups import PointGroup
from torchrl_sym.mujoco.infer.errors import InferenceError, Unexplained
from torchrl_sym.mujoco.infer.quantities import labels_of
from torchrl_sym.mujoco.infer.reasons import reason_of
from torchrl_sym.mujoco.infer.samples import Sampler, Samples
from torchrl_sym.mujoco.infer.solve import Solution, solve
from torchrl_sym.mujoco.model.types import Array
from torchrl_sym.mujoco.verify.poses import can_touch
from torchrl_sym.representations import Representation

_SINGLE = 4e-6  # what single precision rounds, relative to the entry
_FEW = 4  # samples in which an entry must differ, to be told from others that agree with it

Keys = tuple[NestedKey, ...]


class ObservationFinder:
    """Finds how every key of an observation transforms.

    Attributes:
        labels: what the entries of each key seem to be.
        notes: what to know of the result.
    """

    def __init__(self, sampler: Sampler, group: PointGroup, tolerance: float) -> None:
        self.sampler, self.group, self.tolerance = sampler, group, tolerance
        self.labels: dict[NestedKey, list[str]] = {}
        self.notes: list[str] = []

    def find(self, count: int) -> dict[NestedKey | Exchanged, Representation]:
        """Representations by key, or by keys that change places.

        Raises:
            InferenceError: as `infer` says.
        """
        samples = self.sampler.draw(count)
        self._check_kinds(samples)
        solutions = self._solutions(samples)
        settled = all(
            s.complete and not s.constant.any() and not self._unclear(s) for s in solutions.values()
        )
        if not settled:  # look further
            self.sampler.draw(count)
            samples = self.sampler.draw_patiently()
            solutions = self._solutions(samples)
        self._label(samples)
        found = self._representations(solutions, samples)
        self._refuse(solutions, samples, found)
        self._note(solutions, samples)
        return found

    def _margin(self, samples: Samples, key: NestedKey) -> Array:
        """Largest difference of each entry that counts as none."""
        size = samples.values[key].abs().amax(dim=(0, 1)).numpy()
        single = samples.dtypes[key] in (torch.float32, torch.float16, torch.bfloat16)
        return (max(self.tolerance, _SINGLE) if single else self.tolerance) * np.maximum(size, 1e-6)

    def _check_kinds(self, samples: Samples) -> None:
        for key, shape in samples.shapes.items():
            if samples.dtypes[key] == torch.uint8 and len(shape) > 1:
                raise InferenceError(
                    f"{key!r}: expected numbers of a state, got an image {tuple(shape)}; leave it out with "
                    "observe=..., and declare it with torchrl_sym.representations.image"
                )

    def _solutions(self, samples: Samples) -> dict[Keys, Solution]:
        """One for each key; those of keys that have none by themselves together, if that helps."""
        found = {(key,): self._solve(samples, (key,)) for key in samples.values}
        alone = [keys for keys, solution in found.items() if not solution.complete]
        if len(alone) < 2:
            return found
        together = tuple(key for keys in alone for key in keys)
        joint = self._solve(samples, together)
        for keys in _exchanged(joint, [samples.values[key].shape[-1] for key in together], together):
            if len(keys) > 1 and (part := self._solve(samples, keys)).complete:
                for key in keys:
                    del found[key,]
                found[keys] = part
        return found

    def _solve(self, samples: Samples, keys: Keys) -> Solution:
        """From two thirds of the samples, checked on the rest."""
        values = torch.cat([samples.values[key] for key in keys], -1).numpy()
        margin = np.concatenate([self._margin(samples, key) for key in keys])
        held_out = np.arange(values.shape[1]) % 3 == 2
        solution = solve(self.group, values[:, ~held_out], margin)
        test = values[:, held_out]
        off = np.abs(test - np.einsum("nk,gik->gni", test[0], solution.matrices)).max(axis=1, initial=0.0)
        solution.failed |= off > 3 * margin
        hidden = torch.cat([samples.hidden[key] for key in keys]).numpy() > margin
        solution.failed[1:] &= ~hidden
        return solution

    def _unclear(self, solution: Solution) -> bool:
        """Whether entries agree with others that hardly ever change."""
        return any(solution.events[members].min() < _FEW for members in solution.twins)

    def _label(self, samples: Samples) -> None:
        for key, x in samples.values.items():
            self.labels[key] = labels_of(samples.quantities, x[0].numpy(), self._margin(samples, key))

    def _representations(
        self, solutions: dict[Keys, Solution], samples: Samples
    ) -> dict[NestedKey | Exchanged, Representation]:
        found: dict[NestedKey | Exchanged, Representation] = {}
        for keys, solution in solutions.items():
            hidden = any((samples.hidden[key].numpy() > self._margin(samples, key)).any() for key in keys)
            if not solution.complete or hidden:
                continue
            representation = Representation(self.group, torch.as_tensor(solution.matrices))
            shapes = [tuple(samples.shapes[key]) for key in keys]
            if len(keys) == 1:
                found[keys[0]] = representation.unflatten(shapes[0])
            elif len(shapes[0]) == 1:
                found[Exchanged(*keys)] = representation
            else:
                found[Exchanged(*keys)] = representation.unflatten((len(keys), *shapes[0]))
        return found

    def _refuse(
        self,
        solutions: dict[Keys, Solution],
        samples: Samples,
        found: dict[NestedKey | Exchanged, Representation],
    ) -> None:
        partial = {key: r for key, r in found.items() if not isinstance(key, Exchanged)}
        hidden = self._hidden(samples)
        failed = [e for keys, s in solutions.items() for e in self._failures(keys, s, samples)]
        if hidden:
            raise InferenceError(
                "one state is observed in two ways: the environment remembers something that MuJoCo's "
                "state does not hold and an episode does not repeat (a command, a target, a phase), or draws "
                "noise. Hand it over with infer(..., memory=...), switch the noise off, or drop the "
                "entries with observe=...:",
                [*hidden, *failed],
                partial,
            )
        if failed:
            raise InferenceError(
                f"{len(failed)} images have not been found. Is the model symmetric (audit says), and all "
                "that is observed? Drop the entries with observe=..., symmetrize the model, allow for "
                "small asymmetries with tolerance=..., hand over commands and targets with memory=..., or "
                "declare the key yourself:",
                failed,
                partial,
            )
        unclear = [
            members for s in solutions.values() for members in s.twins if s.events[members].min() < _FEW
        ]
        if unclear:
            names = [
                f"{keys}[{m}]"
                for keys, m in (
                    (k, m) for k, s in solutions.items() for m in s.twins if s.events[m].min() < _FEW
                )
            ]
            raise InferenceError(
                f"too little happened to tell entries apart: {'; '.join(names[:6])} agree in all "
                f"{samples.count} states, and differ from their usual value in fewer than {_FEW}; take "
                "more samples=..., or starts in which they change"
            )
        still = [keys for keys, s in solutions.items() if (s.constant).any()]
        if still and not samples.contacts and can_touch(self.sampler.subject.model):
            raise InferenceError(
                f"contact was never reached in {samples.count} states, and entries of {still} never "
                "changed: contact forces or flags look like this. Take more samples=..., starts nearer to "
                "the ground, or drop the entries with observe=..."
            )

    def _hidden(self, samples: Samples) -> list[Unexplained]:
        out = []
        for key, gap in samples.hidden.items():
            size = samples.values[key].abs().amax(dim=(0, 1)).clamp(min=1e-12)
            for i in np.flatnonzero(gap.numpy() > self._margin(samples, key)).tolist():
                off = float(gap[i] / size[i])
                reason = f"differs by {off:.2g} between two observations of one state"
                out.append(Unexplained(key, i, self.labels[key][i], self.group.names[0], off, reason))
        return out

    def _failures(self, keys: Keys, solution: Solution, samples: Samples) -> list[Unexplained]:
        data = torch.cat([samples.values[key] for key in keys], -1).numpy()
        margin = np.concatenate([self._margin(samples, key) for key in keys])
        labels = [label for key in keys for label in self.labels[key]]
        places = [(key, i) for key in keys for i in range(samples.values[key].shape[-1])]
        out = []
        for i in np.flatnonzero(solution.failed.any(axis=0)).tolist():
            g = int(np.flatnonzero(solution.failed[:, i])[0])
            residual, reason = reason_of(data[0], data[g][:, i], i, float(margin[i]), labels)
            reason = solution.reasons.get((g, i), reason)
            out.append(Unexplained(*places[i], labels[i], self.group.names[g], residual, reason))
        return out

    def _note(self, solutions: dict[Keys, Solution], samples: Samples) -> None:
        for keys, solution in solutions.items():
            name = keys[0] if len(keys) == 1 else keys
            still = np.flatnonzero(solution.constant).tolist()
            if still:
                self.notes.append(
                    f"{name} {ranges(still)} never changed in {samples.count} states: stays as it is"
                )
            if solution.twins:
                groups = "; ".join(", ".join(map(str, members)) for members in solution.twins[:8])
                more = f" and {len(solution.twins) - 8} more" if len(solution.twins) > 8 else ""
                self.notes.append(
                    f"{name}: entries {groups}{more} always agree up to a sign, so that several "
                    "permutations fit; of these each stays, or keeps its order among them"
                )


def _exchanged(solution: Solution, sizes: Sequence[int], keys: Keys) -> list[Keys]:
    """Which keys have entries that change places."""
    owner = np.repeat(np.arange(len(keys)), sizes)
    label = np.arange(len(keys))
    for _, i, j in np.argwhere(solution.matrices):
        a, b = label[owner[i]], label[owner[j]]
        label[label == max(a, b)] = min(a, b)
    return [tuple(keys[k] for k in np.flatnonzero(label == first)) for first in np.unique(label)]


def ranges(numbers: Sequence[int]) -> str:
    """``[0-3, 7]`` for 0, 1, 2, 3, 7."""
    runs = np.split(np.array(numbers), np.flatnonzero(np.diff(numbers) > 1) + 1)
    return "[" + ", ".join(f"{r[0]}-{r[-1]}" if len(r) > 1 else f"{r[0]}" for r in runs) + "]"
