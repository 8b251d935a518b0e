"""Observations in states and in their images, along episodes.

An episode begins in a state s and takes random actions a; its image under g begins in L_g s and takes the
actions K_g a. What the environment remembers (last actions, a history) follows from these. After every step
the simulation of the image is put into the exact image of the original's state, so that rounding and small
asymmetries of the model do not add up. The original is played twice: where the two differ, something else
decides what is observed, and no image can be known.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from tensordict import NestedKey
from torch import Tensor

from torchrl_sym.mujoco.infer.errors import InferenceError
from torchrl_sym.mujoco.infer.quantities import values_of
from torchrl_sym.mujoco.verify.states import touches
from torchrl_sym.mujoco.verify.subjects import Observation, Subject
from torchrl_sym.representations import Representation

SHORT, LONG, LAST = 4, 12, 8  # steps of most episodes, of every fourth; how many of a patient one are kept
PATIENT = 60  # steps of an episode in search of entries that have not changed yet
LOOKED_AT = 4  # rows of a batch in which contacts are counted


@dataclass
class Samples:
    """What was observed.

    Attributes:
        shapes: shape of every entry.
        dtypes: its numbers.
        values: ``(N, n, d)`` float64 of every key: of state n and its image under g.
        hidden: largest difference between two observations of one state, ``(d,)`` of every key.
        quantities: what MuJoCo computes, ``(n, k)``: to say what an entry seems to be.
        contacts: number of states in contact, of those that were looked at.
    """

    shapes: dict[NestedKey, torch.Size] = field(default_factory=dict)
    dtypes: dict[NestedKey, torch.dtype] = field(default_factory=dict)
    values: dict[NestedKey, Tensor] = field(default_factory=dict)
    hidden: dict[NestedKey, Tensor] = field(default_factory=dict)
    quantities: Tensor | None = None
    contacts: int = 0

    @property
    def count(self) -> int:
        """Number of states."""
        return 0 if self.quantities is None else len(self.quantities)


@dataclass
class _Episode:
    """Actions, and the states before and after each."""

    actions: list[Tensor]
    states: list[Any]


class Sampler:
    """Draws samples of an environment.

    Args:
        subject: the environment.
        action: K_g.
        generator: of actions and states.
    """

    def __init__(self, subject: Subject, action: Representation, generator: torch.Generator) -> None:
        self.subject, self.action, self.generator = subject, action, generator
        self.samples = Samples()
        self.episodes = 0

    def draw(self, count: int) -> Samples:
        """At least so many samples more."""
        goal, tries = self.samples.count + count, 0
        while self.samples.count < goal:
            self._add(LONG if self.episodes % 4 == 3 else SHORT, 0)
            tries += 1
            if tries > 10 + 4 * count:
                raise InferenceError(
                    "expected finite observations, got NaN or infinity, or an error of the physics, in "
                    "every episode"
                )
        return self.samples

    def draw_patiently(self) -> Samples:
        """One long episode of which the end is kept: old frames of a history begin to change."""
        self._add(PATIENT, PATIENT - LAST)
        return self.samples

    def _add(self, steps: int, skip: int) -> None:
        try:
            episode = self._original(steps)
            plays = [self._play(episode, g, skip) for g in (*range(self.action.group.order), 0)]
        except RuntimeError:  # dm_control's physics diverged: far too deep in a contact
            return
        finally:
            self.episodes += 1
        whole = {key: torch.stack([play[key] for play in plays]) for key in plays[0]}  # (N + 1, n, d)
        quantities = whole.pop("")[0]
        finite = torch.stack([x.isfinite().all(-1).all(0) for x in whole.values()]).all(0)
        for key, x in whole.items():
            values, gap = x[:-1, finite], (x[0] - x[-1])[finite].abs()
            if key in self.samples.values:
                values = torch.cat([self.samples.values[key], values], 1)
                gap = torch.cat([self.samples.hidden[key][None], gap])
            self.samples.values[key] = values
            self.samples.hidden[key] = gap.amax(0) if len(gap) else values.new_zeros(values.shape[-1])
        known = self.samples.quantities
        more = quantities[finite]
        self.samples.quantities = more if known is None else torch.cat([known, more])

    def _original(self, steps: int) -> _Episode:
        subject = self.subject
        subject.reset()
        start = subject.vary(subject.state(), self.generator, self.episodes)
        subject.begin(start)
        episode = _Episode([], [subject.state()])
        for step in range(steps):
            episode.actions.append(random_action(subject, self.generator))
            subject.step(episode.actions[-1])
            state = subject.state()
            rows = range(min(LOOKED_AT, subject.rows))
            self.samples.contacts += sum(touches(subject.model, state, row) for row in rows)
            episode.states.append(subject.disturb(state, self.generator) if step % 2 == 0 else state)
        return episode

    def _play(self, episode: _Episode, g: int, skip: int) -> dict[NestedKey, Tensor]:
        """Everything observed along the image of an episode, and under ``""`` what has a name."""
        subject = self.subject
        seen: list[dict[NestedKey, Tensor]] = []
        for step, state in enumerate(episode.states):
            image = subject.transform(state, g)
            if step == 0:
                observation = subject.begin(image)
            else:
                observation = subject.advance(self.action(episode.actions[step - 1], g), image)
            self._note_shapes(observation)
            if step >= skip:
                seen.append({key: x.flatten(1).double() for key, x in observation.items()})
                seen[-1][""] = values_of(subject, image)
        return {key: torch.cat([each[key] for each in seen]) for key in seen[0]}

    def _note_shapes(self, observation: Observation) -> None:
        for key, x in observation.items():
            if self.samples.shapes.setdefault(key, x.shape[1:]) != x.shape[1:]:
                raise InferenceError(
                    f"{key!r}: expected one shape, got {tuple(self.samples.shapes[key])} and then "
                    f"{tuple(x.shape[1:])}"
                )
            self.samples.dtypes[key] = x.dtype


def random_action(subject: Subject, generator: torch.Generator) -> Tensor:
    """A uniform action for each row."""
    low, high = box_of(subject)
    shape = (subject.rows, len(low))
    return low + (high - low) * torch.rand(shape, generator=generator, dtype=torch.float64)


def box_of(subject: Subject) -> tuple[Tensor, Tensor]:
    """Bounds to draw actions from: of unbounded ones, between -1 and 1."""
    low, high = subject.low, subject.high
    return torch.where(low.isfinite(), low, -1.0), torch.where(high.isfinite(), high, 1.0)
