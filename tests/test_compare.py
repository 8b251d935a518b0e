"""benchmarks/compare.py from the outside: it draws everything, survives kills, and reports what failed."""

import collections
import contextlib
import csv
import dataclasses
import io
import json
import math
import shutil
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import tyro

import compare as compare_script
import tasks
import tune
from comparison import study
from comparison.files import write_json
from comparison.methods import Method
from comparison.reruns import marks
from comparison.run import Run
from tasks.settings import SETTINGS
from tests.launch import Script, serve
from torchrl_sym.recipes import RunFolder

ROOT = Path(__file__).parents[1]
RESULTS = ROOT / "benchmarks" / "results"
FIGURES = {"training", "log_prob", "initialization", "goals", "efficiency", "success", "phases"}
TINY = ["--config", "num_envs=8", "horizon=25", "epochs=1", "minibatches=1", "checkpoint_interval=2"]
TIMING = ("seconds", "collect_seconds", "physics_seconds")

# Tasks of a user: one whose processes die or fail for some seeds, one that is no BatchedEnv, one without
# numbers to learn from.
USER_TASKS = """
import os
import tasks
from tasks.settings import Setting
from torchrl.envs import RewardScaling, TransformedEnv
from torchrl_sym.recipes import PPOConfig

SETTING = Setting(PPOConfig(num_envs=4, horizon=8, epochs=1, minibatches=1, iterations=2))

def make(num_envs, seed):
    if num_envs > 1 and seed == 1:
        os._exit(3)
    if num_envs > 1 and seed == 2:
        raise RuntimeError("no such seed")
    return tasks.make_env("cartpole", num_envs=num_envs, num_threads=1, seed=seed, episode_seconds=0.2)

def transformed(num_envs, seed):
    return TransformedEnv(make(num_envs, 0), RewardScaling(0.0, 2.0))

def lost(num_envs, seed):
    return TransformedEnv(make(num_envs, 0), RewardScaling(float("nan"), 1.0))
"""


def command(*arguments: str) -> list[str]:
    where = ["--folder", "runs", "--output", "results", "--plots", "plots"]
    if "--preset" not in arguments:
        where += ["--episodes", "2"]
    return [*where, *arguments]


def main(folder: Path, script, *arguments: str) -> int:
    """A script's main in this process, whose workers are forked from a server that is running already."""
    serve()
    sys.modules.pop("mine", None)  # another test's
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.setattr(sys, "path", [*sys.path])
        patch.setattr(sys, "argv", [script.__file__, *arguments])
        return script.main(tyro.cli(script.Arguments))


def compare(folder: Path, *arguments: str, expected: int = 0) -> str:
    output = io.StringIO()
    with contextlib.redirect_stdout(output), contextlib.redirect_stderr(output):
        assert main(folder, compare_script, *command(*arguments)) == expected
    return output.getvalue()


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return [{k: v for k, v in row.items() if k not in TIMING} for row in csv.DictReader(file)]


@pytest.mark.slow
def test_smoke_draws_every_figure_of_every_task(tmp_path, monkeypatch):
    for name, setting in SETTINGS.items():  # whole episodes of robots are most of its time
        short = {what: {**task, "episode_seconds": 0.5} for what, task in setting.evaluations.items()}
        monkeypatch.setitem(SETTINGS, name, dataclasses.replace(setting, evaluations=short))
    compare(tmp_path, "--preset", "smoke")
    drawn = {path.name: path.stat().st_size for path in (tmp_path / "plots" / "smoke").iterdir()}
    assert set(drawn) == {f"{name}.png" for name in FIGURES} | {"tables.md"}
    assert all(drawn[f"{name}.png"] > 10_000 for name in FIGURES)
    about = json.loads((tmp_path / "results" / "smoke" / "study.json").read_text())
    assert set(about["methods"]) == {"cartpole", "anymal_push", "anymal_climb", "trifinger_repose"}
    assert {"aug-naive", "aug-naive-raw", "aug+init-4", "loss-10"} <= set(about["methods"]["cartpole"])
    assert about["failed"] == []
    assert about["command"].endswith("--preset smoke")


