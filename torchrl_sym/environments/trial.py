"""Transforms as a function of observations and actions, which commutes with the group or does not.

Copies of the transforms are put around an environment that plays back given observations, and asked:

    F(L_g x) = L_g F(x)   for every element g, and observations x of all sizes

L_g is declared for what comes out, F(x). x are the entries of the environment inside, which nobody has
declared. Where each entry of F(x) depends on one of x only (most transforms move and scale), L_g follows it
there. Entries that are mixed can be judged where the environment inside has a declared entry of the same
name. Of what is left nothing is known. With actions it is the other way round: outside is x, inside F(x).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor
from torchrl.envs import Transform, TransformedEnv

from torchrl_sym.environments.playback import Layout, copies, play

Image = Callable[[TensorDictBase, int], TensorDictBase]
"""The image of declared entries under an element, by index."""

_STEPS = 2  # observations that are played: one after a reset, and another for what looks back
_SIZES = (0.1, 1.0, 10.0, 100.0)  # of observations without bounds: a clip acts at some of them


@dataclass(frozen=True)
class Declared:
    """What is known of an environment's entries.

    Attributes:
        keys: the entries.
        image: what an element makes of them.
        names: of the elements.
    """

    keys: list[NestedKey]
    image: Image
    names: Sequence[str]


class Trial:
    """Copies of transforms as a function F from vectors to vectors, and what is known of both sides.

    Its sources are what the environment inside observes and the actions that are sent from outside; its
    results are what is observed outside and the actions that arrive inside.

    Args:
        env: the environment with its transforms.
        transforms: those to try out, the innermost first.
        declared: what is known outside.

    Attributes:
        is_random: the same sources have had different results, so that nothing else is known.
        judged: of which results it is known what they should be, ``(results,)``.
        undecided: whether there are declared entries among the others.

    Raises:
        Exception: one of the transforms cannot be tried out.
    """

    def __init__(self, env: TransformedEnv, transforms: Sequence[Transform], declared: Declared) -> None:
        self.env, self.transforms, self.declared = env, list(transforms), declared
        base = env.base_env
        self.raw = Layout(base.full_observation_spec, base.batch_size)
        self.taken = Layout(base.full_action_spec, base.batch_size)
        self.seen = Layout(env.full_observation_spec, env.batch_size)
        self.sent = Layout(env.full_action_spec, env.batch_size)
        layouts = (self.raw, self.taken, self.seen, self.sent)
        halves = (torch.float16, torch.bfloat16)
        self.is_single = not any(s.dtype in halves for each in layouts for s in each.specs.values())

        torch.default_generator.manual_seed(0)  # not CUDA's, which it might initialise
        self.plain = self._draw(1.0)
        self.state = copies(transforms, env)
        # statistics that nobody would call symmetric, the same for all rows
        row = self.plain[(slice(None), *[slice(0, 1)] * len(env.batch_size))]
        self._play(self.state, (1 + 2 * row.abs()).expand_as(self.plain), 0)
        for transform in self.state:
            transform.eval()
            freeze = getattr(transform, "freeze", None)
            if callable(freeze):
                freeze()

        self.result = self(self.plain)
        self.present = ~_anywhere(self.result.isnan())
        self.is_random = bool((self._differs(self(self.plain, seed=1)) & self.present).any())
        if not self.is_random:
            self._find_sources([self._opposite(), *map(self._draw, _SIZES)])

    def __call__(self, sources: Tensor, seed: int = 0) -> Tensor:
        """Results ``(*B, results)`` of sources ``(steps, *B, sources)``, always from the same state."""
        return self._play(copies(self.state, self.env), sources, seed)

    def _play(self, transforms: Sequence[Transform], sources: Tensor, seed: int) -> Tensor:
        raw, sent = sources.split([self.raw.dim, self.sent.dim], -1)
        observations = [self.raw.cast(each) for each in raw]
        actions = [self.sent.cast(each) for each in sent[1:]]
        torch.default_generator.manual_seed(seed)
        after, received = play(transforms, self.env.base_env, observations, actions)
        return torch.cat([self.seen.flatten(after), self.taken.flatten(received)], -1)

    def _draw(self, size: float) -> Tensor:
        return torch.cat([self.raw.draw(_STEPS, size), self.sent.draw(_STEPS, size)], -1)

    def _opposite(self) -> Tensor:
        raw, sent = self.plain.split([self.raw.dim, self.sent.dim], -1)
        return torch.cat([self.raw.opposite(raw), self.sent.opposite(sent)], -1)

    def _differs(self, result: Tensor) -> Tensor:
        return _anywhere((result != self.result) & ~result.isnan())

    def _find_sources(self, others: Sequence[Tensor]) -> None:
        """Number the sources; change those whose number has a one at a bit, then those that have a zero.

        Others are values to change them to: a flag, a sign, a clipped entry does not notice every change.
        """
        size = self.seen.dim
        known = self.seen.mask(self.declared.keys)
        wanted = torch.cat([known, torch.ones(self.taken.dim, dtype=torch.bool)]) & self.present
        numbers = torch.arange(1, self.plain.shape[-1] + 1)  # 0 for no source
        bits = len(numbers).bit_length()
        ones, zeros = torch.zeros(2, self.result.shape[-1], dtype=torch.int64)
        for other in others:
            for bit in range(bits):
                has = (numbers >> bit & 1).bool()
                ones |= self._differs(self(torch.where(has, other, self.plain))).long() << bit
                zeros |= self._differs(self(torch.where(has, self.plain, other))).long() << bit
            if (ones | zeros)[wanted].eq((1 << bits) - 1).all():
                break
        source = torch.where(ones ^ zeros == (1 << bits) - 1, ones, 0) - 1  # -1: none, or several
        several = (ones | zeros != 0) & (source < 0)

        followed = self._closed(known & ~several[:size]) & (source[:size] >= 0)
        self.observed = _Links(source[:size], followed, len(numbers))
        sent = torch.cat([self.raw.mask([]), self.sent.mask(self.declared.keys)])
        arrives = (source[size:] >= 0) & sent[source[size:]]
        self.arrived = _Links(source[size:] - self.raw.dim, arrives, self.sent.dim)

        self.direct = [key for key in self.raw.events if self._is_direct(key)]
        direct = torch.cat([self.raw.mask(self.direct), self.sent.mask([])])
        self.covered = self.observed.has_result | sent | direct
        hidden = [self._differs(self(torch.where(self.covered, self.plain, other))) for other in others]
        unknown = torch.stack(hidden).any(0)
        self.judged = torch.cat([known & ~unknown[:size], arrives]) & self.present
        self.undecided = bool((known & ~self.judged[:size]).any())

    def _closed(self, followed: Tensor) -> Tensor:
        """Those results to which no element brings one of the known others."""
        while True:
            others = torch.randn(len(followed), dtype=torch.float64) * ~followed
            images = torch.stack([self._outside(others, g) for g in range(len(self.declared.names))])
            reached = followed & _anywhere(images != 0)
            if not reached.any():
                return followed
            followed = followed & ~reached

    def _is_direct(self, key: NestedKey) -> bool:
        """Whether an entry inside has the name and the shape of a declared one."""
        try:
            entry = self.raw.split(torch.zeros(self.raw.dim, dtype=torch.float64), [key])
            return key in self.declared.keys and self.declared.image(entry, 0) is not None
        except (KeyError, ValueError):
            return False

    def _outside(self, seen: Tensor, g: int) -> Tensor:
        """Image of what is observed outside."""
        return self._imaged(self.seen, self.declared.keys, seen, g)

    def _sent(self, sent: Tensor, g: int) -> Tensor:
        """Image of actions that are sent."""
        return self._imaged(self.sent, self.declared.keys, sent, g)

    def _inside(self, sources: Tensor, g: int) -> Tensor:
        """Image of what the environment inside observes, from all sources."""
        size = self.raw.dim
        moved = self.observed.back(self._outside(self.observed.forth(sources), g))
        direct = self._imaged(self.raw, self.direct, sources[..., :size], g)
        return torch.where(self.observed.has_result[:size], moved[..., :size], direct)

    def _taken(self, taken: Tensor, g: int) -> Tensor:
        """Image of actions that arrive inside."""
        moved = self.arrived.forth(self._sent(self.arrived.back(taken), g))
        return torch.where(self.arrived.chosen, moved, taken)

    def _imaged(self, layout: Layout, keys: Sequence[NestedKey], rows: Tensor, g: int) -> Tensor:
        entries = layout.split(rows.nan_to_num(), keys)
        return rows if entries.is_empty() else layout.replace(rows, self.declared.image(entries, g))

    def violations(self) -> Iterator[str]:
        """What F(L_g x) is and L_g F(x) is not, in words."""
        for size in _SIZES:
            sources = self._draw(size)
            seen, taken = self(sources).split([self.seen.dim, self.taken.dim], -1)
            sent = sources[..., self.raw.dim :]
            for g, name in list(enumerate(self.declared.names))[1:]:
                got = self(torch.cat([self._inside(sources, g), self._sent(sent, g)], -1))
                wanted = torch.cat([self._outside(seen, g), self._taken(taken, g)], -1)
                wrong = self.judged & ~self._close(got, wanted)
                if wrong.any():
                    yield self._described(got, wanted, wrong, name)

    def _close(self, got: Tensor, wanted: Tensor) -> Tensor:
        """Which results agree, to four digits of their size, ``(results,)``."""
        size = torch.maximum(got.abs(), wanted.abs()).nan_to_num(0.0, 0.0)
        size = size.reshape(-1, got.shape[-1]).amax(0)
        relative, rounding = (1e-4, 3e-6) if self.is_single else (3e-2, 1e-2)
        bound = relative * size + rounding * (size * self.judged).amax() + 1e-6
        same = ((got - wanted).abs() <= bound) | (got == wanted) | got.isnan()
        return same.reshape(-1, got.shape[-1]).all(0)

    def _described(self, got: Tensor, wanted: Tensor, wrong: Tensor, name: str) -> str:
        difference = torch.where(wrong, (got - wanted).abs(), 0.0).reshape(-1, len(wrong))
        row, index = divmod(int(difference.nan_to_num(torch.inf).argmax()), len(wrong))
        a, b = (float(x.reshape(-1, len(wrong))[row, index]) for x in (got, wanted))
        is_action = index >= self.seen.dim
        layout, place = (self.taken, index - self.seen.dim) if is_action else (self.seen, index)
        key, entry = layout.locate(place)
        what = "an action" if is_action else "a state"
        return f"for the image of {what} under {name!r}, entry {entry} of {key!r} is {a:.4g}, not {b:.4g}"

    @property
    def inside(self) -> Declared:
        """What is known of the environment inside."""
        sides = ((self.raw, self.covered[: self.raw.dim]), (self.taken, self.arrived.chosen))
        keys = [key for side, known in sides for key in side.events if known[side.mask([key])].all()]
        return Declared(keys, self._image_inside, self.declared.names)

    def _image_inside(self, td: TensorDictBase, g: int) -> TensorDictBase:
        out = td.copy()
        sources = torch.cat([self.raw.flatten(td), torch.zeros(*td.batch_size, self.sent.dim)], -1)
        raw = self._inside(sources.nan_to_num(), g)
        taken = self._taken(self.taken.flatten(td), g)
        for layout, image in ((self.raw, raw), (self.taken, taken)):
            for key, value in layout.split(image).items(True, True):
                if key in td.keys(True, True):
                    out.set(key, value)
        return out


def _anywhere(flags: Tensor) -> Tensor:
    return flags.reshape(-1, flags.shape[-1]).any(0)


class _Links:
    """Which sources go to which results.

    Args:
        source: of every result.
        chosen: the results that have one.
        size: number of sources.
    """

    def __init__(self, source: Tensor, chosen: Tensor, size: int) -> None:
        self.source, self.chosen = source[chosen], chosen
        self.count = torch.zeros(size, dtype=torch.float64).index_add(
            0, self.source, torch.ones(len(self.source), dtype=torch.float64)
        )
        self.has_result = self.count > 0

    def forth(self, sources: Tensor) -> Tensor:
        """Results ``(..., results)`` as they are moved, not scaled; zero where there is no link."""
        results = sources.new_zeros(*sources.shape[:-1], len(self.chosen))
        results[..., self.chosen] = sources[..., self.source]
        return results

    def back(self, results: Tensor) -> Tensor:
        """Sources ``(..., size)``, the mean where one has several results; zero where it has none."""
        sources = results.new_zeros(*results.shape[:-1], len(self.count))
        return sources.index_add(-1, self.source, results[..., self.chosen]) / self.count.clamp(min=1)
