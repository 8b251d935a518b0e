"""Runs on a Ray cluster: those of one machine, whatever happens to a worker."""

import dataclasses
import os
import re
import signal
import sys
import threading
import time

import numpy as np
import pytest

from comparison import cluster as on_ray
from comparison import pool
from comparison.run import Run, read_curve
from tasks.settings import SETTINGS


@pytest.fixture(scope="module")
def cluster():
    """Two workers on this machine."""
    with on_ray.cluster("local", threads=1) as found:
        yield found


def make_run(folder, seed, **changes):
    setting = SETTINGS["cartpole"].replace(num_envs=8, horizon=8, seed=seed, **changes)
    return Run("cartpole", "ppo", seed, setting, folder / str(seed), episodes=2)


def curve(run):
    return [{k: v for k, v in row.items() if "second" not in k} for row in read_curve(run.folder)]


@pytest.mark.slow
def test_a_run_whose_worker_is_killed_ends_as_if_nothing_had_happened(cluster, tmp_path):
    start, room = cluster
    assert room >= 2
    short = {"iterations": 60, "epochs": 1, "minibatches": 1, "checkpoint_interval": 5}
    runs = [make_run(tmp_path / "ray", seed, **short) for seed in (0, 1)]

    def kill() -> None:
        log = runs[0].folder / "log.txt"
        while not log.exists() or runs[0].progress()[0] < 12:
            time.sleep(0.01)
        os.kill(int(re.findall(r"process (\d+)", log.read_text())[-1]), signal.SIGKILL)

    killer = threading.Thread(target=kill)
    killer.start()
    assert pool.execute_all(runs, room, start) == []
    killer.join()
    assert len(re.findall("process", (runs[0].folder / "log.txt").read_text())) == 2, "it was started again"
    here = [dataclasses.replace(run, folder=tmp_path / f"here_{run.seed}") for run in runs]
    for there, own in zip(runs, here, strict=True):
        own.execute()
        np.testing.assert_equal(curve(there), curve(own))
        assert there.result()["evaluation"] == own.result()["evaluation"]


@pytest.mark.slow
def test_a_machine_with_another_commit_refuses(cluster, tmp_path, monkeypatch):
    start, room = cluster
    run = make_run(tmp_path, 3, iterations=1)
    monkeypatch.setattr(pool, "origin", lambda: {"revision": "another"})
    assert pool.execute_all([run], room, start) == [run]
    assert "expected commit another on Linux" in (run.folder / "log.txt").read_text()


def test_a_machine_that_does_not_see_the_folder_refuses(tmp_path):
    with pytest.raises(FileNotFoundError, match="storage that all machines share"):
        on_ray._work(make_run(tmp_path, 3, iterations=1), on_ray.origin())


def test_without_ray_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ModuleNotFoundError, match=r"torchrl_sym\[ray\]"), on_ray.cluster(threads=1):
        pass
