"""Checks of what is given on a command line, before anything starts."""

from collections.abc import Callable, Hashable, Sequence
from typing import Any


def at_least_one(arguments: Any, *names: str) -> None:
    """Refuse a number below one; None is one that was not given.

    Raises:
        ValueError: names the option.
    """
    for name in names:
        value = getattr(arguments, name)
        if value is not None and value < 1:
            raise ValueError(f"expected --{name} of at least 1, got {value}")


def different(name: str, values: Sequence[str], key: Callable[[str], Hashable] = str) -> None:
    """Refuse an option without values, or with two that mean the same.

    Raises:
        ValueError: names the option, and the second of the two.
    """
    if not values:
        raise ValueError(f"expected one or more values of --{name}, got none")
    known: dict[Hashable, str] = {}
    for value in values:
        if key(value) in known:
            raise ValueError(
                f"expected different --{name}, got {known[key(value)]!r} and {value!r}; leave one out"
            )
        known[key(value)] = value