def test_a_killed_comparison_goes_on_and_ends_alike(tmp_path):
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    what = ["--methods", "ppo", "aug+loss-1", "--seeds", "1", "--steps", str(8 * 25 * 12), *TINY]
    for folder in (whole, killed):
        folder.mkdir()
    compare(whole, *what)
    script = Script(ROOT / "benchmarks" / "compare.py", *command(*what), folder=killed)
    table = killed / "runs" / "custom" / "cartpole" / "ppo" / "seed_0" / "stage_0" / "metrics.csv"
    while not table.exists() or len(table.read_text().splitlines()) < 5:
        assert script.process.is_alive(), script.output()
        time.sleep(0.05)
    script.kill()
    assert not (killed / "results").exists()
    time.sleep(0.5)
    size = table.stat().st_size
    time.sleep(1.0)
    assert table.stat().st_size == size, "the workers outlived their comparison"
    compare(killed, *what)
    for name in ("runs.csv", "curves.csv"):
        assert rows(whole / "results/custom" / name) == rows(killed / "results/custom" / name)
    about = [json.loads((folder / "results/custom/study.json").read_text()) for folder in (whole, killed)]
    tables = [each.pop("tables") for each in about]  # their content has times
    assert about[0] == about[1]
    assert [each["curves.csv"]["rows"] for each in tables] == [24, 24]
    # What is finished can be looked at while the rest is not, without training anything.
    changes = {"seeds": 1, "steps": 8 * 25 * 12, "config": tuple(TINY[1:]), "episodes": 2, "collect": True}
    places = {"folder": whole / "runs", "output": tmp_path / "results", "plots": tmp_path / "plots"}
    asked = compare_script.Arguments(methods=("ppo", "loss-1"), **changes, **places)
    assert compare_script.main(asked) == 0
    part = study.read(tmp_path / "results" / "custom")
    assert list(part["cartpole"]) == ["ppo"] and part.about["unfinished"] == ["cartpole loss-1 0"]
    assert compare_script.main(dataclasses.replace(asked, methods=("loss-1",))) == 1


def test_results_are_extended_where_the_runs_are_gone(tmp_path):
    what = ["--methods", "ppo", "--steps", str(8 * 25 * 2), *TINY]

    compare(tmp_path, *what, "--seeds", "1")
    results = tmp_path / "results" / "custom"
    before = {path.name: path.read_text() for path in results.iterdir()}
    shutil.rmtree(tmp_path / "runs")
    shutil.rmtree(tmp_path / "plots")
    compare(tmp_path, *what, "--seeds", "1", "--collect")
    assert before == {path.name: path.read_text() for path in results.iterdir()}
    assert (tmp_path / "plots" / "custom" / "tables.md").exists()
    compare(tmp_path, *what, "--seeds", "2", "--extend")
    assert [path.name for path in (tmp_path / "runs").glob("custom/cartpole/ppo/*")] == ["seed_1"]
    for name in ("runs.csv", "curves.csv"):
        assert (results / name).read_text().startswith(before[name])
    found = study.read(results)
    assert found["cartpole"]["ppo"].seeds == [0, 1]
    assert {len(curve) for curve in found["cartpole"]["ppo"].curves.values()} == {2}
    assert len(found.about["revisions"]) == 1 and " / " not in found.about["machine"]
    assert found.about["command"].endswith("--seeds 2 --extend"), "what was given"
    # Neither mixed with runs of other settings, nor overwritten.
    after = {path.name: path.read_text() for path in results.iterdir()}
    for other in (["--config", "num_envs=4"], ["--episodes", "3"]):
        with pytest.raises(
            ValueError, match="results/custom to hold cartpole ppo 0 as it is asked for now"
        ):
            compare(tmp_path, *what, "--seeds", "3", *other, "--extend")
    assert after == {path.name: path.read_text() for path in results.iterdir()}


@pytest.mark.parametrize("preset", [name for name in compare_script.PRESETS if (RESULTS / name).exists()])
def test_stored_results_are_what_their_preset_trains(preset):
    stored = study.read(RESULTS / preset)
    runs = compare_script.make_runs(compare_script.Arguments(preset=preset), Path("none"))
    known = {(task, name): of for task, results in stored.items() for name, of in results.items()}
    there = [run for run in runs if (run.task, run.method) in known]
    there = [run for run in there if run.seed in known[run.task, run.method].seeds]
    missing = [str(run) for run in runs if run not in there]
    assert missing == stored.about["unfinished"]
    assert len(missing) < len(runs)
    # Rows that are trained by other rules today say so; the others with these very settings.
    for run in there:
        if marks(known[run.task, run.method]):
            continue
        for before, now in zip(
            stored.about["methods"][run.task][run.method], run.request()["stages"], strict=True
        ):
            same = {name for name, value in before["config"].items() if now["config"].get(name) == value}
            assert before["config"].keys() - same <= {"initial_std", "min_std", "max_std"}
            assert before["task"] == now["task"]


