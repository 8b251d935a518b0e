"""Robot tasks with exact symmetry, in two faces made from one description.

`make_env` builds a batched TorchRL environment, `load` a dm_control environment, `ALL_TASKS` lists
the names.
"""

from typing import TYPE_CHECKING, Any

from tasks import anymal_climb as anymal_climb
from tasks import anymal_push as anymal_push
from tasks import base
from tasks import cartpole as cartpole
from tasks import trifinger_repose as trifinger_repose
from tasks.environment import make_env

if TYPE_CHECKING:
    from tasks.suite import load

ALL_TASKS = base.registered()

__all__ = ["ALL_TASKS", "load", "make_env"]


def __getattr__(name: str) -> Any:
    # dm_control takes a second to import and probes for a display: only those who use it pay.
    if name == "load":
        from tasks.suite import load

        return load
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
