"""The parts of the library that need more than TorchRL, and how each asks for it.

The core (groups, representations, symmetries, losses, transforms, replay, normalisers) runs on PyTorch,
TensorDict and TorchRL alone, so that it can stand beside whatever a project trains with. The rest comes in
extras, ``pip install 'torchrl_sym[mujoco]'`` for instance. A part that belongs to one says so in its first
lines: whoever lacks a package reads which extra brings it, and not an error from the middle of an import.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping

from packaging.version import Version


def require(part: str, extra: str, packages: Mapping[str, str], remedy: str = "") -> None:
    """Import what a part is built on, before the part itself is imported.

    Args:
        part: what asks, for the message.
        extra: the extra of this project that installs the packages.
        packages: modules by name, each with the oldest version that will do; ``""`` for any.
        remedy: what else helps, after the line for pip.

    Raises:
        ImportError: one is missing or too old. A package that is there but broken raises its own error.

    Example:
        >>> require("reading", "tables", {"json": "", "no_such_table": ""})
        Traceback (most recent call last):
        ImportError: reading needs no_such_table, which is not installed: pip install 'torchrl_sym[tables]'
    """
    for name, oldest in packages.items():
        try:
            version = getattr(importlib.import_module(name), "__version__", "")
        except ModuleNotFoundError as error:
            if error.name != name:
                raise
            missing = f"{part} needs {name}, which is not installed"
        else:
            if not oldest or Version(version) >= Version(oldest):
                continue
            missing = f"{part} needs {name} {oldest} or newer, got {version}"
        raise ImportError(f"{missing}: pip install 'torchrl_sym[{extra}]'" + f"; {remedy}" * bool(remedy))
