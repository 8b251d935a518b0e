"""Memory: what a symmetric copy may know of its past.

A recurrent policy reads, beside the observation, the memory of its past: h_t after the history
(s_0, ..., s_{t-1}). A copy needs the memory after the mirrored history (L_g s_0, ..., L_g s_{t-1}). For an
ordinary LSTM or GRU this is no linear image of the stored h_t, so no representation of it exists; it has to
be rebuilt, by reading the mirrored history. TorchRL's recurrent modules do that inside a loss: they begin
with the memory that is stored at a *start*, which is the first step of a sequence ``[B, T]`` and every step
where ``is_init`` is set, and run along time. So a copy is

- exact where it starts from zero memory, as an episode does;
- approximate after a burn-in: the first steps after any other start rebuild the memory from zero and do not
  count;
- exact everywhere if the memory itself is equivariant: a copy then begins with the image of what is stored.

The flag ``is_init`` alone does not tell: ``SliceSampler`` sets it at the first step of every slice,
wherever it was cut. The stored memory does: it is zero where an episode begins, and nowhere else.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import unravel_key
from torch import Tensor

from torchrl_sym import checks
from torchrl_sym.entries import join, split
from torchrl_sym.symmetry import Symmetry

_REMEDIES = (
    "begin sequences where episodes begin (Collector(reset_at_each_iter=True), or a SliceSampler of whole "
    "episodes), let the first k steps after other starts rebuild it (burn_in=k), or use a policy whose "
    "memory is equivariant and declare its representation"
)


@dataclass(frozen=True)
class Memory:
    """How the copies of a batch get their memory; for networks without memory, every method does nothing.

    A network that reads ``is_init`` is taken to run along time by itself, as TorchRL's modules do.

    Args:
        rebuilt: entries that copies begin from zero: memory that is declared invariant.
        resets: the networks' ``is_init`` entries.
        burn_in: steps after a start from other than zero that do not count.
        recurrent: whether some network has memory, or reads ``is_init``.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.modules import GRUModule
        >>> from torchrl_sym import PointGroup, Symmetry
        >>> from torchrl_sym.representations import invariant, pseudoscalar
        >>> group = PointGroup.reflection("x")
        >>> network = GRUModule(input_size=1, hidden_size=2, in_key="observation", out_key="feature")
        >>> memory_keys(network), reset_keys(network)
        (['recurrent_state'], ['is_init'])
        >>> entries = {"observation": pseudoscalar(group), "recurrent_state": invariant(group, 2)}
        >>> memory = Memory.of(Symmetry(group, entries), [network], burn_in=2)
        >>> batch = TensorDict(is_init=torch.zeros(1, 5, 1, dtype=torch.bool), batch_size=[1, 5])
        >>> batch["recurrent_state"] = torch.ones(1, 5, 1, 2)  # of an episode that began earlier
        >>> memory.prepare(batch, [("collector", "mask")])["collector", "mask"]
        tensor([[False, False,  True,  True,  True]])
    """

    rebuilt: tuple[NestedKey, ...] = ()
    resets: tuple[NestedKey, ...] = ()
    burn_in: int = 0
    recurrent: bool = False

    @classmethod
    def of(
        cls,
        symmetry: Symmetry,
        networks: Iterable[TensorDictModuleBase | None],
        *,
        burn_in: int = 0,
        copies: bool = True,
    ) -> Memory:
        """What is to be done for some networks.

        Args:
            symmetry: must declare their memory.
            networks: those that read the batch; ``None`` is left out.
            burn_in: see above.
            copies: whether there are any besides the originals.

        Raises:
            KeyError: a memory that is not declared.
            ValueError: a burn-in without a memory to rebuild, or a memory to rebuild in a network that does
                not read where its memory starts.
        """
        burn_in = checks.whole("burn_in", burn_in, 0)
        networks = [network for network in networks if network is not None]
        keys = _distinct(key for network in networks for key in memory_keys(network))
        missing = [key for key in keys if key not in symmetry]
        if missing:
            raise KeyError(
                f"a network reads the memory {missing}, which this symmetry does not declare: add it as "
                "invariant(group, d), d its size, which says that copies begin from zero memory and "
                "rebuild it; or with its representation if the network's memory is equivariant"
            )

        rebuilt = [key for key in keys if symmetry[key].is_trivial]
        if burn_in and not rebuilt:
            raise ValueError(
                f"burn_in: expected 0, got {burn_in}: no network has a memory that copies would rebuild"
            )
        if not (copies or burn_in):
            return cls()

        for network in networks:
            lost = [key for key in memory_keys(network) if key in rebuilt]
            if lost and not reset_keys(network):
                raise ValueError(
                    f"a network reads the memory {lost} but not 'is_init', so that nobody can tell where "
                    "it starts; let it run along time and begin anew where 'is_init' is set, as LSTMModule "
                    "and GRUModule do, or declare the representation of an equivariant memory"
                )
        resets = _distinct(key for network in networks for key in reset_keys(network))
        return cls(tuple(rebuilt), tuple(resets), burn_in, bool(keys or resets))

    def prepare(self, batch: TensorDictBase, mask_keys: Sequence[NestedKey]) -> TensorDictBase:
        """The batch as sequences ``[*B, T]``, its burn-in masked out, after a check that copies are right.

        On a CPU the errors below are raised here. An accelerator would have to wait for the answer: there
        the check is asynchronous and fails the next synchronisation (``torch._assert_async``).

        Args:
            batch: all that is known of the originals, as ``("collector", "traj_ids")`` and
                ``("next", "done")`` tell where one sequence runs on into another. It is not modified.
            mask_keys: entries by which the loss leaves out steps; the first one takes the burn-in.

        Raises:
            KeyError: no ``is_init``.
            ValueError: copies would begin from a wrong memory; steps of different sequences follow each
                other without a start; nothing would be left to count.
        """
        if not self.recurrent:
            return batch
        batch = _as_sequences(batch)
        starts = self._starts(batch)
        valid = torch.ones_like(starts)
        for key in mask_keys:
            mask = batch.get(key, None)
            valid = valid if mask is None else valid & _per_step(mask, batch).all(-1)

        for change in _changes(batch):
            runs_on = change & valid[..., 1:] & ~starts[..., 1:]
            _require(
                ~runs_on.any(),
                "a sequence runs on into another: the trajectory changes at a step without 'is_init'; "
                "reshape slices to [B, T], or let SliceSampler(init_key='is_init') mark where they begin",
            )
        return self._check_starts(batch, starts, valid, mask_keys) if self.rebuilt else batch

    def _check_starts(
        self, batch: TensorDictBase, starts: Tensor, valid: Tensor, mask_keys: Sequence[NestedKey]
    ) -> TensorDictBase:
        first = _first_steps(starts)
        exact = self._empty(batch).gather(-1, first)
        if self.burn_in == 0:
            _require(
                (exact | ~valid).all(),
                f"a sequence begins with a stored memory that is not zero, or without one (the entries "
                f"{list(self.rebuilt)}): the memory after a mirrored history is no linear image of it; "
                + _REMEDIES,
            )
            return batch

        if not mask_keys:
            raise ValueError(
                "burn_in leaves out steps through the loss's mask, which loss_mask_key=None switches off; "
                "set loss_mask_key='auto'"
            )
        age = torch.arange(batch.shape[-1], device=first.device) - first
        counted = exact | (age >= self.burn_in)
        _require(
            (counted & valid).any(),
            f"burn_in={self.burn_in} leaves no step of this batch; use longer sequences or a shorter one",
        )
        mask = batch.get(mask_keys[0], None)
        if mask is not None:
            counted = mask & counted.reshape(counted.shape + (1,) * (mask.ndim - counted.ndim))
        return batch.copy().set(mask_keys[0], counted)

    def rebuild(self, copies: TensorDictBase, element: Tensor | None = None) -> TensorDictBase:
        """Copies that begin from zero memory, their originals from what is stored.

        What is stored under ``"next"`` is that after one step, of which copies know nothing: it is left
        out, so that the values of next states, of originals and copies alike, begin from zero memory.

        Args:
            copies: an orbit ``[N, *B]``, the originals first; not modified.
            element: instead, the element that each one of a batch ``[*B]`` is under, 0 the identity.
        """
        if not self.rebuilt:
            return copies
        mirrored = torch.arange(len(copies), device=_device(copies)) if element is None else element
        mirrored = mirrored != 0
        copies = copies.exclude(*[unravel_key(("next", key)) for key in self.rebuilt])
        for key in self.rebuilt:
            value = copies.get(key, None)
            if value is not None:
                shape = mirrored.shape + (1,) * (value.ndim - mirrored.ndim)
                copies.set(key, value.masked_fill(mirrored.reshape(shape), 0.0))
        return copies

    def draw(self, symmetry: Symmetry, batch: TensorDictBase) -> Tensor:
        """Random elements ``[*B]``: one for each step, or the same from one start to the next."""
        drawn = symmetry.draw(batch)
        return drawn.gather(-1, _first_steps(self._starts(batch))) if self.recurrent else drawn

    def _starts(self, batch: TensorDictBase) -> Tensor:
        """Where networks take up the stored memory, ``[*B, T]``."""
        missing = [key for key in self.resets if batch.get(key, None) is None]
        if missing:
            raise KeyError(
                f"expected an entry {missing[0]!r}, which a recurrent network reads; append InitTracker() "
                "to the environment"
            )
        first = torch.arange(batch.shape[-1], device=_device(batch)) == 0
        starts = first.expand(batch.shape)
        for key in self.resets:
            starts = starts | _per_step(batch.get(key), batch).any(-1)
        return starts

    def _empty(self, batch: TensorDictBase) -> Tensor:
        """Where all stored memory is zero, ``[*B, T]``; one that is not stored may have been anything."""
        empty = torch.ones(batch.shape, dtype=torch.bool, device=_device(batch))
        for key in self.rebuilt:
            value = batch.get(key, None)
            empty = empty & (value is not None and (_per_step(value, batch) == 0).all(-1))
        return empty


def memory_by_name(symmetry: Symmetry) -> Memory:
    """The memory that a symmetry declares invariant, where no network is at hand: by TorchRL's names."""
    keys = [key for key in symmetry.keys() if is_recurrent_state(key)]  # noqa: SIM118
    rebuilt = [key for key in keys if symmetry[key].is_trivial]
    resets = _distinct(join(split(key)[0], "is_init") for key in rebuilt)
    return Memory(tuple(rebuilt), tuple(resets), 0, bool(rebuilt))


