"""Rows that were trained by rules of the past say so, and stop saying so once they are made again."""

import copy
from pathlib import Path

import pandas as pd
import pytest

from comparison.methods import Method
from comparison.reruns import footnote, marked, marks
from comparison.run import described
from comparison.study import Study, read
from comparison.tables import table_1
from tasks.settings import SETTINGS

RESULTS = Path(__file__).parents[1] / "benchmarks" / "results"


def made_today(task: str, method: str, std: float) -> Study:
    """Results of one method with today's settings, and a deviation in their last stage."""
    stored = described(Method.parse(method).configure(SETTINGS[task], 0))
    curves = pd.DataFrame({name: [0.0, 1.0, 1.0] for name in ("stage", "frames", "mirror_loss", "seconds")})
    curves = curves.assign(task=task, method=method, seed=0, std=[0.3, std, std])
    return Study({"methods": {task: {method: stored}}, "threads": 1}, pd.DataFrame(), curves)


@pytest.mark.parametrize("task", ["cartpole", "anymal_push", "trifinger_repose"])
def test_what_is_trained_by_todays_rules_has_no_mark(task):
    assert marks(made_today(task, "aug", 0.08)[task]["aug"]) == ""


def before(study: Study, task: str, method: str) -> Study:
    """The same as code before the schedule of the deviation stored it."""
    about = copy.deepcopy(study.about)
    for stage in about["methods"][task][method]:
        del stage["config"]["std_schedule"]
    return Study(about, study.runs, study.curves)


@pytest.mark.parametrize(("std", "mark"), [(0.08, ""), (0.07, "‡"), (0.0801, "‡")])
def test_a_deviation_that_was_not_the_schedules_is_marked(std, mark):
    old = before(made_today("anymal_push", "ppo", std), "anymal_push", "ppo")
    assert marks(old["anymal_push"]["ppo"]) == mark


def test_a_rate_that_followed_each_step_is_marked():
    old = before(made_today("trifinger_repose", "ppo", 0.1), "trifinger_repose", "ppo")
    assert marks(old["trifinger_repose"]["ppo"]) == "†"
    assert marked(old["trifinger_repose"]["ppo"]) == "PPO †"
    assert (
        footnote("PPO †") == "Rows that await a rerun: † the learning rate was adapted one minibatch late."
    )


def test_other_settings_are_marked():
    study = made_today("anymal_push", "ppo", 0.08)
    study.about["methods"]["anymal_push"]["ppo"][1]["config"]["gamma"] = 0.5
    assert marks(study["anymal_push"]["ppo"]) == "§"
    del study.about["methods"]["anymal_push"]["ppo"][1]
    assert marks(study["anymal_push"]["ppo"]) == "§"


def test_no_module_is_imported_because_results_name_it():
    study = Study({"methods": {"os:system": {"ppo": []}}}, pd.DataFrame(), pd.DataFrame())
    assert marks(study["os:system"]["ppo"]) == ""


def test_tables_say_what_their_marks_mean():
    study = read(RESULTS / "paper-push")
    text = table_1(study["anymal_push"])
    assert "| PPO ‡ |" in text and "| PPO + aug. (random) |" in text
    assert "‡ the deviation of the last stage" in text and "†" not in text
