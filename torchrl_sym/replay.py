"""Symmetric copies in replay buffers, with rows, priorities and slices that belong together.

A replay buffer samples rows, its anchors, and gives each an index, a weight and a priority. Their copies
are made by two parts that must agree: a sample unit repeats the indices, so that whatever the buffer writes
into its rows fits, and a transform maps the repeated rows. :class:`SymmetryReplayBuffer` holds both, and
does and checks what only a buffer can: one element for a whole slice, room for stored copies, one priority
for an anchor and its copies. :class:`SymmetryOrbit` is the pair alone, for the buffers of TorchRL.
"""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.utils import expand_right
from torch import Tensor, nn
from torchrl.data import ReplayBuffer, TensorDictReplayBuffer
from torchrl.data.replay_buffers import (
    PrioritizedSampler,
    Sampler,
    SamplerEnsemble,
    SampleUnit,
    SliceSampler,
    Storage,
    StorageEnsemble,
)
from torchrl.envs.transforms import Compose, Transform

from torchrl_sym import checks
from torchrl_sym._torchrl import buffers_sampling_by, cuts_by
from torchrl_sym.augment import (
    TRAJECTORY,
    SymmetryAugment,
    check_declared,
    check_memory,
    refuse_environment,
    same_along,
    separate_trajectories,
)
from torchrl_sym.memory import memory_by_name
from torchrl_sym.symmetry import Elements, Symmetry, check_symmetry

Index = Tensor | tuple[Tensor, ...]


