"""The parts of benchmarks/compare.py: methods, statistics, tables, verdicts."""

import dataclasses
import math

import numpy as np
import pytest

from comparison import claims, methods, tables
from comparison.intervals import Estimate, band, difference, estimate, iqm
from comparison.run import Run, environment, task_setting
from comparison.study import Study, read, write
from tasks.settings import SETTINGS


def test_a_method_is_a_sum_of_parts():
    assert methods.parts("ppo") == ("ppo", 0.0, 1.0)
    assert methods.parts("loss-0.1") == ("ppo", 0.1, 1.0)
    assert methods.parts("aug+loss-0.1+init-4") == ("aug", 0.1, 4.0)
    assert methods.parts("aug-naive-raw") == ("aug-naive-raw", 0.0, 1.0)
    names = ["ppo", "loss-1", "aug", "aug-random", "aug+loss-1", "aug-naive", "aug-naive-raw"]
    families = ["ppo", "loss", "aug", "aug", "aug", "aug-naive", "aug-naive"]
    assert [methods.family(name) for name in names] == families
    assert len({methods.label(name) for name in names}) == len(names)


@pytest.mark.parametrize("name", ["augment", "loss-", "loss-x", "aug+", "init"])
def test_an_unknown_part_is_named(name):
    with pytest.raises(ValueError, match="expected a method made of"):
        methods.parts(name)


def test_methods_change_the_settings():
    config = methods.configure("cartpole", "aug-naive-raw", SETTINGS["cartpole"], seed=3).config
    assert (config.augmentation, config.max_log_ratio, config.max_std) == ("naive", math.inf, math.inf)
    assert config.seed == 3
    config = methods.configure("cartpole", "loss-10", SETTINGS["cartpole"], 0, num_envs=64).config
    assert (config.augmentation, config.mirror_coeff, config.num_envs) == ("none", 10.0, 64)
    scaled = methods.configure("cartpole", "aug+init-4", SETTINGS["cartpole"], 0).config
    assert (scaled.augmentation, scaled.weight_scale) == ("all", 4.0)


def test_all_members_of_a_family_share_what_was_tuned(monkeypatch):
    monkeypatch.setitem(methods.TUNED, "cartpole", {"aug": {"gamma": 0.5}})
    gamma = {
        name: methods.configure("cartpole", name, SETTINGS["cartpole"], 0).config.gamma
        for name in ("aug", "aug-random", "aug+loss-1", "ppo", "aug-naive")
    }
    default = SETTINGS["cartpole"].config.gamma
    expected = {"aug": 0.5, "aug-random": 0.5, "aug+loss-1": 0.5, "ppo": default, "aug-naive": default}
    assert gamma == expected


