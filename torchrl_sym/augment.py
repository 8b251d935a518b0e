"""Symmetric copies of a batch: the paper's data augmentation as a TorchRL transform.

Eq. (sym-aug) of Mittal et al. adds to every row (s, a) of a batch its copies (L_g[s], K_g[a]) and keeps the
ORIGINAL log-probability, advantage and return, since a copy is a sample of the transformed policy pi^g,
whose probability of it is the original one. So a copy maps the declared observations and actions and
shares everything else. :class:`SymmetryAugment` is this function of a batch and nothing more: what it does
depends on its settings and on the batch. :class:`~torchrl_sym.SymmetryReplayBuffer` is the buffer for it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, Literal, cast

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential
from tensordict.utils import expand_as_right, unravel_key
from torch import Tensor
from torchrl.envs.transforms import Transform

from torchrl_sym import checks
from torchrl_sym.entries import split
from torchrl_sym.memory import Memory, is_recurrent_state, memory_by_name
from torchrl_sym.symmetry import Elements, Symmetry, check_batch, check_symmetry

TRAJECTORY = ("collector", "traj_ids")


class SymmetryAugment(Transform):
    """Adds the symmetric copies of every row, sharing log-probability, advantage and return.

    Modes of use:

    - stand-alone: ``augment(batch)``;
    - as ``postproc`` of any collector; frames are counted before it, so budgets keep their meaning;
    - as transform of a :class:`~torchrl.data.ReplayBuffer`, when sampling (``when="sample"``: a minibatch
      of B rows becomes N * B) or when extending (``when="extend"``: copies are stored, and shuffled
      independently). It sees the batch and not the buffer: size the storage for N * B rows and keep
      trajectory ids where slices are sampled, or use :class:`~torchrl_sym.SymmetryReplayBuffer`, which
      checks both. :class:`~torchrl.data.TensorDictReplayBuffer` allows no other number of rows when
      sampling: use ``layout="stack"`` or ``elements="random"`` there, or again the buffer of this package.

    It cannot be appended to an environment. Advantages must be computed before it: a value function
    evaluated on copies would not give Eq. (sym-aug).

    Args:
        symmetry: what transforms how.

    Keyword Args:
        elements: ``"all"``; names of a subset (the identity is always kept, first); or ``"random"``:
            every row is mapped by one uniformly drawn element. This has the same expected gradient as
            ``"all"`` at 1/N of the cost. Rows that may be read in order share an element: those of a
            trajectory, if the batch has ``("collector", "traj_ids")``, and those of a sequence of a
            batch ``[B, T]``, if it has ``is_init`` or a recurrent state.
        layout: ``"cat"``: ``[B, ...]`` becomes ``[N * B, ...]``, group-major, originals first.
            ``"stack"``: ``[*B]`` becomes ``[*B, N]``.
        when: in a replay buffer, at ``"sample"`` or at ``"extend"`` time.
        select: keys to keep, so that entries nobody reads are not copied N times. Defaults to all.
        log_prob_from: an actor that re-evaluates the log-probability of the copies. This is the NAIVE
            rule that the paper argues against; it needs the policy that collected the data, so use it
            before any update (stand-alone, postproc or extend time).

    Raises:
        KeyError: the batch has an entry that the symmetry does not know, or lacks a declared one; or
            there is no such element.
        ValueError: an argument that is none of those above.
        TypeError: an argument of another type, or of a name that is not above.
        RuntimeError: used where it cannot work; the message says what to use instead.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_sym import PointGroup, Symmetry, SymmetryAugment
        >>> from torchrl_sym.representations import pseudoscalar
        >>> group = PointGroup.reflection("x")
        >>> sign = pseudoscalar(group)
        >>> augment = SymmetryAugment(Symmetry(group, {"observation": sign * 3, "action": sign}))
        >>> batch = TensorDict(
        ...     observation=torch.ones(4, 3),
        ...     action=torch.ones(4, 1),
        ...     advantage=torch.ones(4, 1),
        ...     batch_size=[4],
        ... )
        >>> augment(batch)["action"].flatten()
        tensor([ 1.,  1.,  1.,  1., -1., -1., -1., -1.])
    """

    symmetry: Symmetry
    log_prob_from: ProbabilisticTensorDictSequential | None

    @checks.near_names
    def __init__(
        self,
        symmetry: Symmetry,
        *,
        elements: Elements = "all",
        layout: Literal["cat", "stack"] = "cat",
        when: Literal["sample", "extend"] = "sample",
        select: Sequence[NestedKey] | None = None,
        log_prob_from: ProbabilisticTensorDictSequential | None = None,
    ) -> None:
        check_symmetry(symmetry)
        checks.one_of("layout", layout, ("cat", "stack"))
        checks.one_of("when", when, ("sample", "extend"))
        if select is not None:
            select = [checks.key("select", key) for key in checks.sequence("select", select, of="keys")]
            if not select:
                raise ValueError("select: expected keys to keep, got none; leave it out to keep them all")
        if log_prob_from is not None:
            checks.instance("log_prob_from", log_prob_from, ProbabilisticTensorDictSequential)
        super().__init__(in_keys=symmetry.keys(), out_keys=symmetry.keys())
        self.random = isinstance(elements, str) and elements == "random"
        self.elements = symmetry.elements(elements)
        self.layout = layout
        self.when = when
        self.select = select
        # the caller's, not submodules: collectors move their postproc
        self.__dict__.update(symmetry=symmetry, log_prob_from=log_prob_from)
        self.memory = memory_by_name(symmetry)

    def set_container(self, container: Any) -> None:
        """Refuse environments: they have one action per state, so no batch to grow."""
        super().set_container(container)
        refuse_environment(self)
        if self.log_prob_from is not None and self.when == "sample":
            raise RuntimeError(
                "log_prob_from needs the policy that collected the data, which has changed by the time "
                "a buffer is sampled; use when='extend' in a buffer, or call the transform on its own"
            )

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Augment a batch (a no-op with ``when="extend"``, and for a single record)."""
        if self.when != "sample" or check_batch(tensordict).batch_dims == 0:
            return tensordict
        return self.augment(tensordict)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        # _inv_call and not inv: Compose, which every buffer wraps around us, calls only the former
        if self.when != "extend":
            return tensordict
        if check_batch(tensordict).batch_dims == 0:
            raise RuntimeError(
                "a single row has no place for its symmetric copies; use buffer.extend(row.unsqueeze(0)) "
                "instead of add, or when='sample'"
            )
        return self.augment(tensordict)

    def augment(self, tensordict: TensorDictBase) -> TensorDictBase:
        """The augmented batch; the input is not modified.

        Entries that copies share may also share memory, among each other and with the input.

        Args:
            tensordict: batch ``[B, ...]`` with at least one batch dimension.

        Returns:
            ``[N * B, ...]`` or ``[*B, N]`` as by ``layout``, or ``[B, ...]`` with random elements.
        """
        td = check_batch(tensordict)
        if self.select is not None:
            td = td.select(*self.select)
        if td.batch_dims == 0:
            raise RuntimeError(
                "expected at least one batch dimension, got batch size []; use td.unsqueeze(0)"
            )
        check_declared(self.symmetry, td, self.select)
        check_memory(self.memory, tensordict)
        if self.random:
            element = self._draw(td, trajectories=tensordict.get(TRAJECTORY, None))
            out = self.memory.rebuild(self.symmetry.per_row(td, element), element)
            self._reevaluate(out, originals=0)
            separate_trajectories(out, self.symmetry.group.order, element)
            return out
        orbit = self.memory.rebuild(self.symmetry.orbit(td, self.elements))
        self._reevaluate(orbit, originals=1)
        separate_trajectories(orbit, len(self.elements))
        return self._laid_out(orbit, td.names)

    def _laid_out(self, orbit: TensorDictBase, names: list[str | None]) -> TensorDictBase:
        if self.layout == "stack":
            for dim in range(len(names)):  # permute, in steps that torch.compile can follow
                orbit = orbit.transpose(dim, dim + 1)
            out, names = orbit, [*names, None]
        else:
            out = cast(TensorDictBase, orbit.flatten(0, 1))
        if any(name is not None for name in names):  # flatten drops them; value estimators look for "time"
            out.names = names
        return out

    def _draw(self, td: TensorDictBase, trajectories: Tensor | None) -> Tensor:
        """Random elements ``[*B]``: one for all rows of a sequence that may be read in order."""
        names = td.names
        time = names.index("time") if "time" in names else td.batch_dims - 1
        if td.batch_dims > 1 and _has_memory(td):
            drawn = self.symmetry.draw(td.transpose(time, -1), per_sequence=True)
            return drawn.transpose(time, -1)
        drawn = self.symmetry.draw(td)
        if trajectories is not None:
            ids = trajectories.reshape(td.batch_size).transpose(0, time)
            starts = ids.diff(dim=0, prepend=ids[:1]) != 0
            return same_along(drawn.transpose(0, time), starts).transpose(0, time)
        if _has_memory(td):
            raise RuntimeError(
                "a recurrent network reads this flat batch in order (it has is_init or a recurrent state), "
                f"and elements='random' must not change within a sequence; keep {TRAJECTORY}, reshape the "
                "batch to [B, T], sample from a SymmetryReplayBuffer, which knows its slices, or leave "
                "is_init out with select=[...] if no network has memory"
            )
        return drawn

    def _reevaluate(self, batch: TensorDictBase, originals: int) -> None:
        actor = self.log_prob_from
        if actor is None or len(batch) == originals:
            return
        copies = cast(TensorDictBase, batch[originals:])
        with torch.no_grad():
            state = copies.select(*actor.in_keys, *actor.dist_sample_keys)
            log_prob = actor.get_dist(state).log_prob(state.get(actor.dist_sample_keys[0]))
        key = actor.log_prob_keys[0]  # set, not written in place: the copies share the original's memory
        batch.set(key, torch.cat([batch.get(key)[:originals], log_prob]))