class SymmetryOrbit(SampleUnit):
    """Sample unit that repeats each anchor for its copies, and the transform that maps them.

    Copies are group-major, originals first; the entry ``symmetry_id`` of the info has the element of each
    row. Prefer :class:`SymmetryReplayBuffer`, which is made of this. By hand, pass both parts to one
    buffer; one with priorities is refused, as it would keep those of the last copies.

    Args:
        symmetry: what transforms how.
        elements: ``"all"``, names of a subset (the identity is always kept, first), or ``"random"``: rows
            are not repeated, but each mapped by one drawn element, or each slice of a SliceSampler.

    Raises:
        RuntimeError: sampled by a buffer that lacks this orbit's transform, or has priorities.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage, ReplayBuffer
        >>> from torchrl_sym import PointGroup, Symmetry, SymmetryOrbit
        >>> from torchrl_sym.representations import pseudoscalar
        >>> group = PointGroup.reflection("x")
        >>> orbit = SymmetryOrbit(Symmetry(group, {"observation": pseudoscalar(group)}))
        >>> parts = {"sample_unit": orbit, "transform": orbit.transform()}
        >>> buffer = ReplayBuffer(storage=LazyTensorStorage(8), batch_size=4, **parts)
        >>> _ = buffer.extend(TensorDict(observation=torch.ones(8, 1), batch_size=[8]))
        >>> buffer.sample()["observation"].flatten()
        tensor([ 1.,  1.,  1.,  1., -1., -1., -1., -1.])
    """

    @checks.near_names
    def __init__(self, symmetry: Symmetry, elements: Elements = "all") -> None:
        self.symmetry = check_symmetry(symmetry)
        self.random = isinstance(elements, str) and elements == "random"
        self.elements = symmetry.elements(elements)
        # of the rows that come next, by thread, since prefetching samples in several; None: as stored
        self._handed_over: dict[int, Tensor | None] = {}

    def transform(self) -> Transform:
        """The transform to pass to the buffer together with this sample unit."""
        return _OrbitTransform(self)

    def expand(self, index: Index, info: dict[str, Any], storage: Storage) -> tuple[Index, dict[str, Any]]:
        """Repeat anchors and what the info says about them, or draw their elements.

        Args:
            index: the anchors, ``(B,)``, or one such tensor per dimension of the storage.
            info: what the sampler says.
            storage: where the buffer keeps its rows.
        """
        buffers = buffers_sampling_by(self, storage)
        if not buffers or not isinstance(info, dict):
            raise RuntimeError(
                "expected a replay buffer with this orbit as sample_unit and one storage from the start, "
                "got an ensemble or a storage set later; use one SymmetryReplayBuffer for each storage"
            )
        for buffer in buffers:
            self._check_pair(buffer)

        first = index[0] if isinstance(index, tuple) else index
        if self.random:
            slicers = [buffer.sampler for buffer in buffers if isinstance(buffer.sampler, SliceSampler)]
            element = self._draw(index, storage, slicers)
        else:  # filled, since what is copied from the host makes a GPU wait
            element = torch.cat([torch.full_like(first, g) for g in self.elements])
            index = tuple(map(self._repeat, index)) if isinstance(index, tuple) else self._repeat(index)
            info = {key: self._repeat(x) if _aligned(x, first) else x for key, x in info.items()}
        self._handed_over[threading.get_ident()] = element
        return index, info | {"symmetry_id": element}

    @contextlib.contextmanager
    def serving(self) -> Iterator[None]:
        """While a buffer reads rows in this thread: those that are not expanded come as stored."""
        thread = threading.get_ident()
        self._handed_over[thread] = None
        try:
            yield
        finally:
            self._handed_over.pop(thread, None)

    def claim(self, paired: bool) -> Tensor | None:
        """Elements of the rows at hand, None if they are as stored.

        Args:
            paired: whether their buffer is known to sample by this orbit.
        """
        thread = threading.get_ident()
        if thread not in self._handed_over and not paired:
            raise RuntimeError(
                "expected rows that were expanded by the SymmetryOrbit of this transform, got rows as they "
                "are stored; pass that orbit to the buffer as sample_unit=orbit (rows can be read by index "
                "once it has sampled), or use SymmetryReplayBuffer"
            )
        return self._handed_over.pop(thread, None)

    def _repeat(self, x: Tensor) -> Tensor:
        return x.repeat(len(self.elements), *[1] * (x.ndim - 1))

    def _draw(self, index: Index, storage: Storage, slicers: list[SliceSampler]) -> Tensor:
        """A random element for each row, or for each run of rows that follow each other in the storage."""
        time = index[0] if isinstance(index, tuple) else index
        drawn = torch.randint_like(time, self.symmetry.group.order)
        if not slicers:
            return drawn
        if any(sampler.fragmented for sampler in slicers):
            raise RuntimeError(
                "elements='random' draws one element for rows that follow each other in the storage, as "
                "those of a slice need not do with fragmented=True; use elements='all'"
            )
        step = time.diff(prepend=time[:1]) % storage.shape[0]
        return same_along(drawn, step > 1)  # the same row again is padding

    def _check_pair(self, buffer: ReplayBuffer) -> None:
        transforms = [t for t in buffer.transform.modules() if isinstance(t, _OrbitTransform)]
        if all(transform.orbit is not self for transform in transforms):
            raise RuntimeError(
                "a SymmetryOrbit alone repeats rows without mapping them: expected its own transform in "
                f"the buffer, got {'that of another orbit' if transforms else 'none'}; pass "
                "transform=orbit.transform(), or use SymmetryReplayBuffer"
            )
        if isinstance(buffer, SymmetryReplayBuffer):
            return
        if isinstance(buffer.sampler, PrioritizedSampler) or hasattr(buffer, "prioritized_sampler"):
            raise RuntimeError(
                f"{type(buffer).__name__} would keep the priority of each row's last copy; use "
                "SymmetryReplayBuffer(symmetry, sampler=PrioritizedSampler(...), ...), which keeps the "
                "largest"
            )
        for transform in transforms:
            transform.paired = True


class _OrbitTransform(Transform):
    """Maps the rows that a :class:`SymmetryOrbit` has expanded, each by its element."""

    def __init__(self, orbit: SymmetryOrbit) -> None:
        super().__init__(in_keys=orbit.symmetry.keys(), out_keys=orbit.symmetry.keys())
        self.orbit = orbit
        self.memory = memory_by_name(orbit.symmetry)
        self.paired = False

    def set_container(self, container: Any) -> None:
        super().set_container(container)
        refuse_environment(self)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        if tensordict.batch_dims == 0:
            return tensordict  # buffer[3]
        element = self.orbit.claim(self.paired)
        if element is None:
            return tensordict  # buffer[4:8]
        if len(element) != len(tensordict):
            raise RuntimeError(
                f"expected the {len(element)} rows that were sampled, got {len(tensordict)}: a transform "
                "has changed their number; put it behind that of the orbit"
            )
        symmetry = self.orbit.symmetry
        check_declared(symmetry, tensordict)
        element = element.to(next(iter(tensordict.values(True, True))).device)
        element = expand_right(element, tensordict.batch_size)
        self._check_memory(tensordict)
        out = self.memory.rebuild(symmetry.per_row(tensordict, element), element)
        separate_trajectories(out, symmetry.group.order, element)
        return out

    def _check_memory(self, td: TensorDictBase) -> None:
        if td.batch_dims > 1:
            return check_memory(self.memory, td)
        stored = [key for key in self.memory.rebuilt if td.get(key, None) is not None]
        if stored:
            raise RuntimeError(
                f"slices in a flat batch have the stored memory {stored}, which copies do not have: leave "
                "it out of the buffer, so that networks begin every slice from zero memory, or store "
                "sequences [T] that begin where episodes do as records"
            )
        return None