def is_recurrent_state(key: NestedKey) -> bool:
    """Whether TorchRL's recurrent modules keep their memory under this name, unless told otherwise."""
    return "recurrent_state" in split(key)[1]


def memory_keys(network: TensorDictModuleBase) -> list[NestedKey]:
    """Entries that a network remembers by: it reads k, and writes ``("next", k)`` for its next step.

    So do those that a module with ``is_init`` reads and overwrites.
    """
    modules = _modules(network)
    written = {unravel_key(key) for module in modules for key in module.out_keys}
    overwritten = {
        unravel_key(key)
        for module in modules
        if any(_is_reset(other) for other in module.in_keys)
        for key in set(module.in_keys) & set(module.out_keys)
    }
    read = _distinct(network.in_keys)
    return [key for key in read if unravel_key(("next", key)) in written or key in overwritten]


def reset_keys(network: TensorDictModuleBase) -> list[NestedKey]:
    """Entries that tell a network where an episode begins."""
    return [key for key in _distinct(network.in_keys) if _is_reset(key)]


def _modules(network: TensorDictModuleBase) -> list[TensorDictModuleBase]:
    """A network and its parts, whose outputs ``select_out_keys`` may hide."""
    return [module for module in network.modules() if isinstance(module, TensorDictModuleBase)]


