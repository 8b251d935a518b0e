"""Comparisons of robots: success tables, throughput, progress in a curriculum, claims, figures."""

import math

import numpy as np
import pandas as pd
import pytest

import plot
import results_page
from comparison import claims, tables
from comparison.study import Study, chance_variation
from tests.test_comparison import PAPER_IS_RIGHT, changed, world

GOALS = ("front", "back")


def make_robot_study(figures, losses, starts, seeds=5):
    """A study of a robot task.

    Args:
        figures: by method, success of both goals; returns are ten times, turning follows the spread.
        losses: by method, symmetry loss.
        starts: by method, the point at which training gets there.
        seeds: of each method.
    """
    noise = np.random.default_rng(0)
    rows, curves = [], []
    for method, success in figures.items():
        for seed in range(seeds):
            for goal, share in zip(GOALS, success, strict=True):
                share = share + noise.normal() * 0.001
                turning = 3 * abs(success[0] - success[1]) + noise.normal() * 0.001
                row = {"task": "robot", "method": method, "seed": seed, "outcome": "finished"}
                row |= {"what": "task", "goal": goal, "return": 12 * share, "task_return": 10 * share}
                for actions in ("sampled", "deterministic"):
                    scale = 0.5 if actions == "sampled" else 1.0
                    row_ = row | {"actions": actions, "success": scale * share, "turning": turning}
                    rows.append(row_)
            level = np.full(30, 1.0) + noise.normal(size=30) * 0.01
            level[starts[method] :] += 10 * np.mean(success)
            steps = np.arange(1, 31)
            curve = {
                "frames": steps * 1e5,
                "iteration": steps * 2.0,
                "seconds": steps * 20.0,
                "collect_seconds": 6.0,
                "physics_seconds": 5.0,
                "return": level,
                "success": level / 12,
                "level": level,
                "phase": np.minimum(steps - 1.0, 2.0),
                "mirror_loss": losses[method],
            }
            curves.append(pd.DataFrame(curve).assign(task="robot", method=method, seed=seed, stage=0.0))
    about = {"command": "c", "revisions": ["r"], "machine": "m", "workers": 2, "episodes": [500]}
    about["methods"] = {"robot": dict.fromkeys(figures)}
    return Study(about, pd.DataFrame(rows), pd.concat(curves))


def robot_world(right):
    """Where the paper's claims hold, and where they do not."""
    good, bad = (0.9, 0.9), (0.9, 0.2)
    names = ("ppo", "loss-1", "aug", "aug-random", "aug+loss-1")
    success = [bad, bad, good, good, good] if right else [good, good, bad, (0.2, 0.1), good]
    early, late = (3, 15) if right else (15, 3)
    starts = [late, late, early, early, early]
    losses = [10.0, 1.0, 0.01, 0.01, 0.01] if right else [0.01, 0.1, 10.0, 10.0, 10.0]
    return make_robot_study(*(dict(zip(names, each, strict=True)) for each in (success, losses, starts)))


@pytest.mark.parametrize("right", [True, False])
def test_verdicts_on_robots_turn_with_the_data(right):
    lines = claims.table(robot_world(right)["robot"]).splitlines()[2:]
    assert len(lines) == 8
    for line in lines:
        assert line.endswith("**confirmed** |" if right else "**different** |"), line


def test_claims_about_robots_need_their_methods_and_figures():
    study = robot_world(True)
    about = study.about | {"methods": {"robot": {"ppo": None, "aug": None}}}
    few = Study(about, study.runs, study.curves)
    assert len(claims.table(few["robot"]).splitlines()) == 2 + 6
    few = Study(about, study.runs.drop(columns="turning"), study.curves.drop(columns="phase"))
    assert len(claims.table(few["robot"]).splitlines()) == 2 + 4
    assert claims.table(
        Study(about | {"methods": {"robot": {"ppo": None}}}, few.runs, few.curves)["robot"]
    ) == ("| claim | place | evidence here | verdict |\n| --- | --- | --- | --- |\n")


def test_weights_are_compared_as_they_were_chosen():
    figures = dict.fromkeys(("ppo", "aug", "loss-10", "loss-1"), (0.5, 0.6)) | {"loss-1": (0.7, 0.7)}
    starts, losses = dict.fromkeys(figures, 5), dict.fromkeys(figures, 1.0)
    study = make_robot_study(figures, losses, starts)
    table = claims.table(study["robot"])
    assert "best weight: PPO + aug. " in table and ", PPO + loss-1 " in table, "all had all seeds"
    assert "most symmetric weight: PPO + loss-1 " in table and "weight of the mirror loss lowers" in table
    once = study.runs[(study.runs["method"] != "loss-10") | (study.runs["seed"] == 0)]
    table = claims.table(Study(study.about, once, study.curves)["robot"])
    assert "weight: " not in table and "return: PPO + aug. " in table, "one seed chose"
    assert "not compared, of one seed: PPO + loss-10" in table and "mirror loss lowers" not in table