def test_what_fails_is_reported_and_stops_nothing(tmp_path):
    (tmp_path / "mine.py").write_text(USER_TASKS)
    output = compare(tmp_path, "--tasks", "mine:make", "--methods", "aug", "--seeds", "4", expected=1)
    assert "FAILED: mine:make aug 1" in output
    assert "FAILED: mine:make aug 2" in output
    assert "exit code 3" in output
    assert "RuntimeError: no such seed" in output
    about = json.loads((tmp_path / "results" / "custom" / "study.json").read_text())
    assert about["failed"] == ["mine:make aug 1", "mine:make aug 2"]
    assert {row["seed"] for row in rows(tmp_path / "results" / "custom" / "runs.csv")} == {"0", "3"}
    assert about["methods"]["mine:make"]["aug"][0]["config"]["num_envs"] == 4  # from its SETTING


def test_other_environments_and_runs_that_diverge(tmp_path):
    (tmp_path / "mine.py").write_text(USER_TASKS)
    compare(tmp_path, "--tasks", "mine:transformed", "mine:lost", "--methods", "ppo", "--seeds", "1")
    found = {row["task"]: row for row in rows(tmp_path / "results" / "custom" / "runs.csv")}
    assert found["mine:lost"]["outcome"] == "diverged"
    assert found["mine:lost"]["return"] == ""
    assert found["mine:transformed"]["goal"] == "all"
    assert -2 * 0.2 * np.pi <= float(found["mine:transformed"]["return"]) < 0
    assert (
        "| PPO | 1 (1 diverged, 1 at once) | - |"
        in (tmp_path / "plots" / "custom" / "tables.md").read_text()
    )


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (["--methods", "agu"], "expected a method made of"),
        (["--config", "num_envs"], "expected KEY=VALUE"),
        (["--config", "num_env=3"], "expected KEY=VALUE"),
        (["--config", "augmentation=none"], "expected KEY=VALUE"),
        (["--config", "num_envs=many"], "num_envs: expected a whole number of at least 1, got 'many'"),
        (["--config", "hidden=64"], "hidden: expected a sequence of sizes, got 64"),
        (["--workers", "0"], "expected --workers of at least 1"),
        (["--steps", "-5"], "expected --steps of at least 1"),
        (["--preset", "smoke", "--seeds", "3"], "expected a preset alone"),
        (["--preset", "smoke", "--tasks", "mine:make"], r"got --preset smoke and \['tasks'\]"),
        (["--collect", "--extend"], "expected --collect, which trains nothing, without .'--extend'."),
        (["--collect", "--workers", "2"], "expected --collect, .* without .'--workers'."),
        (["--collect", "--threads", "1"], "expected --collect, .* without .'--threads'."),
        (["--tasks", "cartpool"], "expected a task of"),
        (["--tasks", "cartpole", "cartpole"], "expected different --tasks"),
        (["--tasks"], "expected one or more values of --tasks"),
        (["--methods", "aug", "ppo", "aug"], "expected different --methods"),
        (["--methods", "aug+loss-1", "loss-1.0+aug"], "expected different --methods"),
        (["--config", "num_envs=4", "num_envs=8"], "expected different --config"),
        (["--name", "a/b"], "expected a --name without a path"),
    ],
)
def test_bad_input_is_refused_before_anything_starts(tmp_path, arguments, complaint):
    with pytest.raises((ValueError, TypeError), match=complaint):
        compare_script.make_runs(tyro.cli(compare_script.Arguments, args=arguments), tmp_path)


@pytest.mark.parametrize("name", [field.name for field in dataclasses.fields(compare_script.Experiment)])
def test_an_option_beside_a_preset_is_refused_also_with_the_value_it_has_anyway(tmp_path, name):
    value = getattr(compare_script.chosen(compare_script.Arguments())[0], name)
    given = compare_script.Arguments(preset="smoke", **{name: () if name == "config" else value or 1})
    with pytest.raises(ValueError, match=rf"got --preset smoke and \['{name}'\]"):
        compare_script.make_runs(given, tmp_path)


def test_presets():
    def runs(preset):
        return compare_script.make_runs(compare_script.Arguments(preset=preset), Path("runs"))

    ten, twenty = runs("paper-cartpole"), runs("paper-cartpole-20")
    folders = [{run.folder for run in each} for each in (ten, twenty, runs("paper"))]
    assert folders[0] < folders[1] < folders[2]
    assert all(run.setting.frames >= 3.3e6 and run.episodes == 500 for run in twenty)
    seeds = collections.Counter(run.method for run in twenty)
    assert min(seeds.values()) == 10
    assert seeds["ppo"] == seeds["aug"] == 20
    assert {run.task for run in runs("smoke")} == set(tasks.ALL_TASKS)
    for preset, robot_seeds, weights, tried_once in (
        ("paper-push", 5, 3, 2),
        ("paper-climb", 3, 3, 1),
        ("paper-repose", 3, 4, 3),
    ):
        robot = runs(preset)
        assert {run.folder for run in robot} < folders[2]
        seeds = collections.Counter(run.method for run in robot)
        assert sum(method.startswith("loss-") for method in seeds) == weights
        assert sorted(seeds.values()) == [1] * tried_once + (4 + weights - tried_once) * [robot_seeds]
        assert len({run.setting.frames for run in robot}) == 1, "equal steps for all methods"
    headings = runs("paper-repose-yaw")
    assert {run.folder for run in headings} < folders[2]
    assert collections.Counter(run.method for run in headings) == {"ppo": 3, "aug": 3}


