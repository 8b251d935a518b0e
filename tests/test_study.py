"""The study of networks and of asymmetry: tasks with arguments of their own, rules, page."""

import dataclasses
import json
import math
import re

import numpy as np
import pandas as pd
import pytest
import torch
from torchrl.envs.utils import ExplorationType

import compare
import neutral
import plot_study
import study_costs
import study_page
from comparison import doses, network_claims
from comparison.doses import Dose, Doses, Rule
from comparison.environments import environment, task_arguments, task_setting, variant
from comparison.intervals import Estimate
from comparison.judging import Evaluated
from comparison.run import Run
from comparison.study import Study
from tasks.settings import SETTINGS
from tests.test_comparison import world

ABOUT = {"command": "c", "revisions": ["r"], "machine": "m", "workers": 2, "episodes": [500]}
# Per method: evaluated returns of both sides, the point at which training gets there, symmetry loss.
LATER_WORK_IS_RIGHT = {
    "ppo": (-1.9, -3.4, None, 10.0),
    "aug": (-1.5, -1.52, 9, 0.001),
    "aug+init-4": (-3.0, -3.1, 20, 100.0),
    "aug+symmetric-init": (-1.3, -1.3, 4, 0.001),
    "aug+symmetric-init+init-4": (-1.5, -1.5, 9, 0.001),
    "equivariant": (-1.2, -1.2, 3, 0.0),
    "relaxed": (-1.2, -1.2, 3, 0.001),
}
LATER_WORK_IS_WRONG = {
    "ppo": (-1.1, -1.1, 4, 10.0),
    "aug": (-1.2, -1.2, 6, 0.001),
    "aug+init-4": (-1.2, -1.2, 6, 0.01),
    "aug+symmetric-init": (-1.9, -1.9, 20, 0.001),
    "aug+symmetric-init+init-4": (-2.0, -2.0, 20, 10.0),
    "equivariant": (-1.9, -2.4, None, 0.0),
    "relaxed": (-2.6, -2.6, 15, 0.001),
}


def studied(methods, seeds=10):
    """A world in which an equivariant policy's sides differ by nothing but what its row says."""
    study = world(methods, seeds)
    runs = study.runs.copy()
    exact = runs["method"] == "equivariant"
    sides = dict(zip(("right", "left"), methods["equivariant"][:2], strict=True))
    runs.loc[exact, "return"] = runs["goal"].map(sides)[exact] + 0.001 * runs["seed"][exact]
    return Study(study.about | ABOUT, runs, study.curves)


RIGHT, WRONG = (Evaluated(studied(each)["cartpole"]) for each in (LATER_WORK_IS_RIGHT, LATER_WORK_IS_WRONG))


@pytest.mark.parametrize("claim", network_claims.CLAIMS, ids=lambda claim: claim.judge.__name__)
def test_every_verdict_on_networks_turns_with_the_data(claim):
    evidence, outcome = claim.judge(RIGHT)
    fails = claim.judge.__name__ == "_fail"  # there, all seeds of both learn
    assert outcome == ("not confirmed" if fails else "confirmed"), evidence
    evidence, outcome = claim.judge(WRONG)
    if claim.judge.__name__ == "_sooner":  # one that never learns is soon where it stays
        assert outcome == "to the threshold: different, to own return: not confirmed", evidence
    else:
        assert outcome == ("confirmed" if fails else "different"), evidence


def dosed(adapting, exact, plain):
    """A task and its variants: returns at doses 1 and 2 by method, trained under it and met after."""
    levels = {"ppo": plain, "aug": adapting, "equivariant": exact, "relaxed": adapting}
    without = studied({name: (level[0], level[0], 5, 0.1) for name, level in levels.items()})
    rows = [without.runs]
    for dose in (1, 2):
        met = without.runs.assign(what=f"knob={dose}")
        shift = without.runs["method"].map({name: level[dose] - level[0] for name, level in levels.items()})
        rows.append(met.assign(**{"return": met["return"] + shift}))
    symmetric = Study(without.about, pd.concat(rows), without.curves)
    under, curves = [], []
    for dose in (1, 2):
        task = f"cartpole@knob={dose}"
        under.append(rows[dose].assign(task=task, what="task"))
        curves.append(without.curves.assign(task=task))
    tasks = {f"cartpole@knob={dose}": without.about["methods"]["cartpole"] for dose in (1, 2)}
    about = without.about | {"methods": tasks}
    return symmetric, Study(about, pd.concat(under), pd.concat(curves))


