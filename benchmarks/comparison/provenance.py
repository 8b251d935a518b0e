"""Where results come from: the command, the commit, the versions and the machine."""

import os
import platform
import subprocess
import sys
from pathlib import Path
from typing import Any

import mujoco
import tensordict
import torch
import torchrl


def provenance() -> dict[str, Any]:
    """What has to be known to repeat a result."""
    return {
        "command": " ".join(["python", *(_relative(argument) for argument in sys.argv)]),
        "revision": revision(),
        "versions": {
            "python": platform.python_version(),
            **{module.__name__: module.__version__ for module in (torch, torchrl, tensordict, mujoco)},
        },
        "machine": f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores",
    }


def revision() -> str:
    """The commit that made the results."""
    command = ["git", "rev-parse", "--short", "HEAD"]
    out = subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True)
    return out.stdout.strip() or "unknown"


def _relative(argument: str) -> str:
    """An argument without the path of this machine."""
    path = Path(argument)
    return os.path.relpath(path) if path.is_absolute() else argument