def _is_reset(key: NestedKey) -> bool:
    return split(key)[1] == "is_init"


def _distinct(keys: Iterable[NestedKey]) -> list[NestedKey]:
    return list(dict.fromkeys(unravel_key(key) for key in keys))


def _device(batch: TensorDictBase) -> torch.device | None:
    return next((value.device for value in batch.values(True, True)), batch.device)


def _per_step(value: Tensor, batch: TensorDictBase) -> Tensor:
    """An entry as one vector per step, ``[*B, T, d]``."""
    return value.reshape(*batch.shape, -1)


def _first_steps(starts: Tensor) -> Tensor:
    """For each step, the index of the start before it, ``[*B, T]``."""
    steps = torch.arange(starts.shape[-1], device=starts.device)
    return torch.where(starts, steps, 0).cummax(-1).values


def _as_sequences(batch: TensorDictBase) -> TensorDictBase:
    """A batch ``[T]`` as ``[1, T]``, since copies are joined along the first dimension, not along time."""
    if batch.batch_dims > 1:
        return batch
    if batch.batch_dims == 0 or not _changes(batch):
        raise ValueError(
            f"a recurrent network reads sequences [B, T], got a batch of shape {tuple(batch.shape)}; use "
            "batch.reshape(-1, T) for slices of T steps, batch.unsqueeze(0) for one sequence, or "
            "batch.unsqueeze(-1) for independent samples"
        )
    return batch.unsqueeze(0)


def _changes(batch: TensorDictBase) -> list[Tensor]:
    """What tells that the next step is of another trajectory, each ``[*B, T - 1]``."""
    found = []
    for key in (("collector", "traj_ids"), "env_index"):  # AsyncBatchedCollector writes the latter
        origin = batch.get(key, None)
        if origin is not None:
            origin = _per_step(origin, batch)[..., 0]
            found.append(origin[..., 1:] != origin[..., :-1])
    done = batch.get(("next", "done"), None)
    if done is not None:
        done = _per_step(done, batch).all(-1)
        found.append(done[..., :-1] & ~done[..., 1:])  # the last one of several, as multi-step returns have
    return found


def _require(condition: Tensor, message: str) -> None:
    if condition.device.type != "cpu" or torch.compiler.is_compiling():
        torch._assert_async(condition, message)  # pyright: ignore[reportPrivateImportUsage]
    elif not condition:
        raise ValueError(message)
