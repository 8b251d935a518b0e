"""What is stored: files that a kill leaves whole, damage that is named, tables that have lost nothing."""

import contextlib
import dataclasses
import json
import os
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import compare
import results_page
import seal
from comparison import corrections, files, pool, provenance, writing
from comparison.files import Damaged, read_json, write_json, write_whole
from comparison.records import EarlierResults, read_about, rows_of
from comparison.run import Run
from comparison.study import read
from comparison.writing import write
from tasks.settings import SETTINGS

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"
STORED = ["tuning", results_page.STUDY, *results_page.ROBOTS]


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """Two short runs in their folders."""
    folder = tmp_path_factory.mktemp("runs")
    setting = SETTINGS["cartpole"].replace(iterations=2, num_envs=8, horizon=4, minibatches=1)
    runs = [Run("cartpole", "ppo", s, setting.replace(seed=s), folder / f"seed_{s}", 2) for s in (0, 1)]
    for run in runs:
        run.execute()
    return runs


@pytest.fixture
def runs(trained, tmp_path):
    """Copies of them, to be damaged."""
    copies = [dataclasses.replace(run, folder=tmp_path / run.folder.name) for run in trained]
    for run, own in zip(trained, copies, strict=True):
        shutil.copytree(run.folder, own.folder)
    return copies


def without(key, content):
    return json.dumps({name: value for name, value in json.loads(content).items() if name != key})


