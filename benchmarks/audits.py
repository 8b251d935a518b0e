"""How long an audit takes, beside deriving the symmetry that it examines.

    python benchmarks/audits.py --menagerie ~/mujoco_menagerie  derive and audit every model of a checkout
    python benchmarks/audits.py --also FOLDER                   of any folder of .xml and .mjb files

The second table of this file is one of speed.py, of models made here and of the tasks.
A terrain grows the geoms of the world, free cubes the bodies, and robots are what most people bring. Time
should follow the size of the model; a table that grows with the square of it shows at once.
"""

from __future__ import annotations

import functools
import sys
import time
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path
from statistics import median

import mujoco
import numpy as np
import tyro

import tasks
from catalogue.sources import Source, load
from measuring import interleave, ratio
from torchrl_sym import PointGroup
from torchrl_sym.mujoco import audit, derive

GROUP = PointGroup.reflection("y")
LIMIT = 0.1  # seconds within which the audit of nearly every public robot is to come
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


@dataclass
class Arguments:
    """Derive and audit the mirror of left and right of every model in some folders, in CPU time."""

    menagerie: Path | None = None
    """A checkout of mujoco_menagerie."""
    also: tuple[Path, ...] = ()
    """Further folders, of .xml and compiled .mjb files."""
    only: tuple[str, ...] = ()
    """Patterns of keys to measure."""
    rounds: int = 2
    """Of each model the fastest of so many counts."""


def public_models(source: Source) -> Iterator[tuple[str, mujoco.MjModel]]:
    """Keys and models of a folder; pieces, and what does not compile, are left out."""
    if not source.root.is_dir():
        raise NotADirectoryError(f"{source.name}: expected a folder of models, {source.root} is none")
    for key, path in source.files():
        loaded = load(path)
        if loaded.model is not None and not loaded.is_piece:
            yield key, loaded.model
    for path in sorted(source.root.rglob("*.mjb")):
        model = mujoco.MjModel.from_binary_path(str(path))
        if model.nv:
            yield f"{source.name}/{path.relative_to(source.root).as_posix()}", model


def fastest(model: mujoco.MjModel, rounds: int) -> float:
    """CPU seconds of the fastest audit."""
    seconds = []
    for _ in range(rounds):
        start = time.process_time()
        audit(model, GROUP)
        seconds.append(time.process_time() - start)
    return min(seconds)


def summary(seconds: dict[str, float]) -> str:
    """Median, share within the limit and 95th percentile, and the models beyond the limit."""
    values = np.array(list(seconds.values()))
    lines = [
        f"{len(values)} models: median {np.median(values):.3f} s, {np.mean(values < LIMIT):.1%} "
        f"below {LIMIT} s, 95th percentile {np.quantile(values, 0.95):.3f} s (CPU time)"
    ]
    slowest = sorted(seconds.items(), key=lambda item: -item[1])
    return "\n".join([*lines, *(f"{value:8.3f} s  {key}" for key, value in slowest if value >= LIMIT)])


def main(arguments: Arguments) -> int:
    """Measure and print; the exit status is 1 if there is nothing to measure."""
    found = [Source("menagerie", arguments.menagerie)] if arguments.menagerie else []
    found += [Source(folder.resolve().name, folder) for folder in arguments.also]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        seconds = {
            key: fastest(model, arguments.rounds)
            for source in found
            for key, model in public_models(source)
            if not arguments.only or any(fnmatchcase(key, pattern) for pattern in arguments.only)
        }
    print(summary(seconds) if seconds else "no models: give --menagerie or --also a folder that has some")
    return int(not seconds)


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Arguments)))