def test_a_dose_from_which_on_exactness_costs_is_found():
    symmetric, under = dosed(adapting=(-1.0, -1.1, -1.2), exact=(-1.0, -1.1, -2.0), plain=(-1.5,) * 3)
    on = Doses(symmetric["cartpole"], under)
    assert on.knobs == {"knob": [Dose("knob=1", "knob", 1.0), Dose("knob=2", "knob", 2.0)]}
    costs, overtaken = doses.RULES[:2]
    ((_, _, knob, evidence, outcome, start),) = costs.rows(on)
    assert (knob, outcome, start) == ("knob", "**confirmed**", "-"), evidence
    assert evidence.startswith("0: ") and "1: " in evidence and "2: 0.79 (" in evidence
    ((*_, outcome, start),) = overtaken.rows(on)
    assert (outcome, start) == ("**confirmed**", "-")
    after = [rule for rule in doses.RULES if not rule.trained]
    assert [rule.rows(on)[0][4:] for rule in after] == [["**confirmed**", "0"], ["**confirmed**", "-"]]
    symmetric, under = dosed(adapting=(-1.0, -2.0, -3.0), exact=(-1.0,) * 3, plain=(-0.5,) * 3)
    on = Doses(symmetric["cartpole"], under)
    assert [rule.rows(on)[0][4] for rule in doses.RULES] == [
        f"**{outcome}**" for outcome in ("different", "confirmed", *["different"] * 4)
    ]


def test_the_first_of_equal_verdicts_is_named():
    up, none = Estimate(1.0, 0.5, 1.5, 10), Estimate(1.0, -0.5, 1.5, 10)
    gaps = [Dose(), Dose("k=1", "k", 1.0), Dose("k=2", "k", 2.0)]
    found = [doses.judged(dict(zip(gaps, each, strict=True))) for each in ([none, up, up], [up, none, up])]
    assert found == [("confirmed", "1"), ("confirmed", "-")]
    assert Dose.of("weak_leg=LF") == Dose("weak_leg=LF", "weak_leg", 1.0)
    assert Dose.of("payload=10.0,payload_position=(0.2,0.1,0.1)").size == 10.0


def test_a_dose_that_one_side_lacks_is_left_out():
    symmetric, under = dosed((-1.0,) * 3, (-1.0,) * 3, (-1.0,) * 3)
    about = under.about | {"methods": dict(list(under.about["methods"].items())[:1])}
    on = Doses(symmetric["cartpole"], Study(about, under.runs, under.curves))
    assert [str(dose) for dose in on.gaps(doses.RULES[0], "knob")] == ["0", "1"]
    nothing = Rule("text", "place", "aug", "equivariant", True)
    on = Doses(symmetric["cartpole"], Study(about | {"methods": {}}, under.runs, under.curves))
    assert nothing.rows(on) == [] and on.methods(trained=True) == []
    assert len(on.methods(trained=False)) == 4


def test_the_page_has_everything_that_there_is(tmp_path):
    symmetric, under = dosed((-1.0, -1.1, -1.2), (-1.0, -1.1, -2.0), (-1.5,) * 3)
    studies = {"study-cartpole": symmetric, "study-cartpole-doses": under}
    costs = {"cartpole": dict.fromkeys(symmetric["cartpole"], 15.0) | {"ppo": 12.0}}
    text = study_page.page(studies, costs, tmp_path)
    assert {path.name for path in tmp_path.iterdir()} == {"cost.png", "cartpole.png"}
    assert "## CartPole: which way" in text and "## CartPole: a dose" in text and "| knob 2 |" in text
    assert text == study_page.page(studies, costs) and "| 15.0 |" in text and "| 1.25 |" in text
    alone = study_page.page({"study-cartpole": symmetric}, costs)
    assert "## CartPole: which way" in alone and "a dose of asymmetry" not in alone
    assert len(plot_study.doses(Doses(symmetric["cartpole"], under)).axes) == 2


def test_a_task_with_arguments_is_trained_and_evaluated_with_them(tmp_path):
    env = environment("cartpole@motor_bias=0.5")(num_envs=1, seed=0)
    assert env.task.motor_bias == 0.5
    assert task_setting("cartpole@motor_bias=0.5") is SETTINGS["cartpole"]
    assert variant("cartpole") == ("cartpole", {})
    assert task_arguments("a=(1,2),b=LF,c=-0.5") == {"a": (1, 2), "b": "LF", "c": -0.5}
    setting = SETTINGS["cartpole"].replace(iterations=1, num_envs=4, horizon=4)
    runs = [Run(f"cartpole@motor_bias={b}", "ppo", 0, setting, tmp_path / b, 4) for b in ("0.0", "2.0")]
    for run in runs:
        run.execute()
    without, under = (np.array([row["return"] for row in run.result()["evaluation"]]) for run in runs)
    assert not np.isclose(without, under).any()