DAMAGE = {
    "truncated": lambda text: text[: len(text) // 2],
    "empty": lambda text: "",
    "not text": lambda text: b"\xff\xfe\x00",
    "another type": lambda text: "[1, 2]",
    "a number": lambda text: "3",
    "a key missing": lambda text: without("origins", text),
    "a wrong origin": lambda text: re.sub(r'"revision": ".*?"', '"revision": 3', text, count=1),
}


def damage(path, how):
    content = DAMAGE[how](path.read_text())
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path.read_bytes()


@pytest.mark.parametrize("how", DAMAGE)
def test_a_damaged_result_is_named_kept_and_stops_no_other(runs, tmp_path, how, capsys):
    first, second = runs
    path = first.folder / "result.json"
    found = damage(path, how)
    failed = pool.execute_all(runs, workers=1)
    assert failed == [first] and path.read_bytes() == found
    pool.report(failed)
    assert re.search(
        f"FAILED: cartpole ppo 0 .*{re.escape(str(path))}.*; delete it, and", capsys.readouterr().out
    )
    with pytest.raises(Damaged, match=re.escape(str(path))):
        first.execute()
    write(tmp_path / "results", runs, failed, {})
    assert read(tmp_path / "results")["cartpole"]["ppo"].seeds == [1]
    # What is known of it from before stays.
    write(tmp_path / "results", [second], [], {})
    before = (tmp_path / "results/runs.csv").read_text()
    damage(second.folder / "result.json", how)
    write(tmp_path / "results", [second], [second], {}, earlier=EarlierResults(tmp_path / "results"))
    assert (tmp_path / "results/runs.csv").read_text() == before
    # The remedy.
    path.unlink()
    first.execute()
    assert first.result() is not None and first.damage() is None


@pytest.mark.parametrize("how", DAMAGE)
def test_a_damaged_request_is_named_and_nothing_is_trained(runs, how):
    run = runs[0]
    (run.folder / "result.json").unlink()
    damage(run.folder / "request.json", how)
    before = (run.folder / "stage_0" / "metrics.csv").read_bytes()
    assert pool.execute_all([run], workers=1) == [run]
    assert re.search("request.json.*; restore it, or delete", run.damage())
    assert (run.folder / "stage_0" / "metrics.csv").read_bytes() == before


@pytest.mark.parametrize("cut", [1, 2])
def test_metrics_that_have_lost_a_row_are_named(runs, tmp_path, cut):
    table = runs[0].folder / "stage_0" / "metrics.csv"
    lines = table.read_text().splitlines(keepends=True)
    table.write_text("".join(lines[:-cut]))
    assert runs[0].result() is not None
    assert re.search(rf"expected metrics of 2 iterations in .*seed_0.*, got {2 - cut}", runs[0].damage())
    assert pool.execute_all(runs, workers=1) == [runs[0]]
    with pytest.raises(Damaged):
        write(tmp_path / "results", runs, [], {})


def test_progress_survives_metrics_that_are_damaged(runs):
    for content in (b"\xff\xfe\n\xff\n", b"iteration,return\n1,many\n", b"iteration\n1\n"):
        (runs[0].folder / "stage_0" / "metrics.csv").write_bytes(content)
        assert not np.isfinite(runs[0].progress()[1])


def test_collecting_names_what_is_damaged_and_goes_on(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("plot.draw_all", lambda *folders: [])
    arguments = compare.Arguments(
        methods=("ppo",), seeds=2, steps=200, episodes=2, config=("num_envs=8", "horizon=25", "epochs=1")
    )
    places = {key: tmp_path / key for key in ("folder", "output", "plots")}
    arguments = dataclasses.replace(arguments, **places)
    runs = compare.make_runs(arguments, tmp_path / "folder" / "custom")
    for run in runs:
        run.execute()
    collect = dataclasses.replace(arguments, collect=True)
    damage(runs[0].folder / "result.json", "truncated")
    assert compare.main(collect) == 1
    assert re.search(r"FAILED: cartpole ppo 0 .*seed_0.result\.json", capsys.readouterr().out)
    found = read(tmp_path / "output/custom")
    assert found["cartpole"]["ppo"].seeds == [1] and found.about["failed"] == ["cartpole ppo 0"]
    assert found.about["workers"] is None, "not known here"


@pytest.mark.parametrize("table", ["runs.csv", "curves.csv"])
@pytest.mark.parametrize(
    ("change", "got"),
    [
        (lambda lines: lines[:-1], "{less} rows"),
        (lambda lines: [*lines[:-1], lines[-1][:-4]], "{less} rows"),
        (lambda lines: lines[:1] + lines[2:], "{less} rows"),
        (lambda lines: [*lines, lines[-1]], "{more} rows"),
        (lambda lines: [line.rpartition(",")[0] + "\n" for line in lines], "{same} rows"),
        (lambda lines: [lines[0].replace("seed", "deed"), *lines[1:]], "{same} rows"),
        (lambda lines: [lines[0], lines[2], lines[1], *lines[3:]], "{same} rows"),
        (lambda lines: [], "-1 rows"),
        (None, "none"),
    ],
)
def test_a_table_that_is_not_as_it_was_written_is_refused(runs, tmp_path, table, change, got):
    folder = tmp_path / "results"
    write(folder, runs, [], {})
    path = folder / table
    lines = path.read_text().splitlines(keepends=True)
    count = len(lines) - 1
    path.unlink()
    if change:
        path.write_text("".join(change(lines)))
    expected = f"{re.escape(str(path))} with its {count} rows, as written, got " + got.format(
        less=count - 1, same=count, more=count + 1
    )
    for reader in (read, EarlierResults):
        with pytest.raises(Damaged, match=f"{expected}.*; restore it"):
            reader(folder)


@pytest.mark.parametrize(
    "how", [*(how for how in DAMAGE if how != "a wrong origin"), "no tables", "no such table"]
)
def test_a_damaged_description_is_named(runs, tmp_path, how):
    folder = tmp_path / "results"
    write(folder, runs, [], {})
    path = folder / "study.json"
    about = json.loads(path.read_text())
    changed = {
        "a key missing": lambda: write_json(path, {k: v for k, v in about.items() if k != "methods"}),
        "no tables": lambda: write_json(path, {k: v for k, v in about.items() if k != "tables"}),
        "no such table": lambda: write_json(path, about | {"tables": {}}),
    }
    changed.get(how, lambda: damage(path, how))()
    remedy = "run python benchmarks/seal.py results" if how == "no tables" else "restore it"
    for reader in (read, EarlierResults):
        with pytest.raises(Damaged, match=f"{re.escape(str(path))}.*; .*{remedy}"):
            reader(folder)
    write(folder, runs, [], {})  # written anew from the runs
    assert read(folder)["cartpole"]["ppo"].seeds == [0, 1]


def test_results_that_are_not_there_are_said_to_be_missing(tmp_path):
    with pytest.raises(
        FileNotFoundError, match=r"expected results in .*nothing \(study.json\), found none"
    ):
        read(tmp_path / "nothing")
    assert EarlierResults(tmp_path / "nothing").about == {}


class Killed(BaseException):
    """At any moment."""


@pytest.mark.parametrize("again", [1, 2, 4])
@pytest.mark.parametrize("steps", range(1, 11))
def test_results_that_are_killed_while_they_are_written_are_the_old_or_the_new_ones(
    runs, tmp_path, monkeypatch, steps, again
):
    folder, left = tmp_path / "results", 0

    def seeds():
        found = read(folder)["cartpole"]["ppo"]
        assert list(found.curves) == found.seeds
        return found.seeds

    def dying(function):
        def call(*arguments):
            nonlocal left
            left -= 1
            if left < 0:
                raise Killed
            return function(*arguments)

        return call

    monkeypatch.setattr(writing, "revision", lambda: "r")  # it asks git
    write(folder, runs[:1], [], {})
    with monkeypatch.context() as patch:
        for name in ("fsync", "replace"):
            patch.setattr(files.os, name, dying(getattr(os, name)))
        for count, written in ((steps, runs), (again, runs[1:])):
            left, before, after = count, seeds(), [run.seed for run in written]
            with contextlib.suppress(Killed):
                write(folder, written, [], {})
            assert seeds() in (before, after)
    write(folder, runs, [], {})
    assert seeds() == [0, 1] and not list(folder.glob("*.partial"))


def test_a_file_is_replaced_only_when_all_of_it_is_on_the_disk(tmp_path, monkeypatch):
    path, order = tmp_path / "file.json", []
    for name in ("fsync", "replace"):
        real = getattr(os, name)
        monkeypatch.setattr(
            files.os, name, lambda *a, real=real, name=name: (order.append(name), real(*a))[1]
        )
    write_json(path, {"a": float("inf")})
    assert order == ["fsync", "replace", "fsync"]
    assert read_json(path, {"a": str}, "") == {"a": "inf"}
    full = OSError(28, "No space left on device")

    def fail(*arguments):
        raise full

    monkeypatch.setattr(files.os, "fsync", fail)
    with pytest.raises(OSError, match="No space left"):
        write_whole(path, "half")
    assert read_json(path, {"a": str}, "") == {"a": "inf"}


@pytest.mark.parametrize("name", STORED)
def test_stored_tables_are_those_that_their_description_names(name):
    about = read_about(RESULTS / name)
    for table in ("runs.csv", "curves.csv"):
        assert len(rows_of(RESULTS / name, table, about)) == about["tables"][table]["rows"] > 0


def test_older_results_are_sealed_once(runs, tmp_path):
    folder = tmp_path / "results"
    write(folder, runs, [], {})
    about = json.loads((folder / "study.json").read_text())
    write_json(folder / "study.json", {key: value for key, value in about.items() if key != "tables"})
    seal.main(seal.Arguments(("results",), results=tmp_path))
    assert json.loads((folder / "study.json").read_text()) == about
    (folder / "curves.csv").write_text("task,method,seed\n")
    with pytest.raises(Damaged, match="got 0 rows"):
        seal.seal(folder)
    with pytest.raises(FileNotFoundError):
        seal.seal(tmp_path / "nothing")


def test_returns_of_falls_alone_are_left_out_by_rule():
    """The rows that 9e27d71 had blanked by hand, and those that runs before it had left empty."""
    blanked = 0
    for name in ("paper-push", "paper-climb"):
        about = read_about(RESULTS / name)
        rows = rows_of(RESULTS / name, "curves.csv", about)
        known = [r for r in rows if r["stage"] == "1" and r["return"] != "nan"]
        curves = read(RESULTS / name).curves
        known_now = curves[(curves["stage"] == 1) & np.isfinite(curves["return"])]
        shown = set(known_now[["method", "seed", "iteration"]].itertuples(index=False, name=None))
        gone = [r for r in known if (r["method"], int(r["seed"]), int(r["iteration"])) not in shown]
        blanked += len(gone)
        assert max(float(row["return"]) for row in gone) < 75
    assert blanked == 16
    curves = pd.DataFrame({"stage": [0, 1, 1], "iteration": [9, 9, 16], "return": 1.0})
    curves = curves.assign(task="t", method="m", seed=0)
    runs = curves[["task", "method", "seed"]].head(1)
    left_out = [
        corrections.corrected(curves, runs.assign(revision=r)) for r in ("9b1c0d2 4e5dd62", "9b1c0d2")
    ]
    assert [list(np.isnan(each["return"])) for each in left_out] == [[False, True, False], [False] * 3]


def test_the_command_is_recorded_as_it_was_given(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    given = [
        "compare.py",
        "--config",
        "hidden=(64, 64)",
        f"--output={tmp_path}/out",
        "--folder",
        f"{tmp_path}/in",
    ]
    monkeypatch.setattr(sys, "argv", [*given, "--collect"])
    expected = "python compare.py --config 'hidden=(64, 64)' --output=out --folder in --collect"
    assert provenance.command() == expected


@pytest.mark.parametrize("workers", [0, -2])
def test_less_than_one_worker_is_refused(workers):
    with pytest.raises(ValueError, match="expected at least one worker, got"):
        pool.execute_all([], workers)
