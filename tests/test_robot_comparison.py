"""Comparisons of robots: success tables, throughput, progress in a curriculum, claims, figures."""

import math

import numpy as np
import pytest

import plot
import results_page
from comparison import robot_claims, robot_tables, tables, verdicts
from comparison.methods import label
from comparison.study import Study
from tests.test_comparison import PAPER_IS_RIGHT, world

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
    rows, curves = [], {}
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
            curves["robot", method, seed] = {
                "frames": steps * 1e5,
                "iteration": steps * 2.0,
                "seconds": steps * 20.0,
                "collect_seconds": np.full(30, 6.0),
                "physics_seconds": np.full(30, 5.0),
                "return": level,
                "success": level / 12,
                "level": level,
                "phase": np.minimum(steps - 1.0, 2.0),
                "mirror_loss": np.full(30, losses[method]),
            }
    about = {"command": "c", "revisions": ["r"], "machine": "m", "workers": 2, "episodes": [500]}
    return Study(about | {"methods": {"robot": dict.fromkeys(figures)}}, rows, curves)


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
    lines = robot_claims.table(robot_world(right), "robot").splitlines()[2:]
    assert len(lines) == len(robot_claims.CLAIMS) == 8
    for line in lines:
        assert line.endswith("**confirmed** |" if right else "**different** |"), line


def test_claims_about_robots_need_their_methods():
    study = robot_world(True)
    study.about["methods"]["robot"] = {"ppo": None, "aug": None}
    assert len(robot_claims.table(study, "robot").splitlines()) == 2 + 6
    for curve in study.curves.values():
        del curve["phase"]
    assert len(robot_claims.table(study, "robot").splitlines()) == 2 + 5


def test_success_table_by_hand():
    study = make_robot_study({"ppo": (0.5, 0.75)}, {"ppo": 2.0}, {"ppo": 5}, seeds=1)
    row = robot_tables.success_table(study, "robot").splitlines()[2]
    assert "(" not in row, "a single seed has no interval"
    cells = row.strip("| ").split(" | ")
    assert cells[:2] == ["PPO", "1"] and cells[10] == "2"
    numbers = [float(cell) for cell in [*cells[2:10], cells[11]]]
    # By chance, two goals of 500 episodes differ by 2 / sqrt(pi) of a standard deviation.
    by_hand = [62.5, 50, 25, 100 * 1.128 * (0.625 * 0.375 / 500) ** 0.5, 6.25, 2.5, 7.5, 3.0, 0.75]
    np.testing.assert_allclose(numbers, by_hand, rtol=0.03)
    assert robot_tables.success_row(study, "robot", "ppo")["spread [%]"] == cells[4]
    text = robot_tables.success_tables(study, "robot")
    assert text.count("| PPO |") == 2 and "Mean actions:" in text


def test_throughput_table_splits_the_time():
    study = make_robot_study({"ppo": (0.5, 0.5)}, {"ppo": 1.0}, {"ppo": 5}, seeds=1)
    assert "| PPO | 5,000 | 50% | 10% | 40% |" in robot_tables.throughput_table(study, "robot")


def test_progress_in_a_curriculum_is_the_level_that_is_mastered_in_the_last_phase():
    study = make_robot_study({"ppo": (0.5, 0.5)}, {"ppo": 1.0}, {"ppo": 5}, seeds=1)
    curve = study.curves["robot", "ppo", 0]
    mastered = curve["level"] * curve["success"]
    values = study.curve("robot", "ppo", "progress")[1][0]
    assert (values[:2] == 0).all(), "phases A and B"
    np.testing.assert_allclose(values[2:], mastered[2:])
    del curve["phase"]
    np.testing.assert_allclose(study.curve("robot", "ppo", "progress")[1][0], mastered)
    del curve["level"]
    assert (study.curve("robot", "ppo", "progress")[1][0] == curve["return"]).all()
    assert np.isnan(study.curve("robot", "ppo", "level")[1]).all()
    assert tables.measured(study, "robot") == "training return"


def test_progress_is_that_in_the_last_task_which_has_a_curriculum():
    study = make_robot_study({"ppo": (0.5, 0.5)}, {"ppo": 1.0}, {"ppo": 5}, seeds=1)
    curve = study.curves["robot", "ppo", 0]
    del curve["phase"]
    curve["stage"] = np.repeat([0.0, 1.0, 2.0, 3.0], [10, 5, 5, 10])
    turned = {"yaw": 3.0}
    stages = [{"task": task} for task in ({}, turned, turned, turned | {"curriculum": False})]
    study.about["methods"]["robot"]["ppo"] = stages
    steps, values = study.curve("robot", "ppo", "progress")
    np.testing.assert_allclose(steps, curve["frames"][:20] / 1e6)
    assert (values[0, :10] == 0).all(), "another task"
    np.testing.assert_allclose(values[0, 10:], (curve["level"] * curve["success"])[10:20])


