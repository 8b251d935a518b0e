"""The off-policy study: a symmetric task, seeds that do not mix, verdicts that follow from the table."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from tensordict import TensorDict

import off_policy
from ant.report import late, measured, page, read, verdict
from ant.training import Learner, Setting
from ant.world import ant_symmetry, evaluate, make_env, make_envs
from comparison.intervals import Estimate
from torchrl_sym.mujoco import verify

ROOT = Path(__file__).parents[1]
TINY = {"seeds": (0, 1), "frames": 160, "envs": 2, "updates": 1, "rows": 8, "cells": 8}
TINY |= {"random_frames": 80, "evaluations": 2, "episodes": 1}


@pytest.fixture(scope="module")
def symmetry():
    return ant_symmetry(make_env().unwrapped.model)


def batch(seeds, rows=8):
    def step():
        return {
            "observation": torch.randn(seeds, rows, 27),
            "done": torch.zeros(seeds, rows, 1, dtype=bool),
        }

    after = step() | {"reward": torch.randn(seeds, rows, 1)}
    after["terminated"] = after["done"]
    return TensorDict(
        step() | {"action": torch.rand(seeds, rows, 8), "next": after}, batch_size=[seeds, rows]
    )


def test_the_task_is_as_symmetric_as_declared(symmetry):
    report = verify(make_env(), symmetry)
    assert report.passed, report


@pytest.mark.parametrize("algorithm", ["sac", "td3"])
def test_a_seed_learns_as_if_it_were_alone(algorithm):
    batches = [batch(2) for _ in range(4)]
    others = [data.clone() for data in batches]
    for data in others:  # of the second seed only
        data["next", "reward"][1] += 1.0
        data["observation"][1] += 1.0
    learned, seen = [], torch.ones(2, 3, 27)
    for own in (batches, others):
        torch.manual_seed(0)
        learner = Learner(Setting(algorithm, "plain", **TINY), 27, 8)
        untrained = learner.act(seen)
        for data in own:
            learner.update(data)
        learned.append(learner.act(seen))
    assert (learned[0] != untrained).all()
    assert torch.equal(learned[0][0], learned[1][0])
    assert not torch.equal(learned[0][1], learned[1][1])


def test_measures_of_a_policy_whose_mirror_image_is_known(symmetry):
    gain = torch.randn(27, 8) * 0.3

    def act(seen):  # the first seed's policy is made equivariant, the second's is not
        action = (seen @ gain).tanh()
        mirrored = symmetry["action"]((symmetry["observation"](seen, 1) @ gain).tanh(), 1)
        return torch.stack([(action[0] + mirrored[0]) / 2, action[1]])

    result = evaluate(act, make_envs(4), symmetry, (0, 1))
    assert result["mirror_error"][0] < 1e-10 < 1e-3 < result["mirror_error"][1]
    assert set(result) == {"return", "x", "y", "mirror_error"}
    assert all(values.shape == (2,) for values in result.values())
    assert result["return"][0] < 20.0 * result["x"][0] + 5.0  # speed over 0.05 s steps, less effort


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """The study in miniature."""
    folder = tmp_path_factory.mktemp("runs")
    settings = [Setting(name, arm, **TINY) for name in ("sac", "td3") for arm in ("plain", "symmetric")]
    for setting in settings:
        off_policy.run(setting, folder / f"{setting.name}.csv")
    off_policy.collect(settings, folder, folder)
    return folder


def test_arms_start_alike_and_part(runs):
    curves = read(runs / "curves.csv")
    for algorithm in ("sac", "td3"):
        plain, symmetric = curves[algorithm, "plain"], curves[algorithm, "symmetric"]
        assert list(plain) == list(symmetric) == [0, 1]
        assert plain[0]["frames"].tolist() == [80, 160]
        assert plain[0]["updates"].tolist() == [0, 40]
        for seed in plain:
            assert plain[seed]["return"][0] == symmetric[seed]["return"][0]  # untrained
            assert plain[seed]["return"][1] != symmetric[seed]["return"][1]
        assert plain[0]["return"][0] != plain[1]["return"][0]


def test_a_finished_run_is_not_repeated_and_page_and_picture_follow(runs, tmp_path, monkeypatch):
    monkeypatch.setattr(off_policy, "ProcessPoolExecutor", Refusing)
    where = {"runs": runs, "results": tmp_path, "plots": tmp_path, "page": tmp_path / "page.md"}
    settings = [Setting(name, arm, **TINY) for name in ("sac", "td3") for arm in ("plain", "symmetric")]
    off_policy.main(off_policy.Arguments(**where), settings)
    assert (tmp_path / "curves.csv").read_text() == (runs / "curves.csv").read_text()
    assert (tmp_path / "curves.png").stat().st_size > 10_000
    text = " ".join((tmp_path / "page.md").read_text().split())
    assert text.count("| area under the curve of returns |") == 2
    assert "160 frames of a seed" in text and "40 gradient steps of 8 rows" in text


class Refusing:
    """A pool that nothing may be given to."""

    def __init__(self, *_, **__): ...
    def __enter__(self):
        return self

    def __exit__(self, *_): ...
    def submit(self, *_):
        raise AssertionError("expected no run")


def test_verdicts_are_those_of_the_rules():
    up, down, open_ = Estimate(1.0, 0.1, 2.0), Estimate(-1.0, -2.0, -0.1), Estimate(0.1, -1.0, 1.0)
    assert [verdict(e, "helps", "hurts") for e in (up, down, open_)] == ["helps", "hurts", "undecided"]
    assert late(np.arange(12.0)) == 10.0


def curve(returns, mirror_error=1.0):
    columns = {"return": returns, "mirror_error": np.full(4, mirror_error), "drift": np.zeros(4)}
    return {name: np.asarray(values, dtype=float) for name, values in columns.items()}


def test_differences_are_taken_in_pairs():
    level = {seed: 100.0 * seed for seed in range(5)}  # seeds differ by far more than arms
    plain = {seed: curve(level[seed] + np.arange(4)) for seed in level}
    symmetric = {seed: curve(level[seed] + np.arange(4) + 1.0 + 0.1 * seed, 0.5) for seed in level}
    curves = {("sac", "plain"): plain, ("sac", "symmetric"): symmetric}
    area, mirror, drift, last = measured(curves, "sac")
    assert area.format().endswith("| 1.2 (1.0 to 1.4) | helps |")
    assert mirror.format().endswith("| -0.50 (-0.50 to -0.50) | more symmetric |")
    assert (drift.verdict, last.verdict) == ("undecided", "")
    del symmetric[3]
    with pytest.raises(ValueError, match="expected both arms to have the same seeds"):
        measured(curves, "sac")


def test_the_page_says_what_the_stored_results_say():
    results = ROOT / "benchmarks" / "results" / "off-policy"
    text = page(read(results / "curves.csv"), json.loads((results / "study.json").read_text()))
    advice = "run python benchmarks/off_policy.py --collect"
    assert text == (ROOT / "docs" / "off_policy.md").read_text(), advice
