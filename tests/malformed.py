"""Malformed input by the kind of its argument, and what becomes of it: the generator of test_malformed*.py.

A `Subject` is a public callable with a valid call. Each of its arguments is an `Argument`: a value that is
right, and a family of values that are wrong by its kind (a count, a number, a name, a group, ...), some of
them drawn. `outcomes` tries the wrong ones one at a time, all other arguments being right, and judges:

- ``ours``: refused by a ``raise`` of this project's packages, with a message that says what was expected or
  what to do;
- ``obscure``: refused by somebody else, or without such a message;
- ``accepted``: nothing happened, which is worst;
- ``hanging``: no answer within two seconds of the processor's time.

A value that can be handled exactly (a NumPy integer for a count, a list for a tuple) is not malformed, and
in no family.
"""

from __future__ import annotations

import contextlib
import functools
import linecache
import math
import random
import re
import signal
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

PACKAGES = tuple(str(Path(__file__).resolve().parents[1] / name) for name in ("torchrl_sym", "tasks"))
PATIENCE = 2.0  # seconds
REFUSALS = (
    ValueError,
    TypeError,
    KeyError,
    RuntimeError,
    FileNotFoundError,
)  # AttributeError and IndexError explain nothing
# What a message of ours has: what was expected, a remedy after a semicolon, or a list of what there is.
HELPFUL = re.compile(r"expected|did you mean|; |\[.*\]")
DRAW = random.Random(0)
FORMER_NAMES = ("entropy_coef", "critic_coef")  # which TorchRL itself refuses, in words of its own


@dataclass(frozen=True)
class Argument:
    """A right value of one argument, and wrong ones by what is wrong with them."""

    right: Any
    wrong: dict[str, Any]

    def but(self, *labels: str, **more: Any) -> Argument:
        """Without some of the wrong values, and with others."""
        kept = {label: value for label, value in self.wrong.items() if label not in labels}
        return Argument(self.right, kept | more)


@dataclass(frozen=True)
class Subject:
    """A callable, its arguments, and the names of those that are also tried misspelt."""

    name: str
    call: Callable[..., Any]
    arguments: dict[str, Argument]
    misspelt: tuple[str, ...] = ()

    def right(self) -> dict[str, Any]:
        return {name: argument.right for name, argument in self.arguments.items()}

    def cases(self) -> Iterator[tuple[str, dict[str, Any]]]:
        """Labels and keyword arguments of all malformed calls."""
        for name, argument in self.arguments.items():
            for label, value in argument.wrong.items():
                yield f"{name}: {label}", self.right() | {name: value}
        for name in self.misspelt:
            value = self.arguments[name].right if name in self.arguments else 0.1
            others = {key: right for key, right in self.right().items() if key != name}
            yield f"{name} misspelt", others | {misspelling(name): value}


def subject(name: str, call: Callable[..., Any], misspelt: str = "", /, **arguments: Argument) -> Subject:
    return Subject(name, call, arguments, tuple(misspelt.split()))


def outcomes(tried: Subject) -> dict[str, tuple[str, str]]:
    """Verdict and message of every malformed call."""
    return {label: judge(functools.partial(tried.call, **arguments)) for label, arguments in tried.cases()}


def assert_refused(tried: Subject) -> None:
    """The right call works, and every malformed one is refused by a message of ours."""
    tried.call(**tried.right())
    wrong = [
        f"{label} is {verdict}: {message}"
        for label, (verdict, message) in outcomes(tried).items()
        if verdict != "ours"
    ]
    assert not wrong, f"{tried.name}\n" + "\n".join(wrong)


def each(subjects: list[Subject]) -> pytest.MarkDecorator:
    """Parametrise a test over subjects."""
    return pytest.mark.parametrize("tried", subjects, ids=[tried.name for tried in subjects])


def judge(call: Callable[[], Any]) -> tuple[str, str]:
    """What became of a malformed call, and the message it got."""
    try:
        with _patience():
            call()
    except _Hanging:
        return "hanging", f"no answer within {PATIENCE} s"
    except Exception as error:
        return ("ours" if _is_ours(error) else "obscure"), f"{type(error).__name__}: {error}"
    return "accepted", "no error"


@contextlib.contextmanager
def _patience() -> Iterator[None]:
    """Raises after PATIENCE seconds of work, whatever else the machine does, or 30 times that in all."""
    timers = ((signal.ITIMER_PROF, signal.SIGPROF, 1), (signal.ITIMER_REAL, signal.SIGALRM, 30))
    previous = [signal.signal(number, _ring) for _, number, _ in timers]
    try:
        for timer, _, factor in timers:
            signal.setitimer(timer, factor * PATIENCE)
        yield
    finally:
        for (timer, number, _), handler in zip(timers, previous, strict=True):
            signal.setitimer(timer, 0)
            signal.signal(number, handler)


class _Hanging(BaseException):
    pass


def _ring(*_: Any) -> None:
    raise _Hanging


def _is_ours(error: Exception) -> bool:
    frame = traceback.extract_tb(error.__traceback__)[-1]
    raised = linecache.getline(frame.filename, frame.lineno or 0).strip().startswith("raise ")
    ours = frame.filename.startswith(PACKAGES) and raised
    return ours and isinstance(error, REFUSALS) and HELPFUL.search(str(error)) is not None


def misspelling(name: str) -> str:
    """A name with one letter left out, doubled or changed, which depends on nothing but the name."""
    draw = random.Random(name)
    while True:
        at = draw.randrange(1, len(name))
        wrong = name[:at] + draw.choice(["", 2 * name[at], "q"]) + name[at + 1 :]
        if wrong not in FORMER_NAMES:
            return wrong


