"""What keeps an answer from being given, and what to know of one that is."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from torchrl_sym.entries import Exchanged
from torchrl_sym.mujoco.infer.errors import InferenceError, Unexplained
from torchrl_sym.mujoco.infer.observations import Keys, ObservationFinder, unclear
from torchrl_sym.mujoco.infer.reasons import reason_of
from torchrl_sym.mujoco.infer.solve import Solution
from torchrl_sym.mujoco.verify.poses import can_touch

_ROUGH = 4e-6  # distance from an image, relative to the entry, that is more than rounding
_SHOWN = 8  # groups of entries that a note lists


def refuse(finder: ObservationFinder) -> None:
    """InferenceError unless every entry has an image that more samples would not change."""
    partial = {key: r for key, r in finder.representations().items() if not isinstance(key, Exchanged)}
    failed = [e for keys, s in finder.solutions.items() for e in _failures(finder, keys, s)]
    hidden = _hidden(finder)
    if hidden:
        raise InferenceError(
            "one state is observed in two ways: the environment remembers something that MuJoCo's state "
            "does not hold and an episode does not repeat (a command, a target, a phase), or draws noise. "
            "Hand it over with infer(..., memory=...), switch the noise off, or drop the entries with "
            "observe=...:",
            [*hidden, *failed],
            partial,
        )
    if failed:
        worst = max(entry.residual for entry in failed)
        near = f" (all are within {worst:.1g} of an entry)" if worst < 0.1 else ""
        raise InferenceError(
            f"{len(failed)} entries have no image. Is the model symmetric (audit says), and all that is "
            "observed? Drop them with observe=..., symmetrize the model, hand over commands and targets "
            f"with memory=..., allow for small asymmetries with tolerance=...{near}, or declare the key "
            "yourself:",
            failed,
            partial,
        )
    _refuse_untested(finder)


def _refuse_untested(finder: ObservationFinder) -> None:
    samples, subject = finder.samples, finder.sampler.subject
    alike = [f"{_name(k)} {ranges(m)}" for k, s in finder.solutions.items() for m in unclear(s)]
    if alike:
        raise InferenceError(
            f"too little happened to tell entries apart: {'; '.join(alike[:_SHOWN])} agree in all "
            f"{samples.count} states, and hardly ever change, or lie side by side as a scan of flat ground "
            "does; take more samples=..., starts in which they differ, or declare the key yourself"
        )
    still = {k: np.flatnonzero(s.constant) for k, s in finder.solutions.items() if s.constant.any()}
    forces = _forces_among(finder, still)
    if forces:
        raise InferenceError(
            f"contact forces or flags that nothing reached: {'; '.join(forces)} never changed in "
            f"{samples.count} states, but depend on them. Take more samples=..., starts in which these "
            "parts touch, or drop the entries with observe=..."
        )
    if still and not samples.contacts and can_touch(subject.model):
        raise InferenceError(
            f"contact was never reached in {samples.count} states, and entries of "
            f"{', '.join(map(_name, still))} never changed: contact forces or flags look like this. Take "
            "more samples=..., starts nearer to the ground, or drop the entries with observe=..."
        )


def _forces_among(finder: ObservationFinder, still: dict[Keys, np.ndarray]) -> list[str]:
    """Entries that never changed, but do if contact forces or sensor readings are other ones."""
    probed = finder.sampler.subject.probe(finder.sampler.generator) if still else None
    if probed is None:
        return []
    plain, other = probed
    out = []
    for keys, places in still.items():
        before, after = (torch.cat([x[k].flatten(1).double() for k in keys], 1)[0] for x in (plain, other))
        changed = [i for i in places.tolist() if abs(float(before[i] - after[i])) > 1e-9]
        out += [f"{_name(keys)} {ranges(changed)}"] if changed else []
    return out


def notes_on(finder: ObservationFinder) -> list[str]:
    """Entries that never changed, and those that always agree."""
    notes = []
    for keys, solution in finder.solutions.items():
        still = np.flatnonzero(solution.constant).tolist()
        if still:
            count = finder.samples.count
            notes.append(f"{_name(keys)} {ranges(still)} never changed in {count} states: stays as it is")
        rough = np.flatnonzero(solution.off > _ROUGH).tolist()
        if rough:
            notes.append(
                f"{_name(keys)} {ranges(rough)} agree with their images to {solution.off.max():.1g} only: "
                "a solver that stops early, contacts, or small asymmetries of the model"
            )
        if solution.twins:
            groups = "; ".join(ranges(members) for members in solution.twins[:_SHOWN])
            more = f" and {len(solution.twins) - _SHOWN} more" if len(solution.twins) > _SHOWN else ""
            notes.append(
                f"{_name(keys)}: {groups}{more} always agree up to a sign: several permutations fit; "
                "each stays if it can, or keeps its rank among them"
            )
    return notes


def _hidden(finder: ObservationFinder) -> list[Unexplained]:
    out = []
    for key, gap in finder.samples.hidden.items():
        size = finder.samples.values[key].abs().amax(dim=(0, 1)).clamp(min=1e-12)
        for i in np.flatnonzero(finder.hidden(key)).tolist():
            off = float(gap[i] / size[i])
            reason = f"differs by {off:.2g} between two observations of one state"
            out.append(Unexplained(key, i, finder.labels[key][i], finder.group.names[0], off, reason))
    return out


def _failures(finder: ObservationFinder, keys: Keys, solution: Solution) -> list[Unexplained]:
    data = torch.cat([finder.samples.values[key] for key in keys], -1).numpy()
    margin = np.concatenate([finder.margin(key) for key in keys])
    labels = [label for key in keys for label in finder.labels[key]]
    places = [(key, i) for key in keys for i in range(finder.samples.values[key].shape[-1])]
    out = []
    for i in np.flatnonzero(solution.failed.any(axis=0)).tolist():
        g = int(np.flatnonzero(solution.failed[:, i])[0])
        residual, reason = reason_of(data[0], data[g][:, i], i, float(margin[i]), labels)
        reason = solution.reasons.get((g, i), reason)
        out.append(Unexplained(*places[i], labels[i], finder.group.names[g], residual, reason))
    return out


def _name(keys: Keys) -> str:
    return str(keys[0] if len(keys) == 1 else keys)


def ranges(numbers: Sequence[int]) -> str:
    """``[0-3, 7]`` for 0, 1, 2, 3, 7."""
    runs = np.split(np.array(numbers), np.flatnonzero(np.diff(numbers) > 1) + 1)
    return "[" + ", ".join(f"{r[0]}-{r[-1]}" if len(r) > 1 else f"{r[0]}" for r in runs) + "]"
