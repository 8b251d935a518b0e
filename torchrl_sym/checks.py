"""What an argument has to be: one checker for each kind, so that every mistake gets an answer of one kind.

A mistake that is noticed where it is made costs a minute; one that turns up as a NaN, as a foreign error
further down, or never, costs days. Constructors and functions that begin a computation therefore check what
they are given: the checkers return it in the form that is worked with, and raise TypeError or ValueError
with the argument's name, what was expected, what came, and a remedy where there is more to say. What can be
taken exactly is taken: a NumPy integer is a whole number, and so is 3.0; a list is a sequence like a tuple.

Methods that run once per minibatch check attributes only (a type, a shape).
"""

from __future__ import annotations

import difflib
import functools
import inspect
import numbers
import reprlib
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, ParamSpec, TypeVar

import numpy as np
import torch
from tensordict import NestedKey
from torch import Tensor

T = TypeVar("T")
P = ParamSpec("P")

_PLAIN = (str, bytes, int, float, complex, list, tuple, dict, set, type, np.generic, Tensor)
_SHORT = reprlib.Repr()
_SHORT.maxstring = _SHORT.maxother = 80


def shown(value: Any) -> str:
    """A value for a message: short ones as they are written, others by what they are."""
    if isinstance(value, Tensor | np.ndarray) and value.ndim:
        return f"{type(value).__name__} of shape {tuple(value.shape)}"
    if isinstance(value, int) and value.bit_length() > 64:
        return f"a number of {value.bit_length()} bits"
    return _SHORT.repr(value) if value is None or isinstance(value, _PLAIN) else type(value).__name__


def instance(name: str, value: Any, kind: type[T] | tuple[type[T], ...], remedy: str = "") -> T:
    """An object of a class.

    Raises:
        TypeError: of another.
    """
    if not isinstance(value, kind):
        kinds = kind if isinstance(kind, tuple) else (kind,)
        wanted = " or ".join(k.__name__ for k in kinds)
        raise TypeError(f"{name}: expected {wanted}, got {shown(value)}" + f"; {remedy}" * bool(remedy))
    return value


def function(name: str, value: Any) -> Any:
    """Something that can be called."""
    if not callable(value):
        raise TypeError(f"{name}: expected a function, got {shown(value)}")
    return value


def flag(name: str, value: Any) -> bool:
    """True or False; words and numbers are refused, since ``"no"`` counts as true in Python."""
    if not isinstance(value, bool | np.bool_):
        raise TypeError(f"{name}: expected True or False, got {shown(value)}")
    return bool(value)


def whole(name: str, value: Any, low: int | None = None, high: int | None = None) -> int:
    """A whole number, within bounds that count as allowed.

    Example:
        >>> whole("num_envs", 64.0, low=1)
        64
    """
    number = _number(value)
    if number is None:
        raise TypeError(f"{name}: expected {_span('a whole number', low, high)}, got {shown(value)}")
    if (isinstance(number, float) and not number.is_integer()) or not _within(number, low, None, high):
        raise ValueError(f"{name}: expected {_span('a whole number', low, high)}, got {shown(value)}")
    return int(number)


def real(
    name: str,
    value: Any,
    low: float | None = None,
    high: float | None = None,
    *,
    above: float | None = None,
) -> float:
    """A finite number, of at least ``low`` or more than ``above``.

    Example:
        >>> real("tolerance", float("nan"), low=0.0)
        Traceback (most recent call last):
        ...
        ValueError: tolerance: expected a finite number of at least 0, got nan
    """
    number = _number(value)
    wanted = _span("a finite number", low if above is None else above, high, above is not None)
    if number is None:
        raise TypeError(f"{name}: expected {wanted}, got {shown(value)}")
    if not abs(number) <= sys.float_info.max or not _within(number, low, above, high):
        raise ValueError(f"{name}: expected {wanted}, got {shown(value)}")
    return float(number)


def one_of(name: str, value: Any, choices: Iterable[str], error: type[Exception] = ValueError) -> str:
    """One of a few words.

    Raises:
        ValueError: none of them, or what ``error`` says; the message has the nearest one.
    """
    choices = list(choices)
    if not isinstance(value, str) or value not in choices:
        hint = _nearest(value, choices)
        raise error(f"{name}: expected one of {choices}, got {shown(value)}{hint}")
    return value


def sequence(name: str, value: Any, of: str = "names") -> list[Any]:
    """A list of what can be walked through and is no text, which would be walked through by letters."""
    if isinstance(value, str | bytes) or not isinstance(value, Iterable):
        hint = f"; write [{value!r}]" if isinstance(value, str) else ""
        raise TypeError(f"{name}: expected a sequence of {of}, got {shown(value)}{hint}")
    return list(value)


def mapping(name: str, value: Any, of: str) -> Mapping[Any, Any]:
    """A mapping; ``of`` says from what to what."""
    if not isinstance(value, Mapping):
        raise TypeError(f"{name}: expected a mapping of {of}, got {shown(value)}")
    return value


