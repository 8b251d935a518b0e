"""Where results come from: the command, the commit, the versions and the machine."""

import os
import platform
import shlex
import subprocess
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import mujoco
import tensordict
import torch
import torchrl


def origin() -> dict[str, Any]:
    """The code that runs here: its commit, versions and machine."""
    return {
        "revision": revision(),
        "versions": {
            "python": platform.python_version(),
            **{module.__name__: module.__version__ for module in (torch, torchrl, tensordict, mujoco)},
        },
        "machine": f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores",
    }


def joint_origin(origins: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Origins of several runs as one: commits as a list, what differs elsewhere side by side.

    An origin may have been joined before.
    """
    names = dict.fromkeys(name for each in origins for name in each["versions"])
    return {
        "revisions": sorted({each["revision"] for each in origins}),
        "versions": {
            name: _side_by_side(each["versions"].get(name, "none") for each in origins) for name in names
        },
        "machine": _side_by_side(each["machine"] for each in origins),
    }


def _side_by_side(texts: Iterable[str]) -> str:
    return " / ".join(sorted({each for text in texts for each in text.split(" / ")}))


def command() -> str:
    """The command line as it was given, to be given again; paths as seen from where it was given."""
    return shlex.join(["python", *(_relative(argument) for argument in sys.argv)])


def revision() -> str:
    """The commit of this code, with a plus sign if files have been changed since."""
    out = _git("rev-parse", "--short", "HEAD")
    changed = _git("status", "--porcelain", "--untracked-files=no", "--", "*.py", "*.xml")
    return f"{out or 'unknown'}{'+' if changed else ''}"


def _git(*arguments: str) -> str:
    command = ["git", *arguments]
    root = Path(__file__).parents[2]
    return subprocess.run(command, cwd=root, capture_output=True, text=True).stdout.strip()


def _relative(argument: str) -> str:
    """An argument, `--option=VALUE` too, without the path of this machine."""
    option, equals, value = argument.rpartition("=")
    return f"{option}{equals}{os.path.relpath(value) if Path(value).is_absolute() else value}"