# Families by the kind of an argument.


def thing(right: Any, **more: Any) -> Argument:
    """An object of one class: anything of another class is wrong."""
    wrong = {
        "None": None,
        "a number": 3,
        "text": "seven",
        "a list": [right],
        "a dictionary": {"a": right},
        "a tensor": torch.ones(2, 3),
        "its class": type(right),
        "an object": object(),
    }
    return Argument(right, wrong | more)


def count(right: int, low: int = 1, **more: Any) -> Argument:
    """A whole number."""
    wrong = {
        "below": low - 1,
        "far below": -DRAW.randrange(10, 1000),
        "a fraction": right + DRAW.uniform(0.1, 0.9),
        "an array": np.array([right, right]),
    }
    return Argument(right, wrong | _no_numbers(right) | more)


def number(right: float, low: float = 0.0, **more: Any) -> Argument:
    """A finite number of at least ``low``, which may be minus infinity."""
    below = {"negative": low - DRAW.uniform(0.1, 9.0)} if math.isfinite(low) else {}
    wrong = {
        "NumPy's NaN": np.float64("nan"),
        "a tensor's NaN": torch.tensor(math.nan),
        "minus infinite": -math.inf,
        "too many digits": 10**400,
        "an object": object(),
    }
    return Argument(right, wrong | _no_numbers(right) | below | more)


def _no_numbers(right: float) -> dict[str, Any]:
    """What is neither a whole number nor a finite one."""
    return {
        "NaN": math.nan,
        "infinite": math.inf,
        "true": True,
        "text": str(right),
        "None": None,
        "a list": [right],
        "a complex number": complex(right),
        "a tensor": torch.tensor([right, right]),
    }


def flag(right: bool) -> Argument:
    """True or False."""
    words = {
        "yes": "yes",
        "the word False": "False",
        "None": None,
        "half": 0.5,
        "a list": [right],
        "two": 2,
    }
    return Argument(right, words | {"a tensor": torch.tensor([True, False]), "an object": object()})


def choice(right: str, **more: Any) -> Argument:
    """One of a few words."""
    wrong = {
        "misspelt": misspelling(right) if len(right) > 1 else right + "q",
        "empty": "",
        "other case": right.swapcase(),
        "bytes": right.encode(),
        "None": None,
        "a number": DRAW.randrange(5, 50),
        "NaN": math.nan,
        "a list": [right],
        "true": True,
        "an object": object(),
    }
    return Argument(right, wrong | more)


def names(right: list[str], ordered: bool = False, **more: Any) -> Argument:
    """A sequence of names from a list; ``ordered`` if their order matters, which a set has not."""
    wrong = {
        "one text": right[0],
        "empty": [],
        "None": None,
        "a number": 3,
        "numbers": [math.pi] * len(right),
        "Nones": [None] * len(right),
        "one misspelt": [misspelling(right[0]), *right[1:]],
        "one twice": [*right, right[0]],
        "nested": [right],
        "an object": object(),
    }
    unordered = {"without order": set(right)} if ordered else {}
    return Argument(right, wrong | unordered | more)


def element(right: str, order: int, **more: Any) -> Argument:
    """A group element by name or index."""
    wrong = {
        "beyond": order,
        "negative": -DRAW.randrange(1, 9),
        "a fraction": 0.5,
        "NaN": math.nan,
        "true": True,
    }
    words = choice(right).but("a number", "NaN", "true").wrong
    return Argument(right, words | wrong | more)


def array(right: torch.Tensor, shaped: bool = True, **more: Any) -> Argument:
    """A tensor of finite numbers; ``shaped`` if its sizes matter."""
    size, at = list(right.shape), DRAW.randrange(right.numel())
    grown = DRAW.randrange(len(size))
    wrong: dict[str, Any] = {
        "None": None,
        "text": "seven",
        "a number": DRAW.randrange(3, 9),
        "a dictionary": {"a": right},
        "an object": object(),
        "ragged": [[1.0], [1.0, 2.0]],
        "words": [["a", "b"]],
        "complex": right.to(torch.complex64),
        "empty": right[:0],
    }
    for label, value in (("NaN", math.nan), ("infinite", math.inf)):
        wrong[label] = right.clone().double()
        wrong[label].view(-1)[at] = value
    if shaped:
        wrong["another size"] = torch.zeros([n + (i == grown) for i, n in enumerate(size)])
        wrong["one more dimension"] = right[None]
    return Argument(right, wrong | more)


def tensor(right: torch.Tensor, **more: Any) -> Argument:
    """A tensor of which only type and shape are looked at, where minibatches pass."""
    unseen = ("a number", "NaN", "infinite", "empty", "complex", "another size", "one more dimension")
    return array(right).but(*unseen, **more)


def function(right: Callable[..., Any]) -> Argument:
    """Something to be called."""
    return Argument(right, {"a number": 3, "text": "seven", "a list": [right], "a tensor": torch.ones(2)})


def optional(argument: Argument) -> Argument:
    """The same where None stands for a default."""
    return argument.but("None")


def of_three(*shape: int) -> dict[str, torch.Tensor]:
    """Tensors of more rows, and of more dimensions, than the others have."""
    return {"of three rows": torch.zeros(shape), "one more dimension": torch.zeros(2, *shape)}


generator = optional(thing(torch.Generator(), **{"a NumPy generator": np.random.default_rng(0)}))