@pytest.mark.parametrize(
    ("task", "message"),
    [
        ("cartpole@", "expected arguments of a task such as"),
        ("cartpole@3", "expected arguments of a task such as"),
        ("cartpole@motor_bias", "expected arguments of a task such as"),
        ("cartpole@motor_bias=1,motor_bias=2", "expected arguments of a task such as"),
        ("cartpole@motor_bias=1),dict(wind=2", "expected arguments of a task such as"),
        ("cartpole@motor_bias=1+1j*x", "expected arguments of a task such as"),
        ("cartpole@motor_bias=100.0", "motor_bias: expected a finite number"),
        ("cartpole@tilt=1", "rail_tilt"),
    ],
)
def test_arguments_that_a_task_does_not_take_are_refused_at_once(task, message):
    with pytest.raises(ValueError, match=message):
        task_setting(task)


@pytest.mark.parametrize(("task", "element"), [("anymal_push", "reflect-y"), ("anymal_climb", "reflect-x")])
def test_neutral_starts_are_their_own_image(task, element):
    env = environment(task)(num_envs=1, seed=0, episode_seconds=0.2)
    drawn, own = neutral.near_starts(env.task, 4, element)
    image = env.task.transform_state(own, element)
    assert neutral.differences(env.task, own.qpos, image.qpos).abs().max() < 1e-12
    torch.testing.assert_close(own.mocap_pos, image.mocap_pos)
    moved = neutral.differences(env.task, drawn.qpos, own.qpos).abs().amax(-1)
    assert (moved > 1e-3).all() and (moved < 0.3).all()


def test_who_leaves_neutral_starts():
    env = environment("anymal_push")(num_envs=1, seed=0, episode_seconds=0.3)
    _, own = neutral.near_starts(env.task, 2, "reflect-y")
    still, lame = torch.zeros(12), torch.tensor([0.5, *[0.0] * 11])
    played = [
        neutral.play(
            env.task,
            lambda td, action=action: td.set("action", action.expand(*td.batch_size, 12)),
            own,
            ExplorationType.DETERMINISTIC,
            "reflect-y",
        )
        for action in (still, lame)
    ]
    assert played[0].figures()["never_broken"] == 1.0 and math.isinf(
        played[0].figures()["symmetric_seconds"]
    )
    assert played[1].figures()["never_broken"] == 0.0 and played[1].broken.max() < 0.2
    rows = [
        {"method": m, "actions": "sampled", "start": s, **p.figures()}
        for m, p in zip("ab", played, strict=True)
        for s in neutral.STARTS
    ]
    assert neutral.table(rows).splitlines()[2].startswith("| a | sampled | 0% | 0% |")


def test_what_a_step_costs_is_measured_for_every_method(tmp_path, monkeypatch):
    tiny = dataclasses.replace(SETTINGS["cartpole"].replace(num_envs=8, horizon=4), tuned={})
    monkeypatch.setattr(study_costs, "task_setting", lambda task: tiny)
    arguments = study_costs.Arguments(("study-cartpole",), 1, tmp_path / "costs.json")
    assert study_costs.main(arguments) == 0
    costs = json.loads(arguments.output.read_text())["costs"]["cartpole"]
    assert {"ppo", "aug", "equivariant", "relaxed"} < set(costs) and min(costs.values()) > 0


def test_evaluations_under_other_arguments_come_on_top():
    setting = compare.evaluated_under(["wind=1", "motor_bias=0.5"], "cartpole")
    assert setting.evaluations == {"task": {}, "wind=1": {"wind": 1}, "motor_bias=0.5": {"motor_bias": 0.5}}
    kept = compare.evaluated_under(["weak_leg=LF"], "anymal_climb").evaluations
    assert kept["weak_leg=LF"] == {"phase": "B", "weak_leg": "LF"} and len(kept) == 3
    assert compare.evaluated_under((), "cartpole") == SETTINGS["cartpole"]
    with pytest.raises(ValueError, match="expected different --under"):
        compare.chosen(compare.Arguments(under=("wind=1", "wind=1")))
    with pytest.raises(ValueError, match="rail_tilt"):
        compare.evaluated_under(["tilt=1"], "cartpole")


def test_the_page_follows_from_the_stored_results():
    stored = study_page.stored(study_page.HERE / "results")
    page = (study_page.HERE.parent / "docs" / "study.md").read_text()
    assert page == study_page.page(*stored), "run python benchmarks/study_page.py"
    drawn = set(re.findall(r"\]\(\.\./benchmarks/plots/study/(.*?)\)", page))
    assert drawn == {path.name for path in (study_page.HERE / "plots" / "study").iterdir()}
