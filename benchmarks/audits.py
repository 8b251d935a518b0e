"""How long an audit takes, beside deriving the symmetry that it examines.

One table of speed.py.
A terrain grows the geoms of the world, free cubes the bodies, and robots are what most people bring. Time
should follow the size of the model; a table that grows with the square of it shows at once.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Iterator
from statistics import median

import mujoco
import numpy as np

import tasks
from measuring import interleave, ratio
from torchrl_sym import PointGroup
from torchrl_sym.mujoco import audit, derive

GROUP = PointGroup.reflection("y")
FLOOR = '<geom type="plane" size="50 50 1"/>'
WALKER = """<body pos="0 0 2"><freejoint/><geom type="box" size=".2 .1 .05"/>
  <body pos="0 .15 0"><joint axis="0 1 0"/><geom size=".03"/></body>
  <body pos="0 -.15 0"><joint axis="0 1 0"/><geom size=".03"/></body></body>"""


def terrain(boxes: int) -> str:
    """A walker on mirrored boxes."""
    rng, text = np.random.default_rng(0), ""
    for x, y, height in rng.uniform((-20, 0.5, 0.1), (20, 20, 0.5), (boxes // 2, 3)):
        for side in (y, -y):
            text += f'<geom type="box" size=".3 .2 {height}" pos="{x} {side} 0"/>'
    return f"<mujoco><worldbody>{text}{WALKER}</worldbody></mujoco>"


def cubes(count: int) -> str:
    """Free cubes in rows of eight."""
    body = '<body pos="{} {} 1"><freejoint/><geom type="box" size=".1 .1 .1"/></body>'
    text = "".join(body.format(k // 8, k % 8 - 3.5) for k in range(count))
    return f"<mujoco><worldbody>{FLOOR}{text}</worldbody></mujoco>"


def models(names: tuple[str, ...]) -> Iterator[tuple[str, mujoco.MjModel, PointGroup]]:
    """Models made here, and those of the tasks with their groups."""
    for boxes in (200, 1000, 6426):
        yield f"{boxes} boxes", mujoco.MjModel.from_xml_string(terrain(boxes)), GROUP
    for count in (16, 64):
        yield f"{count} cubes", mujoco.MjModel.from_xml_string(cubes(count)), GROUP
    for name in names:
        env = tasks.make_env(name, num_envs=1)
        yield name, env.task.model, env.symmetry.group


def measure_audits(names: tuple[str, ...], rounds: int) -> Iterator[dict]:
    """Milliseconds per audit of all elements of a group, and the ratio to derive."""
    for name, model, group in models(names):
        variants = {
            "derive": functools.partial(derive, model, group),
            "audit": functools.partial(audit, model, group),
        }
        seconds = interleave(variants, rounds, time.process_time)
        yield {
            "model": name,
            "geoms": model.ngeom,
            "order": group.order,
            **{f"{key}_ms": 1e3 * median(values) for key, values in seconds.items()},
            "over_derive": ratio(seconds, "audit", "derive"),
        }
