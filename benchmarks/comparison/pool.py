"""Executes runs in parallel: one process each, a bar for each, and none stops the others.

Here they are processes; `cluster.py` has them on other machines.

Processes are forked from a server that has imported everything once, so that a run starts in a fraction of
a second. They report through their files alone (`Run.progress`), end with the process that started them,
and may crash: what happened is in the run's `log.txt`.
"""

import multiprocessing
import os
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from typing import Any, Protocol

from tqdm import tqdm

from comparison.provenance import origin
from comparison.run import Run
from torchrl_sym.recipes.workers import end_with_parent

POLL = 0.5  # seconds between two looks at the runs' files


def damaged(runs: Sequence[Run]) -> list[Run]:
    """Runs of which a file is damaged: it is left as it is, and they can neither be used nor continued."""
    return [run for run in runs if run.damage()]


def report(failed: Sequence[Run]) -> None:
    """Say which runs failed, and where to look, or what to do about a damaged file."""
    for run in failed:
        log = run.folder / "log.txt"
        print(f"FAILED: {run} ({run.damage() or f'see {log}'})")


class Worker(Protocol):
    """What executes a run, here or elsewhere, as a process of `multiprocessing` does."""

    @property
    def exitcode(self) -> int | None: ...
    def is_alive(self) -> bool: ...
    def terminate(self) -> None: ...
    def join(self) -> None: ...


Start = Callable[[Run, dict[str, Any]], Worker]
"""Starts a run, given the code that it is to be executed with (`provenance.origin`)."""


def execute_all(runs: Sequence[Run], workers: int, start: Start | None = None) -> list[Run]:
    """Execute what is not finished, at most `workers` at a time; returns the runs that failed.

    Args:
        runs: all of them.
        workers: runs at a time.
        start: how a run is started; in a process of this machine by default.

    Raises:
        ValueError: less than one worker.
    """
    if workers < 1:
        raise ValueError(f"expected at least one worker, got {workers}")
    failed = damaged(runs)
    runs = [run for run in runs if run not in failed]
    start = start or _processes()
    code = origin()  # that which the server loads now, whatever is committed while runs wait
    waiting = [run for run in runs if run.result() is None]
    active: dict[int, tuple[Run, Worker, tqdm]] = {}  # by line on the screen
    total = sum(run.iterations for run in runs)
    before = total - sum(run.iterations - run.progress()[0] for run in waiting)
    bar = tqdm(total=total, initial=before, unit="it", smoothing=0.02, disable=None)
    bar.set_description(f"{len(runs) - len(waiting)}/{len(runs)} runs")
    ended = len(runs) - len(waiting)
    try:
        while waiting or active:
            for line in range(1, workers + 1):
                if waiting and line not in active:
                    run = waiting.pop(0)
                    active[line] = (run, start(run, code), _bar(run, line))
            time.sleep(POLL)
            for line, (run, process, own) in list(active.items()):
                done, latest = run.progress()
                bar.update(done - own.n)
                own.update(done - own.n)
                own.set_postfix_str(f"return {latest:.2f}")
                if process.is_alive():
                    continue
                own.close()
                del active[line]
                ended += 1
                bar.set_description(f"{ended}/{len(runs)} runs")
                result = run.result()
                if result is None:
                    failed.append(run)
                tqdm.write(f"[{ended}/{len(runs)}] {run}: {_report(run, result, process.exitcode)}")
    finally:
        for _, process, own in active.values():
            process.terminate()
            process.join()
            own.close()
        bar.close()
    return failed


def _processes() -> Start:
    """Starts runs in processes of their own, forked from a server that has imported everything."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["torchrl_sym.recipes", "tasks.evaluation", "tyro", "tqdm"])

    def start(run: Run, code: dict[str, Any]) -> Worker:
        process = context.Process(target=_work, args=(run, code), name=str(run))
        process.start()
        return process

    return start


def _bar(run: Run, line: int) -> tqdm:
    bar = tqdm(total=run.iterations, initial=run.progress()[0], position=line, leave=False, disable=None)
    bar.set_description(str(run))
    return bar


def _report(run: Run, result: dict | None, exitcode: int | None) -> str:
    if result is None:
        log = run.folder / "log.txt"
        text = log.read_text().strip().splitlines() if log.exists() else []
        return f"FAILED with exit code {exitcode}: {text[-1] if text else 'no output'} (see {log})"
    if result["outcome"] != "finished":
        return f"{result['outcome']} (after {result['iterations']} iterations)"
    first = result["evaluation"][0]["what"] if result["evaluation"] else None
    kind = (first, "deterministic")
    rows = [row for row in result["evaluation"] if (row["what"], row["actions"]) == kind]
    returns = ", ".join(f"{row['goal']} {float(row['return']):.2f}" for row in rows)
    return f"{returns} ({result['seconds']:.0f} s)"


def _work(run: Run, code: dict) -> None:
    """The life of a worker: all it prints goes to its log."""
    end_with_parent()
    run.folder.mkdir(parents=True, exist_ok=True)
    with (run.folder / "log.txt").open("a") as log:
        os.dup2(log.fileno(), 1)
        os.dup2(log.fileno(), 2)
    try:
        run.execute(code)
    except Exception:
        traceback.print_exc()
        sys.exit(1)