def test_recovery_is_counted_from_the_start_of_the_last_phase():
    study = make_robot_study({"ppo": (0.5, 0.5)}, {"ppo": 1.0}, {"ppo": 5}, seeds=2)
    falls_and_rises = np.concatenate([np.full(10, 9.0), np.full(8, 1.0), np.full(12, 7.0)])
    first, second = study.curves.values()
    first["return"] = falls_and_rises
    first["phase"] = np.repeat([0.0, 1.0, 2.0], [5, 5, 20])
    second["phase"] = np.zeros(30)
    # The mean of five points is at 7 from the 13th point of the phase on: 1.2 million steps later.
    taken = verdicts.recovery(study, "ppo", task="robot")
    assert taken[0] == pytest.approx(1.2) and math.isnan(taken[1])
    # What comes after the curriculum does not count, nor does a return that is not known.
    first["stage"] = second["stage"] = np.repeat([0.0, 1.0], [25, 5])
    first["return"][25:] = [math.nan, 20.0, 20.0, 20.0, 20.0]
    study.about["methods"]["robot"]["ppo"] = [{"task": {}}, {"task": {"curriculum": False}}]
    assert verdicts.recovery(study, "ppo", task="robot")[0] == pytest.approx(1.2)


def test_seeds_that_enter_the_last_phase_are_counted():
    study = robot_world(True)
    for (_, method, seed), curve in study.curves.items():
        if method == "ppo" and seed < 4:
            curve["phase"] = np.zeros(30)
    assert "PPO 1 of 5, PPO + aug. 5 of 5 seeds enter it" in robot_claims.table(study, "robot")
    study.curves["robot", "ppo", 4]["phase"] = np.zeros(30)
    assert "seeds that enter phase C: PPO 0 of 5" in robot_claims.table(study, "robot")


def test_chance_alone_makes_goals_differ():
    rates = np.array([[0.8, 0.8, 0.8], [1.0, 1.0, 1.0]])
    drawn = np.random.default_rng(1).binomial(500, 0.8, size=(4000, 3)) / 500
    by_chance = tables.chance_variation(rates, 500)
    assert by_chance[0] == pytest.approx(np.ptp(drawn, axis=1).mean(), rel=0.03)
    assert by_chance[1] == 0.0


def test_spread_of_success_is_confirmed_beyond_chance_alone():
    losses, starts = {"ppo": 1.0, "aug": 0.001}, {"ppo": 20, "aug": 5}
    study = make_robot_study({"ppo": (0.8, 0.81), "aug": (0.9, 0.9)}, losses, starts)
    row = next(
        line for line in robot_claims.table(study, "robot").splitlines() if "variation between" in line
    )
    assert "success: not confirmed" in row, "not different: what was taken off is an upper bound"
    study = make_robot_study({"ppo": (0.8, 0.9), "aug": (0.9, 0.9)}, losses, starts)
    row = next(
        line for line in robot_claims.table(study, "robot").splitlines() if "variation between" in line
    )
    assert row.endswith("**confirmed** |")


def test_claims_of_training_are_judged_once():
    study = robot_world(True)
    study.runs.extend([row | {"what": "again"} for row in study.runs])
    first, again = (robot_claims.table(study, "robot", what) for what in ("task", "again"))
    for claim in ("symmetry loss low", "converges fastest", "recovers"):
        assert claim in first and claim not in again
    assert "yields the highest return" in again


def test_robots_are_drawn_and_described_also_beside_other_tasks(tmp_path, monkeypatch):
    study, cartpole = robot_world(True), world(PAPER_IS_RIGHT, seeds=2)
    for column in ("phase", "level", "success", "physics_seconds"):  # one table of curves for all tasks
        for curve in cartpole.curves.values():
            curve[column] = np.full(30, math.nan)
    assert plot.success(cartpole) is None and plot.phases(cartpole) is None
    about = study.about | {"methods": cartpole.about["methods"] | study.about["methods"], "episodes": [500]}
    del study.curves["robot", "loss-1", 0]  # its rows stay: it diverged at once
    both = Study(about, cartpole.runs + study.runs, cartpole.curves | study.curves)
    assert plot.phases(both).axes[0].get_title() == "robot: PPO"
    figures = plot.success(both), plot.goals(both), plot.efficiency(both)
    for figure in figures:
        figure.savefig(tmp_path / "figure.png")
    shown = [text.get_text() for text in figures[1].axes[1].get_xticklabels()]
    assert shown == [label(method) for method in study.methods("robot")]
    shown = {text.get_text() for text in figures[2].axes[1].get_legend().get_texts()}
    assert shown == {label(method) for method in study.methods("robot")}
    text = robot_tables.tables(both)
    assert text.count("Mean actions:") == 1 and "nan" not in text
    monkeypatch.setitem(results_page.ROBOTS, "paper-robot", ("robot", "A robot"))
    page = results_page.robot_section("paper-robot", both)
    assert page.count("**confirmed**") == 8
    block = results_page.readme_robot_block({"paper-robot": both})
    assert block.count("| A robot, 3.0 M steps | PPO | 5 | ") == block.count("|  | PPO + aug. | 5 | ") == 1


def test_a_method_without_any_evaluated_seed_is_named():
    study = robot_world(True)
    lost = Study(study.about, [r for r in study.runs if r["method"] != "ppo"], study.curves)
    table = robot_claims.table(lost, "robot")
    assert table.count("no seed of PPO was evaluated") == 7
    assert "| PPO | 0 | - |" in robot_tables.success_table(lost, "robot")