def test_success_table_by_hand():
    study = make_robot_study({"ppo": (0.5, 0.75)}, {"ppo": 2.0}, {"ppo": 5}, seeds=1)
    row = tables.success_table(study["robot"]).splitlines()[2]
    assert "(" not in row, "a single seed has no interval"
    cells = row.strip("| ").split(" | ")
    assert cells[:2] == ["PPO", "1"] and cells[10] == "2"
    numbers = [float(cell) for cell in [*cells[2:10], cells[11]]]
    # By chance, two goals of 500 episodes differ by 2 / sqrt(pi) of a standard deviation.
    by_hand = [62.5, 50, 25, 100 * 1.128 * (0.625 * 0.375 / 500) ** 0.5, 6.25, 2.5, 7.5, 3.0, 0.75]
    np.testing.assert_allclose(numbers, by_hand, rtol=0.03)
    assert tables.success_row(study["robot"]["ppo"])["spread [%]"] == cells[4]
    text = tables.success_tables(study["robot"])
    assert text.count("| PPO |") == 2 and "Mean actions:" in text


def test_throughput_table_splits_the_time():
    study = make_robot_study({"ppo": (0.5, 0.5)}, {"ppo": 1.0}, {"ppo": 5}, seeds=1)
    assert "| PPO | 5,000 | 50% | 10% | 40% |" in tables.throughput_table(study["robot"])


def one_seed(change=lambda curve: curve, stages=None):
    """What a method with one seed did, its curve and the settings of its stages changed."""
    study = make_robot_study({"ppo": (0.5, 0.5)}, {"ppo": 1.0}, {"ppo": 5}, seeds=1)
    about = study.about | {"methods": {"robot": {"ppo": stages}}}
    return Study(about, study.runs, change(study.curves))["robot"]["ppo"]


def test_progress_in_a_curriculum_is_the_level_that_is_mastered_in_the_last_phase():
    results = one_seed()
    curve = results.curves[0]
    mastered = curve["level"] * curve["success"]
    values = results.curve("progress")[0].to_numpy()
    assert (values[:2] == 0).all(), "phases A and B"
    np.testing.assert_allclose(values[2:], mastered[2:])
    without = one_seed(lambda curve: curve.drop(columns="phase"))
    np.testing.assert_allclose(without.curve("progress")[0], mastered)
    without = one_seed(lambda curve: curve.drop(columns=["phase", "level"]))
    assert without.curve("progress")[0].tolist() == curve["return"].tolist()
    assert without.curve("level").empty and without.task.measured == "training return"


def test_progress_is_that_in_the_last_task_which_has_a_curriculum():
    turned = {"yaw": 3.0}
    stages = [{"task": task} for task in ({}, turned, turned, turned | {"curriculum": False})]
    numbers = np.repeat([0.0, 1.0, 2.0, 3.0], [10, 5, 5, 10])
    results = one_seed(lambda curve: curve.drop(columns="phase").assign(stage=numbers), stages)
    curve, values = results.curves[0], results.curve("progress")[0]
    np.testing.assert_allclose(values.index, curve["frames"][:20] / 1e6)
    assert (values[:10] == 0).all(), "another task"
    np.testing.assert_allclose(values[10:], (curve["level"] * curve["success"])[10:20])


def test_recovery_is_counted_from_the_start_of_the_last_phase():
    falls_and_rises = np.concatenate([np.full(10, 9.0), np.full(8, 1.0), np.full(12, 7.0)])
    phases = np.repeat([0.0, 1.0, 2.0], [5, 5, 20])
    recovered = {"return": falls_and_rises, "phase": phases}
    # The mean of five points is at 7 from the 13th point of the phase on: 1.2 million steps later.
    assert one_seed(lambda curve: curve.assign(**recovered)).recoveries.tolist() == pytest.approx([1.2])
    assert np.isnan(one_seed(lambda curve: curve.assign(phase=0.0)).recoveries).all()
    # What comes after the curriculum does not count, nor does a return that is not known.
    recovered["stage"] = np.repeat([0.0, 1.0], [25, 5])
    recovered["return"] = np.append(falls_and_rises[:25], [math.nan, 20.0, 20.0, 20.0, 20.0])
    stages = [{"task": {}}, {"task": {"curriculum": False}}]
    later = one_seed(lambda curve: curve.assign(**recovered), stages)
    assert later.recoveries.tolist() == pytest.approx([1.2])


