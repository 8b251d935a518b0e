"""Runs of a comparison on a Ray cluster (https://docs.ray.io), many machines or this one.

Ray decides where a run goes, and starts it again, on another machine if need be, when its worker dies: it
then goes on from its checkpoint. Every machine has this project at the same path and commit, and sees the
folder of the runs, as on the shared storage that clusters have; a machine of which that is not so refuses
its runs. Results are those of one machine: a run depends on its seed alone.
"""

from __future__ import annotations

import contextlib
import os
import sys
import traceback
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from comparison.pool import Start
from comparison.provenance import origin
from comparison.run import Run

RETRIES = 10  # times that a run is started again when its worker dies


@contextlib.contextmanager
def cluster(address: str | None = None, *, threads: int) -> Iterator[tuple[Start, int]]:
    """A connection to a cluster: what starts a run there, and how many find room at a time.

    Args:
        address: of the cluster; None for the one that `RAY_ADDRESS` names, or else for this machine alone.
        threads: of a run, each a core.

    Raises:
        ModuleNotFoundError: Ray is not installed.
        ConnectionError: no cluster at this address.
        ValueError: no machine of it has enough cores for a run.
    """
    try:
        import ray
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            "expected Ray for --ray, found none; pip install 'torchrl_sym[ray]' on every machine"
        ) from error
    quiet = {"logging_level": "error", "log_to_driver": False, "include_dashboard": False}
    ray.init(address, runtime_env={"env_vars": {"PYTHONPATH": os.pathsep.join(sys.path)}}, **quiet)
    try:
        room = sum(int(n["Resources"].get("CPU", 0)) // threads for n in ray.nodes() if n["Alive"])
        if room < 1:
            raise ValueError(
                f"expected machines of at least {threads} cores, got {ray.cluster_resources()}"
            )
        work = ray.remote(num_cpus=threads, max_retries=RETRIES)(_work)

        def start(run: Run, code: dict[str, Any]) -> _Remote:
            run.folder.mkdir(parents=True, exist_ok=True)
            return _Remote(ray, run, work.remote(run, code))

        yield start, room
    finally:
        ray.shutdown()


@dataclass
class _Remote:
    """A run somewhere on the cluster, as the pool asks for it."""

    ray: Any
    run: Run
    reference: Any

    def is_alive(self) -> bool:
        return not self.ray.wait([self.reference], timeout=0)[0]

    @property
    def exitcode(self) -> int | None:
        if self.is_alive():
            return None
        try:
            return self.ray.get(self.reference)
        except self.ray.exceptions.RayError as error:  # a machine refused, or workers died too often
            with (self.run.folder / "log.txt").open("a") as log:
                log.write(f"{error}\n")
            return 1

    def terminate(self) -> None:
        self.ray.cancel(self.reference, force=True)

    def join(self) -> None:
        self.ray.wait([self.reference], timeout=10)


def _work(run: Run, code: dict[str, Any]) -> int:
    """The life of a run on some machine; returns what a process would exit with.

    Raises:
        FileNotFoundError: this machine does not see the folder of the run.
        RuntimeError: it has another commit.
    """
    here = origin()
    if not run.folder.exists():
        raise FileNotFoundError(
            f"expected {here['machine']} to see the folder of {run}, found none; let --folder be on "
            "storage that all machines share"
        )
    if here["revision"] != code["revision"]:
        raise RuntimeError(
            f"expected commit {code['revision']} on {here['machine']}, as where the command was given, got "
            f"{here['revision']}; check it out there"
        )
    with (
        (run.folder / "log.txt").open("a") as log,
        contextlib.redirect_stdout(log),
        contextlib.redirect_stderr(log),
    ):
        print(f"process {os.getpid()} of {here['machine']}", flush=True)
        try:
            run.execute(here)
        except Exception:
            traceback.print_exc()
            return 1
    return 0
