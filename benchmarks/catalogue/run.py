"""Examines files in parallel: one process each, with a time limit, so that none can stop the others."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import multiprocessing
import sys
import time
import traceback
import warnings
from collections.abc import Sequence
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from tqdm import tqdm

from catalogue.examine import Row, examine
from catalogue.expectations import Expectation
from torchrl_sym.recipes.workers import end_with_parent

Job = tuple[str, Path, Expectation | None]


def examine_all(jobs: Sequence[Job], workers: int, limit: float, kept: Path | None = None) -> list[Row]:
    """Rows of all files that are whole models, in order.

    Args:
        jobs: keys, paths, and what is expected.
        workers: processes at a time.
        limit: seconds for each, compilation included.
        kept: file of rows that are known already, to which new ones are added; None for no file.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["catalogue.examine"])
    rows = {} if kept is None else _known(kept)
    waiting = [job for job in jobs if job[0] not in rows]
    active: dict[Connection, tuple[str, Any, float]] = {}
    bar = tqdm(total=len(jobs), initial=len(jobs) - len(waiting), unit="file", disable=None)
    while waiting or active:
        while waiting and len(active) < workers:
            key, path, expected = waiting.pop(0)
            mine, theirs = context.Pipe(duplex=False)
            process = context.Process(target=_work, args=(theirs, key, path, expected), daemon=True)
            process.start()
            theirs.close()
            active[mine] = key, process, time.monotonic() + limit
        ready = wait(list(active), timeout=0.2)
        for connection, (key, process, deadline) in list(active.items()):
            if connection in ready:
                rows[key] = _receive(connection, key)
            elif time.monotonic() > deadline:
                process.kill()
                rows[key] = Row(key, f"took more than {limit:g} s")
            else:
                continue
            process.join()
            del active[connection]
            bar.update()
            _say(rows[key])
            if kept is not None:
                _keep(kept, key, rows[key])
    bar.close()
    return [rows[key] for key, _, _ in jobs if rows[key] is not None]


def _known(kept: Path) -> dict[str, Row | None]:
    """Rows by key; None for files that are pieces of others. A last line that was cut off is left out."""
    rows: dict[str, Row | None] = {}
    text = kept.read_text() if kept.exists() else ""
    for line in text.splitlines():
        with contextlib.suppress(json.JSONDecodeError):
            key, row = json.loads(line)
            tuples = {} if row is None else {name: tuple(row[name]) for name in ("axis", "stand_ins")}
            rows[key] = None if row is None else Row(**row | tuples)
    if text and not text.endswith("\n"):
        kept.write_text(f"{text}\n")
    return rows


def _keep(kept: Path, key: str, row: Row | None) -> None:
    kept.parent.mkdir(parents=True, exist_ok=True)
    with kept.open("a") as file:
        file.write(json.dumps([key, None if row is None else dataclasses.asdict(row)]) + "\n")


def _say(row: Row | None) -> None:
    """What needs a person's eye is said at once: the whole run takes half an hour."""
    for text in [] if row is None else [row.error] * bool(row.error) + row.against:
        tqdm.write(f"{row.key}: {text}", file=sys.stderr)


def _work(connection: Connection, key: str, path: Path, expected: Expectation | None) -> None:
    """In a process of its own: examine one file and send its row."""
    end_with_parent()
    warnings.simplefilter("ignore")
    try:
        connection.send(examine(key, path, expected))
    except Exception:  # whatever it is, the other models are to be examined
        last = traceback.format_exc().strip().splitlines()[-1]
        connection.send({"key": key, "error": f"the library failed: {last}"})


def _receive(connection: Connection, key: str) -> Row | None:
    try:
        data = connection.recv()
    except EOFError:
        return Row(key, "the process died")
    return None if data is None else Row(**data)
