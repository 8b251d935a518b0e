"""Symmetry of a task: which representation transforms which entry of a tensordict.

For each element g the paper writes L_g for its action on states and K_g for its action on actions. A
:class:`Symmetry` holds both as one mapping from keys to representations and applies them to whole
tensordicts. It is strict: an entry it does not know is an error, because an observation that is silently
left un-mirrored is the most common bug of this field.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Literal

import torch
from tensordict import NestedKey, TensorDictBase, is_leaf_nontensor, is_tensor_collection
from torch import Tensor, nn
from torchrl.data import TensorSpec
from torchrl.envs import EnvBase

from torchrl_sym import checks, files, printing
from torchrl_sym.declaration import Declaration, require_even
from torchrl_sym.entries import PER_ROW as _INVARIANT
from torchrl_sym.entries import Exchanged, enclosing, split, without_next
from torchrl_sym.environments.probing import check_transforms
from torchrl_sym.environments.specs import check_part, counter_names
from torchrl_sym.environments.trial import Declared
from torchrl_sym.groups import PointGroup, check_group
from torchrl_sym.representations import Representation

Elements = Literal["all", "random"] | Sequence[str]


class Symmetry(nn.Module):
    """Action of a point group on the entries of a tensordict.

    Args:
        group: the group, shared by all representations.
        representations: how each entry transforms, by (nested) key. ``("next", key)`` follows ``key``.
            Entries of several keys that change places are declared together, by :class:`Exchanged`. What
            an actor writes beside an action follows the action: ``loc``, and without signs ``scale``,
            ``logits``, ``probs``, ``action_value``.
        strict: raise on entries that are neither declared nor of a kind that symmetric copies share:
            reward, done, log-probability, advantage, ... with one number per row (with one per entry of
            the action, or per agent, they change places as it does), and TorchRL's bookkeeping, such as
            anything under ``"collector"``. With ``False`` all others are copied unchanged.

    Raises:
        TypeError: a value is not a representation, or a key is none.
        ValueError: a representation belongs to another group; a key is that of a ``"next"`` entry; two keys
            are spellings of one, or one is declared twice; or two keys are named after sides, such as left
            and right, that an element exchanges, but are not declared together.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl_sym import PointGroup, Symmetry
        >>> from torchrl_sym.representations import pseudoscalar
        >>> group = PointGroup.reflection("x")
        >>> sign = pseudoscalar(group)
        >>> symmetry = Symmetry(group, {"observation": sign * 3, "action": sign})
        >>> td = TensorDict(observation=torch.ones(4, 3), action=torch.ones(4, 1), batch_size=[4])
        >>> symmetry(td, "reflect-x")["observation"][0]
        tensor([-1., -1., -1.])
        >>> symmetry.orbit(td).batch_size
        torch.Size([2, 4])
    """

    def __init__(
        self,
        group: PointGroup,
        representations: Mapping[NestedKey | Exchanged, Representation],
        *,
        strict: bool = True,
    ) -> None:
        super().__init__()
        check_group(group)
        if not checks.mapping("representations", representations, "keys to representations"):
            raise ValueError("expected at least one key with its representation, got none")
        self.group = group
        self.strict = checks.flag("strict", strict)
        self._declaration = Declaration(group, representations)
        self.representations = nn.ModuleList(representations.values())

    def keys(self) -> list[NestedKey]:
        """The declared keys."""
        return self._declaration.keys

    def together(self, keys: Iterable[NestedKey]) -> list[NestedKey]:
        """Keys, and those that they change places with."""
        found: dict[NestedKey, None] = {}
        for key in keys:
            found |= dict.fromkeys(self._declaration.together(key))
        return list(found)

    def __contains__(self, key: NestedKey) -> bool:
        return self._declaration.part(key) is not None

    def __getitem__(self, key: NestedKey) -> Representation:
        """Representation of a key.

        Raises:
            KeyError: the key is not declared, or only together with others.
        """
        part = self._declaration.part(checks.key("key", key))
        if part is None:
            raise KeyError(
                f"no representation for {key!r}; this symmetry has {self.keys()}. Add it to the "
                "dictionary passed to Symmetry, e.g. invariant(group, d) if no element changes it"
            )
        names, representation = part
        if len(names) > 1:
            raise KeyError(
                f"{key!r} has no representation of its own: {names} change places; where one is needed, "
                "join them first (CatTensors) and declare what comes out"
            )
        return representation

    def event_dims(self, key: NestedKey) -> int:
        """Number of dimensions behind those of the batch, of a declared entry; 1 for any other."""
        part = self._declaration.part(key)
        if part is None:
            return 1
        names, representation = part
        dims = len(representation.event_shape)
        return dims - 1 if len(names) > 1 and dims > 1 else dims

    def require(self, keys: Iterable[NestedKey], reader: str) -> None:
        """Raise KeyError unless every key that a network reads is declared, whatever its name.

        Only ``is_init``, which says where a recurrent network begins anew, is the same for all copies.
        """
        known = {*self.keys(), *(group for key in self.keys() for group in enclosing(key))}
        keys = [checks.key("keys", key) for key in checks.sequence("keys", keys)]
        bare = {key: without_next(key) for key in keys}
        missing = [key for key in keys if bare[key] not in known and split(bare[key])[1] != "is_init"]
        if missing:
            reserved = [key for key in missing if split(key)[1] in _INVARIANT]
            hint = f" (copies share TorchRL's {reserved}, but not with a network that reads them)"
            raise KeyError(
                f"{reader} reads {missing}, which this symmetry does not transform (it has {self.keys()}); "
                f"add them, e.g. invariant(group, d) if no element changes them{hint if reserved else ''}"
            )

    def elements(self, elements: Elements) -> list[int]:
        """Indices of ``"all"`` elements, or of the identity and the named ones, originals first."""
        if isinstance(elements, str) and elements in ("all", "random"):
            return list(range(self.group.order))
        if isinstance(elements, str):
            raise ValueError(
                f"expected 'all', 'random' or a sequence of names from {list(self.group.names)}, got "
                f"{elements!r}"
            )
        elements = checks.sequence("elements", elements)
        named = [self.group.index(e) for e in elements]
        if not named or len(set(named)) != len(named):
            raise ValueError(f"expected distinct element names, at least one, got {elements}")
        return [0, *(g for g in named if g != 0)]

    def draw(self, batch: TensorDictBase, *, per_sequence: bool = False) -> Tensor:
        """Random elements, one for each row of a batch ``[*B]``, on the device of its data.

        Args:
            batch: what will be mapped.
            per_sequence: one for each sequence ``[*B[:-1]]`` instead, the same at all of its times: a
                recurrent network must see one image of a history.
        """
        shape = check_batch(batch).batch_size
        drawn = shape[:-1] if per_sequence else shape
        device = next((value.device for value in batch.values(True, True)), batch.device)
        element = torch.randint(self.group.order, drawn, device=device)
        return element.unsqueeze(-1).expand(shape) if per_sequence else element

    def forward(
        self,
        tensordict: TensorDictBase,
        g: int | str | Tensor,
        *,
        keys: Iterable[NestedKey] | None = None,
        followers: Mapping[NestedKey, NestedKey] | None = None,
    ) -> TensorDictBase:
        """Symmetric copy of a tensordict under one element, or one element per row.

        Args:
            tensordict: any batch; it is not modified.
            g: element index or name, or indices of shape ``tensordict.batch_size``.
            keys: what to map; every other entry is shared. Defaults to all that is declared or follows it.
            followers: entries that hold one number per row, per component of an action or per agent, with
                the key of that action: for names that do not tell, as ``action_log_prob`` does.

        Raises:
            KeyError: entries that the symmetry should know but does not (strict, or named by ``keys``).
            ValueError: a tensor's event dimensions, behind those of the batch, differ from its
                representation's.
            TypeError: no tensordict.
        """
        if isinstance(g, Tensor) and g.ndim:
            return self.per_row(
                tensordict, self._checked_rows(tensordict, g), keys=keys, followers=followers
            )
        out = check_batch(tensordict).copy()
        for key, image in self._images(tensordict, keys, followers, lambda rho, x: rho(x, g)):
            out.set(key, image)
        return out

    def per_row(
        self,
        tensordict: TensorDictBase,
        element: Tensor,
        *,
        keys: Iterable[NestedKey] | None = None,
        followers: Mapping[NestedKey, NestedKey] | None = None,
    ) -> TensorDictBase:
        """Copy of each row under its own element, of which nobody asks whether it exists.

        For indices that :meth:`draw` made: to look at them would make the host wait for an accelerator.
        """
        out = check_batch(tensordict).copy()
        for key, image in self._images(tensordict, keys, followers, lambda rho, x: rho.per_row(x, element)):
            out.set(key, image)
        return out

    def _checked_rows(self, tensordict: TensorDictBase, element: Tensor) -> Tensor:
        if element.is_floating_point() or element.dtype == torch.bool:
            raise ValueError(f"expected indices of elements, got {element.dtype}")
        if element.shape != check_batch(tensordict).batch_size[: element.ndim]:
            raise ValueError(
                f"expected an element for each row of {tuple(tensordict.batch_size)}, got indices of shape "
                f"{tuple(element.shape)}"
            )
        if element.device.type == "cpu" and not torch.compiler.is_compiling() and element.numel():
            low, high = element.aminmax()  # on an accelerator, the host would have to wait for these
            if low < 0 or high >= self.group.order:
                raise KeyError(
                    f"expected element indices in [0, {self.group.order}), got {int(low)} to {int(high)}"
                )
        return element

    def orbit(
        self,
        tensordict: TensorDictBase,
        elements: Sequence[int] | None = None,
        *,
        keys: Iterable[NestedKey] | None = None,
        followers: Mapping[NestedKey, NestedKey] | None = None,
    ) -> TensorDictBase:
        """All symmetric copies: batch ``[*B]`` to ``[N, *B]``, the originals first.

        Entries that copies share are expanded, not copied.

        Args:
            tensordict: any batch; it is not modified.
            elements: indices of the elements to apply. Defaults to all of the group.
            keys: what to map; every other entry is shared. Defaults to all that is declared or follows it.
            followers: entries that hold one number per row, per component of an action or per agent, with
                the key of that action: for names that do not tell, as ``action_log_prob`` does.
        """
        if elements is not None:
            elements = checks.sequence("elements", elements, of="indices")
        count = self.group.order if elements is None else len(elements)
        if count == 0:
            raise ValueError("elements: expected at least one element, got none")

        def act(rho: Representation, x: Tensor) -> Tensor:
            return rho.orbit(x) if elements is None else torch.stack([rho(x, g) for g in elements])

        out = check_batch(tensordict).expand(count, *tensordict.batch_size).copy()
        for key, image in self._images(tensordict, keys, followers, act):
            out.set(key, image)
        return out

    def _images(
        self,
        tensordict: TensorDictBase,
        keys: Iterable[NestedKey] | None,
        followers: Mapping[NestedKey, NestedKey] | None,
        act: Callable[[Representation, Tensor], Tensor],
    ) -> Iterator[tuple[NestedKey, Tensor]]:
        """Every entry that differs between copies, with what ``act`` makes of it."""
        if keys is None:
            require_even(tensordict)
            chosen = tensordict.keys(True, True, is_leaf=is_leaf_nontensor)
        else:
            chosen = [checks.key("keys", key) for key in checks.sequence("keys", keys, of="keys")]
        strict = self.strict or keys is not None  # what is asked for by name must be known
        for names, representation in self._declaration.mapped(tensordict, chosen, strict, followers):
            values = [tensordict.get(name) for name in names]
            if len(names) == 1:
                yield names[0], act(representation, values[0])
                continue
            dims = len(representation.event_shape)
            if dims > 1 or values[0].ndim == tensordict.batch_dims:  # one item per key
                images = act(representation, torch.stack(values, tensordict.batch_dims)).unbind(-dims)
            else:
                sizes = [value.shape[-1] for value in values]
                images = act(representation, torch.cat(values, -1)).split(sizes, -1)
            yield from zip(names, images, strict=True)

    def check_specs(self, env: EnvBase) -> None:
        """Check sizes and boxes of an environment's observations and actions.

        Every element must map each bounded box onto itself. Otherwise a mirrored action leaves the
        box: a tanh-squashed policy then assigns it a log-probability that is off by hundreds of nats.
        Boxes of observations that turn by less than a right angle are not checked: no box is mapped
        onto itself then, and nothing depends on it.

        Transforms are tried out, also those of workers. Of gymnasium's wrappers only NormalizeObservation
        is looked for.

        Raises:
            KeyError: observations or actions of the environment are not declared (strict), but for those
                that TorchRL's counters (StepCounter, RewardSum, InitTracker, Timer, TrajCounter) write.
            ValueError: a size differs, a box is not symmetric, or a transform, such as a normaliser, does
                not commute with L_g or K_g.
        """
        checks.instance("env", env, EnvBase)
        unknown: list[NestedKey] = []
        for specs, is_action in ((env.observation_spec, False), (env.full_action_spec, True)):
            leaves: dict[NestedKey, TensorSpec] = dict(specs.items(True, True))  # pyright: ignore[reportAssignmentType]
            unknown += [key for key in leaves if key not in self]
            for names, representation in self._declaration.parts:
                if any(name in leaves for name in names):
                    found = {name: leaves[name] for name in names if name in leaves}
                    check_part(names, found, env.batch_size, representation, bounded=is_action)
        if unknown and self.strict:
            counters = counter_names(env)  # which builds an environment, where workers are of processes
            unknown = [key for key in unknown if split(key)[1] not in counters]
        if unknown and self.strict:
            raise KeyError(
                f"the environment has {unknown}, which this symmetry does not know (it has {self.keys()}); "
                "add their representations, e.g. invariant(group, d) for what no element changes"
            )
        check_transforms(env, Declared(self.keys(), self, self.group.names))

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write this symmetry to one small text that a person can read, and :meth:`load` anywhere.

        It has the group, every key with its representation, and strictness; nothing of the model or the
        environment that it was found with. A file that is already there is replaced.

        Args:
            path: the file, such as ``"anymal.json"``.

        Raises:
            FileNotFoundError: the path is that of a folder, or in none.

        Example:
            >>> import pathlib, tempfile, torch
            >>> from torchrl_sym import PointGroup, Symmetry
            >>> from torchrl_sym.representations import polar
            >>> group = PointGroup.rotation(3)
            >>> path = pathlib.Path(tempfile.mkdtemp()) / "robot.json"
            >>> Symmetry(group, {"action": polar(group)}).save(path)
            >>> Symmetry.load(path)["action"](torch.tensor([1.0, 0.0, 2.0]), "rot-120")
            tensor([-0.5000,  0.8660,  2.0000])
        """
        files.write(path, self.group, self._declaration.parts, self.strict)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Symmetry:
        """The symmetry that :meth:`save` wrote, equal to the last bit; it is checked like a new one.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: the file is no symmetry, of a later format, or damaged; the message says where.
        """
        group, representations, strict = files.read(path)
        return Symmetry(group, representations, strict=strict)

    def code(self) -> str:
        """The declaration of this symmetry as a person would write it: Python, to be pasted and reviewed.

        ``print(symmetry)`` lists every entry instead.

        Example:
            >>> from torchrl_sym.representations import axial, polar
            >>> group = PointGroup.reflection("y")
            >>> text = Symmetry(group, {"velocity": polar(group) + axial(group)}).code()
            >>> [line.strip() for line in text.splitlines() if "#" in line]
            ['polar(group)  # 0-2', '+ axial(group)  # 3-5']
        """
        return printing.code(self.group, self._declaration.parts, self.strict)

    def __str__(self) -> str:
        return printing.table(self.group, self._declaration.parts)

    def extra_repr(self) -> str:
        return f"{self.group!r}, keys={self.keys()}"


def check_batch(tensordict: TensorDictBase) -> TensorDictBase:
    """TypeError unless it is a tensordict (or a tensorclass)."""
    if not is_tensor_collection(type(tensordict)):
        raise TypeError(f"expected a tensordict, got {checks.shown(tensordict)}")
    return tensordict


def check_symmetry(symmetry: Symmetry) -> Symmetry:
    """TypeError unless it is a symmetry."""
    return checks.instance("symmetry", symmetry, Symmetry, "build Symmetry(group, {key: representation})")