def check_declared(
    symmetry: Symmetry, td: TensorDictBase, select: Sequence[NestedKey] | None = None
) -> None:
    """KeyError if a batch lacks an entry that a strict symmetry declares (of those selected).

    But for memory: where it is left out, networks begin from zero with originals and copies alike.
    """
    present = {unravel_key(key) for key in td.keys(True, True)}  # keys of a lazy stack find no nested ones
    declared = symmetry.keys()
    wanted = declared if select is None else [key for key in declared if key in select]
    missing = [key for key in wanted if key not in present and not is_recurrent_state(key)]
    if missing and symmetry.strict:
        raise KeyError(
            f"the batch lacks {missing}, which the symmetry declares; it has "
            f"{sorted(map(str, present))}; rename the symmetry's key, or pass select=[...]"
        )


def check_memory(memory: Memory, td: TensorDictBase) -> None:
    """ValueError if copies of a batch would begin from a memory that they do not have."""
    if any(td.get(key, None) is not None for key in memory.rebuilt):
        resets = tuple(key for key in memory.resets if td.get(key, None) is not None)
        memory = dataclasses.replace(memory, resets=resets)
        time = td.names.index("time") if "time" in td.names else td.batch_dims - 1
        memory.prepare(td.transpose(time, -1) if td.batch_dims > 1 else td, [("collector", "mask")])