def test_seeds_that_enter_the_last_phase_are_counted():
    study = robot_world(True)
    for count, text in ((4, "PPO 1 of 5, PPO + aug. 5 of 5 seeds enter it"), (5, "phase C: PPO 0 of 5")):
        early = (study.curves["method"] == "ppo") & (study.curves["seed"] < count)
        curves = study.curves.assign(phase=study.curves["phase"].mask(early, 0.0))
        assert text in claims.table(Study(study.about, study.runs, curves)["robot"])


def test_chance_alone_makes_goals_differ():
    rates = np.array([[0.8, 0.8, 0.8], [1.0, 1.0, 1.0]])
    drawn = np.random.default_rng(1).binomial(500, 0.8, size=(4000, 3)) / 500
    by_chance = chance_variation(rates, 500)
    assert by_chance[0] == pytest.approx(np.ptp(drawn, axis=1).mean(), rel=0.03)
    assert by_chance[1] == 0.0


def test_spread_of_success_is_confirmed_beyond_chance_alone():
    losses, starts = {"ppo": 1.0, "aug": 0.001}, {"ppo": 20, "aug": 5}
    study = make_robot_study({"ppo": (0.8, 0.81), "aug": (0.9, 0.9)}, losses, starts)
    row = next(line for line in claims.table(study["robot"]).splitlines() if "variation between" in line)
    assert "success: not confirmed" in row, "not different: what was taken off is an upper bound"
    study = make_robot_study({"ppo": (0.8, 0.9), "aug": (0.9, 0.9)}, losses, starts)
    row = next(line for line in claims.table(study["robot"]).splitlines() if "variation between" in line)
    assert row.endswith("**confirmed** |")


def test_claims_of_training_are_judged_once():
    study = robot_world(True)
    runs = pd.concat([study.runs, study.runs.assign(what="again")])
    task = Study(study.about, runs, study.curves)["robot"]
    first, again = (claims.table(task, what) for what in ("task", "again"))
    for claim in ("symmetry loss low", "converges fastest", "recovers"):
        assert claim in first and claim not in again
    assert "yields the highest return" in again


def test_robots_are_drawn_and_described_also_beside_other_tasks(tmp_path, monkeypatch):
    study, cartpole = robot_world(True), world(PAPER_IS_RIGHT, seeds=2)
    assert plot.success(cartpole) is None and plot.phases(cartpole) is None
    about = study.about | {"methods": cartpole.about["methods"] | study.about["methods"], "episodes": [500]}
    study = changed(study, "loss-1", 0, lambda curve: curve.head(0))  # its rows stay: it diverged at once
    both = Study(about, pd.concat([cartpole.runs, study.runs]), pd.concat([cartpole.curves, study.curves]))
    assert plot.phases(both).axes[0].get_title() == "robot: PPO"
    figures = plot.success(both), plot.goals(both), plot.efficiency(both)
    for figure in figures:
        figure.savefig(tmp_path / "figure.png")
    shown = [text.get_text() for text in figures[1].axes[1].get_xticklabels()]
    assert shown == [results.label for results in study["robot"].values()]
    shown = {text.get_text() for text in figures[2].axes[1].get_legend().get_texts()}
    assert shown == {results.label for results in study["robot"].values()}
    text = tables.tables(both)
    assert text.count("Mean actions:") == 1 and "nan" not in text
    monkeypatch.setitem(results_page.ROBOTS, "paper-robot", ("robot", "A robot"))
    page = results_page.robot_section("paper-robot", both)
    assert page.count("**confirmed**") == 8
    block = results_page.readme_robot_block({"paper-robot": both})
    assert block.count("| A robot, 3.0 M steps | PPO | 5 | ") == block.count("|  | PPO + aug. | 5 | ") == 1


def test_a_method_without_any_evaluated_seed_is_named():
    study = robot_world(True)
    lost = Study(study.about, study.runs[study.runs["method"] != "ppo"], study.curves)["robot"]
    table = claims.table(lost)
    assert table.count("no seed of PPO was evaluated") == 7
    assert "| PPO | 0 | - |" in tables.success_table(lost)
