"""Robot tasks with exact symmetry, in two faces made from one description.

`make_env` builds a batched TorchRL environment, `load` a dm_control environment, `ALL_TASKS` lists
the names.
"""

from typing import TYPE_CHECKING, Any

from torchrl_sym.extras import require

require("tasks", "tasks", {"mujoco": "3.17", "scipy": ""})  # mujoco.batch came with 3.17

from tasks import anymal_climb as anymal_climb
from tasks import anymal_push as anymal_push
from tasks import base
from tasks import cartpole as cartpole
from tasks import trifinger_repose as trifinger_repose
from tasks.making import make_env

if TYPE_CHECKING:
    from tasks.suite import load

ALL_TASKS = base.registered()

__all__ = ["ALL_TASKS", "load", "make_env"]


def __getattr__(name: str) -> Any:
    # dm_control takes a second to import and probes for a display: only those who use it pay.
    if name == "load":
        remedy = "on Python 3.13 or newer it cannot be installed (no labmaze): take 3.12, or tasks.make_env"
        require("tasks.load", "tasks", {"dm_control": ""}, remedy)
        from tasks.suite import load

        return load
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