def separate_trajectories(td: TensorDictBase, count: int, copy: Tensor | None = None) -> None:
    """Make copies trajectories of their own: slices must not run from one into the next.

    Args:
        td: batch ``[N, *B]`` of copies, or rows of any; modified.
        count: number of copies N.
        copy: which of them each row is, below N. Defaults to its place in the first dimension.
    """
    ids = td.get(TRAJECTORY, None)
    if ids is not None:
        copy = torch.arange(count, device=ids.device) if copy is None else copy.to(ids.device)
        td.set(TRAJECTORY, ids * count + expand_as_right(copy, ids))


def same_along(drawn: Tensor, starts: Tensor) -> Tensor:
    """One of the drawn numbers for all of a run along the first dimension; ``starts`` begins a new one."""
    return drawn.gather(0, starts.cumsum(0))


def refuse_environment(transform: Transform) -> None:
    """RuntimeError if a transform that changes the batch is in an environment."""
    if transform.parent is not None:
        raise RuntimeError(
            f"{type(transform).__name__} changes the batch and cannot be appended to an environment; use "
            "it in a replay buffer, as a collector's postproc, on its own, or use SymmetricClipPPOLoss"
        )


def _has_memory(td: TensorDictBase) -> bool:
    """Whether a recurrent network may read this batch: it has ``is_init`` or a recurrent state."""
    return any(split(key)[1] == "is_init" or is_recurrent_state(key) for key in td.keys(True, True))
