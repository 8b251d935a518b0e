"""Symmetric copies of a batch: the paper's data augmentation as a TorchRL transform.

Eq. (sym-aug) of Mittal et al. adds to every sample (s, a) its images (L_g[s], K_g[a]) and keeps the
ORIGINAL log-probability, advantage and return, since an image is a sample of the transformed policy
pi^g, whose probability of it is the original one. So a copy maps the declared observations and actions
and shares everything else. :class:`SymmetryAugment` does this to tensordicts, on their own, in replay
buffers and behind collectors; :class:`SymmetryOrbit` does it where a buffer fixes the batch size.
"""

from __future__ import annotations

import copy
import inspect
from collections.abc import Sequence
from typing import Any, Literal, cast

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor
from torchrl.data import ReplayBuffer, TensorDictReplayBuffer
from torchrl.data.replay_buffers import SampleUnit
from torchrl.data.replay_buffers.samplers import SliceSampler
from torchrl.envs.transforms import Transform

from torchrl_sym import checks
from torchrl_sym.symmetry import Elements, Symmetry, check_batch, check_symmetry

_TRAJECTORY = ("collector", "traj_ids")


class SymmetryAugment(Transform):
    """Adds the symmetric copies of every row, sharing log-probability, advantage and return.

    Modes of use:

    - stand-alone: ``augment(batch)``;
    - in a :class:`~torchrl.data.ReplayBuffer`, when sampling (``when="sample"``: a minibatch of B rows
      becomes N * B) or when extending (``when="extend"``: copies are stored and shuffled independently);
    - as ``postproc`` of any collector; frames are counted before it, so budgets keep their meaning;
    - in a :class:`~torchrl.data.TensorDictReplayBuffer`, whose records must keep their number, with
      ``elements="random"``, ``layout="stack"``, or through :class:`SymmetryOrbit`.

    It cannot be appended to an environment. Advantages must be computed before it: a value function
    evaluated on copies would not give Eq. (sym-aug).

    Args:
        symmetry: what transforms how.

    Keyword Args:
        elements: ``"all"``; names of a subset (the identity is always kept, first); or ``"random"``:
            every row is mapped by one uniformly drawn element. This has the same expected gradient as
            ``"all"`` at 1/N of the cost.
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
        self.symmetry = copy.deepcopy(symmetry)  # to(device) must not move the caller's
        self.random = isinstance(elements, str) and elements == "random"
        self.elements = symmetry.elements(elements)
        self.layout = layout
        self.when = when
        self.select = select
        self.__dict__["log_prob_from"] = log_prob_from  # the actor is the caller's, not a submodule

    def set_container(self, container: Any) -> None:
        """Refuse environments: they have one action per state, so no batch to grow."""
        super().set_container(container)
        if self.parent is not None:
            raise RuntimeError(
                "SymmetryAugment changes the batch and cannot be appended to an environment; use it in "
                "a replay buffer, as a collector's postproc, on its own, or use SymmetricClipPPOLoss"
            )

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Augment a batch (a no-op with ``when="extend"``, and for a single record)."""
        if self.when != "sample" or check_batch(tensordict).batch_dims == 0:
            return tensordict
        if not torch.compiler.is_compiling():
            self._check_sampling(_calling_buffer()[0])
        return self.augment(tensordict)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        # _inv_call and not inv: Compose, which every buffer wraps around us, calls only the former
        if self.when != "extend":
            return tensordict
        buffer, method = _calling_buffer()
        if method == "add" or tensordict.batch_dims == 0:
            raise RuntimeError(
                "a single row has no place for its symmetric copies; use buffer.extend(row.unsqueeze(0)) "
                "instead of add, or when='sample'"
            )
        out = self.augment(tensordict)
        if buffer is not None and not self.random:
            self._check_extending(buffer, tensordict, out)
        return out

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
        self._check_keys(td)
        if self.random:
            return self._augment_random(td)
        orbit = self.symmetry.orbit(td, self.elements)
        self._reevaluate(orbit, originals=1)
        self._separate_trajectories(orbit)
        names = td.names if td._has_names() else None
        if self.layout == "stack":
            out = orbit
            for dim in range(td.batch_dims):  # permute, in steps that torch.compile can follow
                out = out.transpose(dim, dim + 1)
            if names is not None:
                out.names = [*names, None]
            return out
        out = orbit.reshape(-1, *td.batch_size[1:])
        if names is not None:  # reshape drops them, and value estimators look for "time"
            out.names = names
        return out

    def _augment_random(self, td: TensorDictBase) -> TensorDictBase:
        n = self.symmetry.group.order
        out = self.symmetry(td, torch.randint(n, td.batch_size, device=td.device))
        self._reevaluate(out, originals=0)
        return out

    def _reevaluate(self, batch: TensorDictBase, originals: int) -> None:
        actor = self.__dict__["log_prob_from"]
        if actor is None or len(batch) == originals:
            return
        copies = cast(TensorDictBase, batch[originals:])
        with torch.no_grad():
            state = copies.select(*actor.in_keys, *actor.dist_sample_keys)
            log_prob = actor.get_dist(state).log_prob(state.get(actor.dist_sample_keys[0]))
        key = actor.log_prob_keys[0]  # set, not written in place: the copies share the original's memory
        batch.set(key, torch.cat([batch.get(key)[:originals], log_prob]))

    def _separate_trajectories(self, orbit: TensorDictBase) -> None:
        """Copies are trajectories of their own: slices must not run from one into the next."""
        ids = orbit.get(_TRAJECTORY, None)
        if ids is not None:
            n = orbit.batch_size[0]
            copy = torch.arange(n, device=ids.device).reshape(n, *[1] * (ids.ndim - 1))
            orbit.set(_TRAJECTORY, ids * n + copy)

    def _check_keys(self, td: TensorDictBase) -> None:
        present = td.keys(include_nested=True, leaves_only=True)
        declared = self.symmetry.keys()
        missing = [
            key for key in declared if key not in present and (self.select is None or key in self.select)
        ]
        if missing and self.symmetry.strict:
            raise KeyError(
                f"the batch lacks {missing}, which the symmetry declares; it has "
                f"{sorted(map(str, present))}; rename the symmetry's key, or pass select=[...]"
            )

    def _check_extending(
        self, buffer: ReplayBuffer, tensordict: TensorDictBase, out: TensorDictBase
    ) -> None:
        storage, sampler = buffer._storage, buffer._sampler
        dims = getattr(storage, "ndim", 1)  # a record is what lies behind these dimensions
        before, after = (td.batch_size[:dims].numel() for td in (tensordict, out))
        if after > storage.max_size:
            raise RuntimeError(
                f"the storage holds {storage.max_size} rows, but {before} rows and their symmetric copies "
                f"are {after} and would overwrite each other; make the storage {len(self.elements)} times "
                "as large, or use when='sample'"
            )
        if self.layout == "cat" and isinstance(sampler, SliceSampler):
            automatic = getattr(sampler, "_traj_key_auto", False)  # looks for our key first
            if _TRAJECTORY not in out.keys(True) or not (automatic or sampler.traj_key == _TRAJECTORY):
                raise RuntimeError(
                    f"a slice could run from one symmetric copy into the next: only {_TRAJECTORY} tells "
                    "the copies apart, and the batch lacks it or the sampler does not cut by it; keep the "
                    "collector's trajectory ids and the sampler's default keys, or use when='sample'"
                )

    def _check_sampling(self, buffer: ReplayBuffer | None) -> None:
        if buffer is None:
            return
        if self.__dict__["log_prob_from"] is not None:
            raise RuntimeError(
                "log_prob_from needs the policy that collected the data, which has changed by the time "
                "a buffer is sampled; use when='extend'"
            )
        sliced = isinstance(buffer._sampler, SliceSampler)
        if self.random and sliced:
            raise RuntimeError(
                "elements='random' draws an element per row, which would mix elements within a slice; use "
                "elements='all' or a sampler of single rows"
            )
        if not isinstance(buffer, TensorDictReplayBuffer) or self.random:
            return
        if self.layout == "cat" or sliced:
            raise RuntimeError(
                f"{type(buffer).__name__} fixes the number of records, which layout={self.layout!r} "
                f"changes{' (its slices cannot be stacked)' if sliced else ''}; use orbit = "
                "SymmetryOrbit(symmetry) with sample_unit=orbit and transform=orbit.transform(), or a "
                "plain ReplayBuffer"
            )


