"""Trifinger-Repose with a heading: bring the cube to a place on the table, turned as the goal is.

    python benchmarks/compare.py --preset paper-repose-yaw

The difficulty after `trifinger_repose`, which it begins with: a policy that can move the cube learns to
turn it. It is given to `compare.py` as any task of one's own, by a module with `make_env` and `SETTING`.
"""

import dataclasses
import functools
import math

import tasks
from tasks.settings import SETTINGS, Setting
from torchrl_sym.recipes import Stage

make_env = functools.partial(tasks.make_env, "trifinger_repose", num_threads=1)

_PLACES = SETTINGS["trifinger_repose"]
_STEADY = _PLACES.then[0]
_HEADING = {"yaw": math.pi}  # at the last level; an eighth of it at the first

SETTING = Setting(
    _PLACES.config,
    _PLACES.task,
    evaluations={"up to half a turn": _HEADING},
    then=(
        # 6.6 M steps, then 3.3 M with little noise on the whole range: after 1.6 M of them success was
        # still rising, and mean actions were behind sampled ones (79 and 88 %, augmentation, seed 0).
        Stage(dataclasses.replace(_PLACES.config, iterations=800), _PLACES.task | _HEADING),
        Stage(dataclasses.replace(_STEADY.config, iterations=400), _STEADY.task | _HEADING),
    ),
)