def entries(name: str, value: Any, *wanted: str) -> list[Any]:
    """Some entries of a mapping, such as a saved state.

    Raises:
        KeyError: one is missing.
    """
    missing = [key for key in wanted if key not in mapping(name, value, "names to values")]
    if missing:
        raise KeyError(f"{name}: expected entries {list(wanted)}, got none for {missing}")
    return [value[key] for key in wanted]


def names(name: str, value: Any, *, least: int = 1) -> list[str]:
    """A list of distinct names, ``least`` of them or more.

    Example:
        >>> names("joints", "knee")
        Traceback (most recent call last):
        ...
        TypeError: joints: expected a sequence of names, got 'knee'; write ['knee']
    """
    if isinstance(value, set | frozenset):
        raise TypeError(f"{name}: expected a sequence of names, got a set, which has no order; use a list")
    listed = sequence(name, value)
    for entry in listed:
        if not isinstance(entry, str) or not entry:
            raise TypeError(f"{name}: expected names, got {shown(entry)} among them")
    if len(listed) < least:
        raise ValueError(f"{name}: expected at least {least} of them, got {shown(listed)}")
    if len(set(listed)) != len(listed):
        raise ValueError(f"{name}: expected distinct names, got {shown(listed)}")
    return listed


def array(name: str, value: Any, finite: bool = True) -> Tensor:
    """Real numbers as a float64 tensor: a tensor, an array, nested lists."""
    try:
        is_complex = value.is_complex() if isinstance(value, Tensor) else np.iscomplexobj(value)
        tensor = None if is_complex else torch.as_tensor(value, dtype=torch.float64, device="cpu")
    except (TypeError, ValueError, RuntimeError):
        tensor = None
    if tensor is None:
        raise TypeError(f"{name}: expected a tensor or nested lists of real numbers, got {shown(value)}")
    if finite and not tensor.isfinite().all():
        raise ValueError(f"{name}: expected finite numbers, got NaN or infinity among them")
    return tensor


def key(name: str, value: Any) -> NestedKey:
    """The key of an entry in a tensordict, in its shortest spelling: ``"a"`` for ``("a",)``.

    Example:
        >>> key("key", ("agents", ("observation",)))
        ('agents', 'observation')
    """
    parts = [*_parts(value)]
    if not parts or not all(isinstance(part, str) and part for part in parts):
        raise TypeError(f"{name}: expected a key, which is a name or a tuple of names, got {shown(value)}")
    return tuple(parts) if len(parts) > 1 else parts[0]


def refuse_unknown(what: str, given: Iterable[str], accepted: Sequence[str]) -> None:
    """Refuse keyword arguments that nobody would read.

    Raises:
        TypeError: the message has the nearest one that is accepted.
    """
    for name in given:
        if name not in accepted:
            hint = _nearest(name, accepted)
            raise TypeError(
                f"{what}: expected keyword arguments among {list(accepted)}, got {name!r}{hint}"
            )


def keywords(cls: type) -> list[str]:
    """Keyword arguments of a constructor, with those it hands on to its base classes by ``**``."""
    found: list[str] = []
    for ancestor in cls.__mro__:
        if "__init__" not in vars(ancestor):
            continue
        parameters = inspect.signature(ancestor.__init__).parameters.values()
        named = [p for p in parameters if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)]
        found += [p.name for p in named[1:] if p.name not in found]
        if all(p.kind is not p.VAR_KEYWORD for p in parameters):
            break
    return found


def near_names(init: Callable[P, None]) -> Callable[P, None]:
    """Decorate a constructor: a misspelt keyword is refused with the nearest name there is."""
    accepted = list(inspect.signature(init).parameters)[1:]

    @functools.wraps(init)
    def checked(*args: P.args, **kwargs: P.kwargs) -> None:
        refuse_unknown(type(args[0]).__name__, kwargs, accepted)
        init(*args, **kwargs)

    return checked


def _number(value: Any) -> int | float | None:
    """A number as Python's, None if it is none; True is none."""
    if isinstance(value, Tensor | np.ndarray | np.generic) and value.ndim == 0:
        value = value.item()
    if isinstance(value, bool) or not isinstance(value, numbers.Real):
        return None
    return int(value) if isinstance(value, numbers.Integral) else float(value)


def _within(number: float, low: float | None, above: float | None, high: float | None) -> bool:
    return (
        (low is None or number >= low)
        and (above is None or number > above)
        and (high is None or number <= high)
    )


def _span(what: str, low: float | None, high: float | None, exclusive: bool = False) -> str:
    if low is None:
        return what
    least, most = (x if isinstance(x, int | None) else f"{x:g}" for x in (low, high))
    if high is None:
        return f"{what} above {least}" if exclusive else f"{what} of at least {least}"
    return f"{what} above {least} and at most {most}" if exclusive else f"{what} from {least} to {most}"


def _nearest(value: Any, choices: Iterable[str]) -> str:
    close = difflib.get_close_matches(str(value), [*choices], n=1)
    return f"; did you mean {close[0]!r}?" if close else ""


def _parts(key: Any) -> Iterable[Any]:
    if not isinstance(key, tuple):
        yield key
        return
    for part in key:
        yield from _parts(part)