class SymmetryOrbit(SampleUnit):
    """Expands each sampled anchor to its N symmetric copies, in buffers that fix the number of records.

    :class:`~torchrl.data.TensorDictReplayBuffer` writes index and weight into every record, so that a
    transform may not change their number. A sample unit may: it repeats the indices (group-major), and
    the paired transform turns block k into the images under element k. Works with prioritized buffers,
    slices and multi-dimensional storages. The info entry ``symmetry_id`` tells the copies apart.

    Args:
        symmetry: what transforms how.
        elements: ``"all"``, or names of a subset (the identity is always kept, first).

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
        >>> from torchrl_sym import PointGroup, Symmetry, SymmetryOrbit
        >>> from torchrl_sym.representations import pseudoscalar
        >>> group = PointGroup.reflection("x")
        >>> orbit = SymmetryOrbit(Symmetry(group, {"observation": pseudoscalar(group)}))
        >>> buffer = TensorDictReplayBuffer(
        ...     storage=LazyTensorStorage(8),
        ...     batch_size=4,
        ...     sample_unit=orbit,
        ...     transform=orbit.transform(),
        ... )
        >>> _ = buffer.extend(TensorDict(observation=torch.ones(8, 1), batch_size=[8]))
        >>> buffer.sample()["observation"].flatten()
        tensor([ 1.,  1.,  1.,  1., -1., -1., -1., -1.])
    """

    @checks.near_names
    def __init__(self, symmetry: Symmetry, elements: Elements = "all") -> None:
        check_symmetry(symmetry)
        if isinstance(elements, str) and elements == "random":
            raise ValueError(
                "random elements keep the number of records; use SymmetryAugment(elements='random')"
            )
        self.symmetry = copy.deepcopy(symmetry)  # to(device) must not move the caller's
        self.elements = symmetry.elements(elements)

    def transform(self) -> Transform:
        """The transform to pass to the buffer together with this sample unit."""
        return _OrbitTransform(self)

    def expand(
        self, index: Tensor | tuple[Tensor, ...], info: dict[str, Any], storage: Any
    ) -> tuple[Tensor | tuple[Tensor, ...], dict[str, Any]]:
        """Repeat anchors and the info entries that are aligned with them, group-major."""
        buffer, _ = _calling_buffer()
        if buffer is not None and not any(
            isinstance(t, _OrbitTransform) for t in buffer._transform.modules()
        ):
            raise RuntimeError(
                "a SymmetryOrbit alone repeats rows without mapping them; pass transform=orbit.transform() "
                "to the buffer as well"
            )
        n = len(self.elements)
        anchors = len(index[0] if isinstance(index, tuple) else index)

        def repeat(x: Tensor) -> Tensor:
            return x.repeat(n, *[1] * (x.ndim - 1))

        aligned = {
            key: repeat(value)
            if isinstance(value, Tensor) and value.ndim and len(value) == anchors
            else value
            for key, value in info.items()
        }
        aligned["symmetry_id"] = torch.tensor(self.elements).repeat_interleave(anchors)
        repeated = tuple(map(repeat, index)) if isinstance(index, tuple) else repeat(index)
        return repeated, aligned

    def fold(self, priority: Tensor) -> Tensor:
        """Largest priority over the copies of each anchor: ``(N * B, ...)`` to ``(B, ...)``.

        A prioritized buffer keeps the last value written for an index, so update it with
        ``buffer.update_priority(td["index"][:B], orbit.fold(error))``.
        """
        copies = len(self.elements)
        if not isinstance(priority, Tensor) or priority.ndim == 0 or len(priority) % copies:
            raise ValueError(f"expected priorities of {copies} copies each, got {checks.shown(priority)}")
        return priority.unflatten(0, (copies, -1)).amax(dim=0)