def test_steps_shorten_all_stages_alike():
    setting = SETTINGS["anymal_push"]
    half = methods.configure("anymal_push", "ppo", setting, 0, steps=setting.frames // 2)
    whole = [stage.config.iterations for stage in setting.stages]
    assert [stage.config.iterations for stage in half.stages] == [count // 2 for count in whole]
    assert half.frames == setting.frames // 2
    assert {stage.config.augmentation for stage in half.stages} == {"none"}


def test_interquartile_mean_by_hand():
    assert iqm(np.array([100.0, 1.0, 2.0, 3.0, 4.0, -50.0, 2.0, 3.0])) == pytest.approx(2.5)
    low, high = band(np.array([[1.0, 5.0], [1.0, 7.0]]))
    assert (low[0], high[0]) == (1.0, 1.0)
    assert (low[1], high[1]) == (5.0, 7.0)
    assert estimate(np.array([3.0])) == Estimate(3.0, 3.0, 3.0)


def test_intervals_are_those_of_repeated_experiments():
    # Of experiments with ten seeds each, the interval of a difference of zero contains zero in most.
    generator = np.random.default_rng(0)
    hits = 0
    for _ in range(40):
        gap = difference(generator.normal(size=10), generator.normal(size=10))
        hits += gap.low <= 0 <= gap.high
    assert hits >= 34
    shifted = difference(generator.normal(size=10) + 4, generator.normal(size=10))
    assert 0 < shifted.low < shifted.value < shifted.high
    assert difference(np.array([1.0]), np.array([0.0, 1.0])).low == -math.inf


def make_study(returns, curves, task="cartpole", seconds=1.0):
    """A study from evaluated returns (seeds, goals) and training returns (seeds, points) by method."""
    goals = ["right", "left"]
    rows = [
        {"task": task, "method": m, "seed": s, "outcome": "finished", "what": "task"}
        | {"actions": "deterministic", "goal": goal, "return": value}
        for m, values in returns.items()
        for s, row in enumerate(values)
        for goal, value in zip(goals, row, strict=True)
    ]
    columns = {}
    for m, values in curves.items():
        for s, row in enumerate(np.asarray(values, dtype=float)):
            steps = np.arange(1, len(row) + 1) * 1e5
            columns[task, m, s] = {
                "frames": steps,
                "seconds": steps * 1e-5 * seconds,
                "return": row,
                "mirror_loss": np.full(len(row), 0.1 if m == "aug" else 1.0),
                "log_prob": np.full(len(row), -1.0),
                "log_prob_copies": np.full(len(row), -100.0 if "naive" in m else -1.0),
            }
    return Study({"methods": {task: dict.fromkeys(returns, None)}}, rows, columns)


def test_efficiency_by_hand():
    rising = [-10.0, -8.0, -6.0, -4.0, -2.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    study = make_study({"ppo": [[0, 0]] * 2}, {"ppo": [rising, [-10.0] * 10]}, seconds=2.0)
    assert tables.threshold(study, "cartpole") == pytest.approx(0.1 * -10 + 0.9 * -5)
    reached = tables.steps_to(study, "cartpole", "ppo", -1.0)  # the mean of five points reaches -0.4 at 9
    assert reached.tolist() == [0.9, math.inf]
    assert tables.seconds_per_step(study, "cartpole", "ppo") == pytest.approx(2e-5)
    assert "| PPO | 1 of 2 | - | - | 50,000 |" in tables.efficiency_table(study, "cartpole")


def test_table_1_by_hand():
    study = make_study({"ppo": [[-1.0, -3.0], [-2.0, -2.5]]}, {"ppo": [[-1.0] * 3] * 2})
    assert tables.variation(study.goal_returns("cartpole", "ppo")[1]).tolist() == [2.0, 0.5]
    row = tables.table_1(study, "cartpole").splitlines()[2]
    assert row == "| PPO | 2 | -2.125 (-2.250 to -2.000) | 1.250 (0.500 to 2.000) | 2.000 | 1 |"


def test_verdicts_follow_the_interval():
    assert claims.verdict(Estimate(1.0, 0.1, 2.0)) == "confirmed"
    assert claims.verdict(Estimate(1.0, -0.1, 2.0)) == "not confirmed"
    assert claims.verdict(Estimate(-1.0, -2.0, -0.1)) == "different"
    assert claims.no_better(Estimate(1.0, 0.1, 2.0)) == "different"
    assert claims.no_better(Estimate(1.0, -0.1, 2.0)) == "confirmed"


def test_verdicts_turn_with_the_data():
    noise = np.random.default_rng(0).normal(size=(10, 2)) * 0.01
    good, bad = noise - [1.4, 1.4], noise - [1.4, 3.4]
    quick = np.array([[-8.0] * 3 + [-1.4] * 20] * 10)
    slow = np.array([[-8.0] * 18 + [-1.4] * 5] * 10)
    others = {"loss-0.1": bad, "loss-1": bad, "loss-10": bad}
    late = {name: slow for name in others}
    for returns, curves, expected in (
        ({"ppo": bad, "aug": good}, {"ppo": slow, "aug": quick}, "confirmed"),
        ({"ppo": good, "aug": bad}, {"ppo": quick, "aug": slow}, "different"),
    ):
        study = make_study(returns | others, curves | late)
        outcomes = [each.judge(study)[1] for each in claims.CLAIMS[:4]]
        assert outcomes[1] == outcomes[3] == expected
        assert outcomes[0].startswith(expected)
        assert outcomes[2] == ("confirmed" if expected == "confirmed" else "not confirmed")


def test_results_survive_writing_and_reading(tmp_path):
    setting = SETTINGS["cartpole"].replace(iterations=2, num_envs=8, horizon=4)
    run = Run("cartpole", "ppo", 5, setting, tmp_path / "run", episodes=2)
    assert run.result() is None
    run.execute()
    assert run.progress()[0] == run.iterations == 2
    lost = dataclasses.replace(run, seed=6, folder=tmp_path / "lost")
    write(tmp_path / "results", [run, lost], [lost], {"workers": 1})
    study = read(tmp_path / "results")
    assert study.tasks == ["cartpole"]
    assert study.methods("cartpole") == ["ppo"]
    assert study.seeds("cartpole", "ppo") == [5]
    assert study.about["failed"] == ["cartpole ppo 6"]
    goals, values = study.goal_returns("cartpole", "ppo")
    stored = [r["return"] for r in run.result()["evaluation"] if r["actions"] == "deterministic"]
    assert goals == ["right", "left"]
    np.testing.assert_allclose(values[0], stored, rtol=1e-5)
    steps, losses = study.curve("cartpole", "ppo", "mirror_loss")
    assert steps.tolist() == [32e-6, 64e-6]
    np.testing.assert_allclose(losses[0], [row["mirror_loss"] for row in run.curve()], rtol=1e-5)
    # Asked for something else, it counts as not done.
    assert dataclasses.replace(run, episodes=3).result() is None
    assert dataclasses.replace(run, setting=setting.replace(iterations=3)).result() is None


def test_an_unknown_task_says_what_is_expected():
    for task in ("cartpool", "no_such_module:make", "math:no_such_function"):
        with pytest.raises(ValueError, match="expected a task of"):
            environment(task)
    assert task_setting("cartpole") is SETTINGS["cartpole"]