def test_tuning_gives_every_family_the_same(tmp_path, monkeypatch):
    small = SETTINGS["cartpole"].replace(num_envs=8, horizon=8, epochs=1, minibatches=1)
    monkeypatch.setitem(SETTINGS, "cartpole", small)
    monkeypatch.setattr(tune, "MORE", tune.MORE[:1])
    tiny = ["--families", "ppo", "aug", "--candidates", "2", "--steps", "1", "--episodes", "1"]
    where = ["--folder", "runs", "--output", "results"]
    assert main(tmp_path, tune, *tiny, *where) == 0
    runs = {(row["method"], row["seed"]) for row in rows(tmp_path / "results" / "runs.csv")}
    for family in ("ppo", "aug"):
        assert len([m for m, _ in runs if m.startswith(f"{family}: ")]) == 2 * 2 + 2 * 1
    lines = (tmp_path / "results" / "README.md").read_text().splitlines()
    assert "| candidate | ppo | aug |" in lines
    assert "".join(lines).count("**") == 4  # one winner per family


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"workers": 0}, "expected --workers of at least 1"),
        ({"steps": 0}, "expected --steps of at least 1"),
        ({"episodes": -1}, "expected --episodes of at least 1"),
        ({"candidates": 0}, "expected --candidates of at least 1"),
        ({"candidates": 99}, "expected --candidates of at most 6"),
        ({"families": ()}, "expected one or more values of --families"),
        ({"families": ("ppo", "ppo")}, "expected different --families"),
        ({"families": ("pop",)}, "expected a method made of"),
    ],
)
def test_a_search_that_cannot_be_made_is_refused(tmp_path, changes, complaint):
    with pytest.raises(ValueError, match=complaint):
        tune.main(tune.Arguments(folder=tmp_path, output=tmp_path / "results", **changes))
    assert not list(tmp_path.iterdir())


def test_the_search_prefers_high_returns_and_complete_candidates(tmp_path):
    def run(candidate, seed, value):
        folder = tmp_path / candidate / str(seed)
        made = Run("cartpole", f"ppo: {candidate}", seed, SETTINGS["cartpole"], folder)
        folder.mkdir(parents=True)
        if value is not None:
            row = {"what": "task", "goal": "right", "actions": "deterministic", "return": value}
            rows = [row, row | {"actions": "sampled", "return": 9.0}]
            ended = {"outcome": "finished", "iterations": 1, "frames": 1, "seconds": 1.0, "origins": []}
            write_json(folder / "result.json", made.request() | ended | {"evaluation": rows})
        return made

    runs = [run("good", 0, -1.0), run("good", 1, -2.0), run("lucky", 0, -0.5), run("lucky", 1, None)]
    assert tune.score(runs, "ppo", "good") == -1.5
    assert tune.score(runs, "ppo", "lucky") == -math.inf


def test_the_methods_use_what_the_search_found():
    winners = {}
    for name, families in {"tuning": tune.FAMILIES, "tuning-networks": ("equivariant", "relaxed")}.items():
        stored = ROOT / "benchmarks" / "results" / name
        text = (stored / "README.md").read_text()
        assert text == tune.table(study.read(stored))
        rows = [line.split("|") for line in text.splitlines() if "**" in line]
        for column, family in enumerate(families, start=2):
            (winner,) = [row[1].strip() for row in rows if "**" in row[column]]
            winners[Method.parse(family).family] = tune.CANDIDATES[winner]
    assert SETTINGS["cartpole"].tuned == winners


def test_augmentation_is_twenty_times_as_symmetric_and_no_worse():
    found = study.read(ROOT / "benchmarks" / "results" / "paper-cartpole-20")
    plain, copies = (found["cartpole"][method] for method in ("ppo", "aug"))
    assert plain.variation().mean() > 20 * copies.variation().mean()
    assert copies.returns().mean() >= plain.returns().mean()


def test_a_second_comparison_in_the_same_folder_is_refused(tmp_path):
    refused = pytest.raises(BlockingIOError, match="expected a folder that nobody trains in")
    with RunFolder(tmp_path / "runs" / "custom"), refused:
        compare(tmp_path, "--methods", "ppo", *TINY, "--steps", "1")
    assert not (tmp_path / "results").exists()