class _OrbitTransform(Transform):
    """Maps block k of group-major repeated rows by element k; keeps the batch size."""

    def __init__(self, orbit: SymmetryOrbit) -> None:
        super().__init__(in_keys=orbit.symmetry.keys(), out_keys=orbit.symmetry.keys())
        self.symmetry = orbit.symmetry
        self.elements = orbit.elements

    def set_container(self, container: Any) -> None:
        super().set_container(container)
        if self.parent is not None:
            raise RuntimeError("the transform of a SymmetryOrbit cannot be appended to an environment")

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        if tensordict.batch_dims == 0:
            return tensordict
        buffer, method = _calling_buffer()
        if method == "__getitem__":
            return tensordict  # buffer[4:8] reads rows as they are stored, without the sample unit
        rows, n = tensordict.batch_size[0], len(self.elements)
        if not isinstance(getattr(buffer, "_sample_unit", None), SymmetryOrbit) or rows % n:
            raise RuntimeError(
                "expected rows that were repeated by a SymmetryOrbit, got rows as they are stored; pass "
                "the orbit that made this transform to the buffer as sample_unit=orbit"
            )
        element = torch.tensor(self.elements, device=tensordict.device)
        element = element.repeat_interleave(rows // n)
        element = element.reshape(-1, *[1] * (tensordict.batch_dims - 1))
        return self.symmetry(tensordict, element.expand(tensordict.batch_size))


def _calling_buffer() -> tuple[ReplayBuffer | None, str]:
    """The replay buffer that is calling us and the name of its method; (None, "") outside of one.

    TorchRL does not tell a transform which buffer it serves. Without this look up the stack, a storage
    that is too small would overwrite rows, and ``add`` would store one element of a pair, silently.
    """
    frame = inspect.currentframe()
    for _ in range(12):  # a handful of Compose and decorator frames lie between
        frame = frame.f_back if frame is not None else None
        if frame is None:
            break
        owner = frame.f_locals.get("self")
        if isinstance(owner, ReplayBuffer):
            return owner, frame.f_code.co_name
    return None, ""
