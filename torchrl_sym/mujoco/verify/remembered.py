"""What an environment remembers beside the state of MuJoCo: last actions, a history, a phase, a command.

It decides what is observed and rewarded next, so it belongs to the state s of obs(L_g s) = L_g obs(s): a
mirrored start has mirrored last actions. MuJoCo does not know of it, and every environment keeps it
elsewhere. So it is declared: where it is, and how it transforms.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from operator import attrgetter
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchrl_sym import checks
from torchrl_sym.groups import PointGroup
from torchrl_sym.representations import Representation


class Remembered:
    """Where an environment keeps its memory, and how that transforms; for :func:`verify`.

    Two ways to say where. Without functions, names are attributes of the environment (the unwrapped one of
    gymnasium; the ``Environment`` of dm_control, where ``"task.last"`` is one of its task) that hold an
    array, a tensor or a number; a mapping of them is short for this::

        verify(env, symmetry, memory={"last": robot.actuators, "last2": robot.actuators})

    With functions, names are what ``save`` returns and ``load`` takes: for memory in another form, such as
    lists of frames.

    Args:
        representations: of each remembered array, its entries in order.
        save: called with the environment, returns arrays by name.
        load: called with the environment and arrays by name, puts them back. The simulation is already in
            the state that belongs to them.

    Raises:
        TypeError: no representations, no functions, or one without the other.
        ValueError: nothing is named.

    Example:
        >>> from types import SimpleNamespace
        >>> import numpy as np
        >>> from torchrl_sym import PointGroup
        >>> from torchrl_sym.representations import polar
        >>> env = SimpleNamespace(frames=[np.array([1.0, 2.0, 3.0]), np.array([4.0, 5.0, 6.0])])
        >>> group = PointGroup.reflection("y")
        >>> memory = Remembered(
        ...     {"frames": polar(group) * 2},
        ...     save=lambda env: {"frames": np.concatenate(env.frames)},
        ...     load=lambda env, values: setattr(env, "frames", np.split(values["frames"], 2)),
        ... )
        >>> memory.write(env, memory.image(memory.read(env), 1))
        >>> env.frames
        [array([ 1., -2.,  3.]), array([ 4., -5.,  6.])]
    """

    def __init__(
        self,
        representations: Mapping[str, Representation],
        save: Callable[[Any], Mapping[str, Any]] | None = None,
        load: Callable[[Any, dict[str, Any]], Any] | None = None,
    ) -> None:
        wanted = "names to representations"
        self.representations = dict(checks.mapping("memory", representations, wanted))
        if not self.representations:
            raise ValueError("memory: expected names of what is remembered, got none; leave it out")
        for name, representation in self.representations.items():
            checks.instance(
                f"memory {checks.instance('memory', name, str)!r}", representation, Representation
            )
        if (save is None) != (load is None):
            raise TypeError("expected save and load, or neither for attributes, got one of them")
        self.save = _attributes(self.representations) if save is None else checks.function("save", save)
        self.load = _set_attributes if load is None else checks.function("load", load)

    def check_group(self, group: PointGroup) -> None:
        """ValueError unless everything is declared for this group."""
        for name, representation in self.representations.items():
            if representation.group != group:
                raise ValueError(
                    f"memory {name!r}: expected a representation of {group}, the symmetry's group, got one "
                    f"of {representation.group}"
                )

    def read(self, env: Any) -> dict[str, Any]:
        """A copy of what the environment remembers.

        Raises:
            KeyError: something declared is not there, or something there is not declared.
            TypeError: a value is no array, tensor or number.
            ValueError: a size differs from its representation's.
        """
        values = copy.deepcopy(dict(checks.mapping("save", self.save(env), "names to arrays")))
        if values.keys() != self.representations.keys():
            raise KeyError(f"save: expected values for {list(self.representations)}, got {list(values)}")
        for name, value in values.items():
            if not isinstance(value, np.ndarray | np.generic | Tensor | int | float):
                raise TypeError(
                    f"memory {name!r}: expected an array, a tensor or a number, got {checks.shown(value)}; "
                    "give Remembered(..., save=..., load=...), which turn it into arrays and back"
                )
            size, dim = (
                checks.array(f"memory {name!r}", value, finite=False).numel(),
                self.representations[name].dim,
            )
            if size != dim:
                raise ValueError(
                    f"memory {name!r}: the environment remembers {size} entries, its representation has "
                    f"{dim}; list every entry in order"
                )
        return values

    def write(self, env: Any, values: dict[str, Any]) -> None:
        """Put back what `read` returned, or its image."""
        self.load(env, copy.deepcopy(values))

    def image(self, values: dict[str, Any], g: int) -> dict[str, Any]:
        """Images of all values, each in the form in which it came."""
        return {name: _image(self.representations[name], value, g) for name, value in values.items()}


def remembered(memory: Any) -> Remembered | None:
    """An argument ``memory``: None, `Remembered`, or a mapping of attributes to representations."""
    return memory if memory is None or isinstance(memory, Remembered) else Remembered(memory)


def _image(representation: Representation, value: Any, g: int) -> Any:
    x = torch.as_tensor(value)
    image = representation(x.double().reshape(representation.event_shape), g)
    image = (image if x.is_floating_point() else image.round()).to(x.dtype).reshape(x.shape)
    if isinstance(value, Tensor):
        return image.to(value.device)
    return image.numpy() if isinstance(value, np.ndarray) else type(value)(image.item())


def _attributes(names: Mapping[str, Any]) -> Callable[[Any], dict[str, Any]]:
    def save(env: Any) -> dict[str, Any]:
        try:
            return {name: attrgetter(name)(env) for name in names}
        except AttributeError as error:
            raise KeyError(
                f"memory: expected attributes {list(names)} of the environment: {error}"
            ) from error

    return save


def _set_attributes(env: Any, values: dict[str, Any]) -> None:
    for name, value in values.items():
        owner, _, attribute = name.rpartition(".")
        setattr(attrgetter(owner)(env) if owner else env, attribute, value)