class SymmetryReplayBuffer(TensorDictReplayBuffer):
    """A :class:`~torchrl.data.TensorDictReplayBuffer` whose batches have the copies of their rows.

    ``sample()`` returns N * ``batch_size`` rows, group-major, originals first, with ``index``,
    ``symmetry_id`` and what the sampler adds (weights, ends of slices) in every row. Copies are made of the
    rows as stored, before the user's own transforms; ``buffer[4:8]`` reads rows without copies. An update
    of priorities, ``update_tensordict_priority(batch)`` or ``update_priority(index, priority)``, keeps the
    largest of each row, over its copies and whatever their order.

    Args:
        symmetry: what transforms how.

    Keyword Args:
        elements: ``"all"``; names of a subset (the identity is always kept, first); or ``"random"``: every
            row is mapped by one drawn element, or every slice of a SliceSampler.
        when: copies are made at ``"sample"`` time, or stored at ``"extend"`` time and sampled
            independently: ``batch_size`` rows, any of them a copy, each with a priority of its own.
        storage: a storage of TorchRL, or a function that makes one.
        sampler: a sampler of TorchRL, or a function that makes one. Defaults to a RandomSampler.
        batch_size: number of anchors in a batch.
        transform: the user's own; it follows the copies when sampling, and precedes them when extending.
        settings: other keyword arguments of a TensorDictReplayBuffer (``prefetch``, ``priority_key``, ...).

    Raises:
        ValueError: slices that would run from one stored copy into the next; parts that do not go together.
        TypeError: an argument of another type, or of a name that is not above.
        RuntimeError: what cannot be seen before the first batch: too many rows for the storage, or none of
            the trajectory ids that slices need.
        KeyError: the batch has an entry that the symmetry does not know, or lacks a declared one.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage
        >>> from torchrl_sym import PointGroup, Symmetry, SymmetryReplayBuffer
        >>> from torchrl_sym.representations import pseudoscalar
        >>> group = PointGroup.reflection("x")
        >>> symmetry = Symmetry(group, {"observation": pseudoscalar(group)})
        >>> buffer = SymmetryReplayBuffer(symmetry, storage=LazyTensorStorage(8), batch_size=2)
        >>> _ = buffer.extend(TensorDict(observation=torch.ones(8, 1), batch_size=[8]))
        >>> batch = buffer.sample()
        >>> batch["observation"].flatten(), batch["symmetry_id"]
        (tensor([ 1.,  1., -1., -1.]), tensor([0, 0, 1, 1]))
    """

    def __init__(
        self,
        symmetry: Symmetry,
        *,
        elements: Elements = "all",
        when: Literal["sample", "extend"] = "sample",
        storage: Storage | Callable[[], Storage],
        sampler: Sampler | Callable[[], Sampler] | None = None,
        batch_size: int | None = None,
        transform: Transform | Callable[[Any], Any] | None = None,
        **settings: Any,
    ) -> None:
        check_symmetry(symmetry)
        checks.one_of("when", when, ("sample", "extend"))
        if batch_size is not None:
            batch_size = checks.whole("batch_size", batch_size, low=1)
        ours = ("sample_unit", "transform_factory")
        accepted = [name for name in checks.keywords(type(self)) if name not in ours]
        checks.refuse_unknown(type(self).__name__, settings, accepted)
        parts = transform.modules() if isinstance(transform, nn.Module) else ()
        if any(isinstance(part, SymmetryAugment | _OrbitTransform) for part in parts):
            raise ValueError("transform: expected the user's own, got one that makes copies; leave it out")

        self._orbit = SymmetryOrbit(symmetry, elements) if when == "sample" else None
        copies = (
            self._orbit.transform()
            if self._orbit
            else _StoredCopies(symmetry, elements, self._check_stored)
        )
        transforms: list[Any] = [copies] if transform is None else [copies, transform]
        super().__init__(
            storage=storage,
            sampler=sampler,
            sample_unit=self._orbit,
            batch_size=batch_size,
            transform=Compose(*transforms),
            **settings,
        )
        if isinstance(self.storage, StorageEnsemble) or isinstance(self.sampler, SamplerEnsemble):
            raise ValueError("storage: expected one, got an ensemble; make a SymmetryReplayBuffer for each")
        if when == "extend":
            self._check_cuts(ValueError)

    def __getitem__(self, index: Any) -> Any:
        with self._serving():
            return super().__getitem__(index)

    def _sample(self, batch_size: int) -> tuple[Any, dict[str, Any]]:
        with self._serving():
            return super()._sample(batch_size)

    def _serving(self) -> contextlib.AbstractContextManager[None]:
        return self._orbit.serving() if self._orbit is not None else contextlib.nullcontext()

    def update_tensordict_priority(self, data: TensorDictBase) -> None:
        """Update priorities from a batch: any rows that were sampled, in any order and any batch shape."""
        if isinstance(self.sampler, PrioritizedSampler) and data.ndim > 1:
            times = self.storage[0].ndim - self.storage.ndim + 1  # dimensions of a stored row
            if data.ndim - times > 1:
                data = data.flatten(0, data.ndim - times - 1)
        super().update_tensordict_priority(data)

    def update_priority(self, index: int | Index, priority: int | float | Tensor) -> None:
        """Update priorities; a row that comes more than once keeps the largest.

        Args:
            index: rows, ``(B,)``, or their coordinates in the storage, ``(B, dims)`` or one tensor for each
                dimension; in any order, and as often as may be.
            priority: one for each, or one for all.
        """
        rows = torch.stack(index, -1) if isinstance(index, tuple) else torch.as_tensor(index)
        value = torch.as_tensor(priority, device=rows.device)
        if rows.ndim and value.ndim:
            time = self.dim_extend or 0
            if len(value) != len(rows) and value.ndim > time:  # of a batch that is being stored, time first
                value = value.transpose(0, time)
            value = value.flatten()
        if rows.ndim and value.ndim and len(value) == len(rows):
            rows, place = rows.unique(dim=0, return_inverse=True)
            value = value.new_zeros(len(rows)).scatter_reduce(0, place, value, "amax", include_self=False)
        super().update_priority(rows, value)

    def _check_stored(self, data: TensorDictBase) -> None:
        """RuntimeError unless rows and their copies have room, and slices can tell them apart."""
        count = data.batch_size[: self.storage.ndim].numel()
        if count > self.storage.max_size:
            raise RuntimeError(
                f"the storage holds {self.storage.max_size} rows, but {count} are to be stored at once, "
                "symmetric copies included, and would overwrite each other; make the storage that large, "
                "or use when='sample'"
            )
        self._check_cuts(RuntimeError, data)

    def _check_cuts(self, error: type[Exception], data: TensorDictBase | None = None) -> None:
        sampler = self.sampler
        if not isinstance(sampler, SliceSampler):
            return
        if not cuts_by(sampler, TRAJECTORY) or (data is not None and TRAJECTORY not in data.keys(True)):
            raise error(
                f"a slice could run from one stored copy into the next: only {TRAJECTORY} tells the copies "
                "apart, and the batch lacks it or the sampler does not cut by it; keep the collector's "
                "trajectory ids and the sampler's default keys, or use when='sample'"
            )


class _StoredCopies(SymmetryAugment):
    """Copies that a buffer stores, once it has found them in order."""

    def __init__(
        self, symmetry: Symmetry, elements: Elements, check: Callable[[TensorDictBase], None]
    ) -> None:
        super().__init__(symmetry, elements=elements, when="extend")
        self.check = check

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        out = super()._inv_call(tensordict)
        self.check(out)
        return out


def _aligned(x: Any, anchors: Tensor) -> bool:
    """Whether an entry of the info has a value for each anchor."""
    return isinstance(x, Tensor) and x.ndim > 0 and len(x) == len(anchors)
