"""The parts of benchmarks/compare.py: methods, statistics, tables, verdicts."""

import dataclasses
import json
import math
import shutil
import sys

import numpy as np
import pandas as pd
import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.envs.utils import ExplorationType

from comparison import claims, tables, verdicts
from comparison import run as run_module
from comparison.environments import environment, task_setting
from comparison.files import write_json
from comparison.intervals import Estimate, band, difference, estimate, iqm
from comparison.judging import Evaluated
from comparison.progress import crossing
from comparison.records import EarlierResults
from comparison.run import Run, read_curve
from comparison.study import Study, read
from comparison.writing import write
from tasks.anymal_push import AnymalPush
from tasks.settings import SETTINGS
from torchrl_sym.recipes import RunFolder, load_actor, train


def test_interquartile_mean_by_hand():
    assert iqm(np.array([100.0, 1.0, 2.0, 3.0, 4.0, -50.0, 2.0, 3.0])) == pytest.approx(2.5)
    low, high = band(np.array([[1.0, 5.0], [1.0, 7.0]]))
    assert (low[0], high[0]) == (1.0, 1.0)
    assert (low[1], high[1]) == (5.0, 7.0)
    assert estimate(np.array([3.0])) == Estimate(3.0, -math.inf, math.inf)
    assert estimate(np.array([3.0])).format() == "3.000"


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


def make_study(returns, curves, task="cartpole", seconds=1.0, columns=None):
    """A study from evaluated returns (seeds, goals) and training returns (seeds, points) by method."""
    goals = ["right", "left"]
    rows = [
        {"task": task, "method": m, "seed": s, "outcome": "finished", "what": "task"}
        | {"actions": "deterministic", "goal": goal, "return": value}
        for m, values in returns.items()
        for s, row in enumerate(values)
        for goal, value in zip(goals, row, strict=True)
    ]
    tables = []
    for m, values in curves.items():
        for s, row in enumerate(np.asarray(values, dtype=float)):
            steps = np.arange(1, len(row) + 1) * 1e5
            own = {"frames": steps, "seconds": steps * 1e-5 * seconds, "return": row}
            for column in ("mirror_loss", "log_prob", "log_prob_copies"):
                own[column] = (columns or {}).get((m, column), 1.0)
            tables.append(pd.DataFrame(own).assign(task=task, method=m, seed=s))
    return Study({"methods": {task: dict.fromkeys(returns)}}, pd.DataFrame(rows), pd.concat(tables))


def changed(study, method, seed, change):
    """A study with other rows of one curve."""
    mine = (study.curves["method"] == method) & (study.curves["seed"] == seed)
    parts = [study.curves[~mine], change(study.curves[mine])]
    return Study(study.about, study.runs, pd.concat(parts).sort_values(["method", "seed"], kind="stable"))


def test_efficiency_by_hand():
    rising = [-10.0, -8.0, -6.0, -4.0, -2.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    study = make_study({"ppo": [[0, 0]] * 2}, {"ppo": [rising, [-10.0] * 10]}, seconds=2.0)
    task, results = study["cartpole"], study["cartpole"]["ppo"]
    assert task.threshold == pytest.approx(0.1 * -10 + 0.9 * -5)
    found = [crossing(curve, -1.0)[0] for curve in results.progress.values()]
    assert found == [0.9, math.inf], "the mean of five points reaches -0.4 at 9"
    assert results.own_steps.tolist() == [0.9, 0.5], "-0.6, from -6 to 0; and at once"
    assert results.seconds_per_step == pytest.approx(2e-5)
    assert "| PPO | 1 of 2 | - | - | 50,000 |" in tables.efficiency_table(task)
    slow = changed(study, "ppo", 1, lambda c: c.assign(**{"return": rising, "seconds": 3 * c["seconds"]}))
    task, results = slow["cartpole"], slow["cartpole"]["ppo"]  # 6 s a point
    assert task.threshold == pytest.approx(-1.0)
    assert results.crossings.tolist() == [[0.9, 18.0], [0.9, 54.0]]
    # Of steps and of seconds each the median; seconds per step are that of all intervals together.
    assert "| PPO | 2 of 2 | 0.90 | 36 | 25,000 |" in tables.efficiency_table(task)
    short = changed(slow, "ppo", 1, lambda c: c.head(3))["cartpole"]["ppo"]
    assert [crossing(curve, -1.0) for curve in short.progress.values()][1] == (math.inf, math.inf)


def test_table_1_by_hand():
    study = make_study({"ppo": [[-1.0, -3.0], [-2.0, -2.5]]}, {"ppo": [[-1.0] * 3] * 2})
    assert study["cartpole"]["ppo"].variation().tolist() == [2.0, 0.5]
    row = tables.table_1(study["cartpole"]).splitlines()[2]
    assert row == "| PPO | 2 | -2.125 (-2.250 to -2.000) | 1.250 (0.500 to 2.000) | 2.000 | 1 |"


def test_curves_of_different_lengths_are_aligned_by_steps():
    study = make_study({"ppo": [[0, 0]] * 3}, {"ppo": [[1.0, 2.0, 3.0, 4.0]] * 3})
    # Diverged in the middle, with a row off the others' grid; and before it had a return.
    study = changed(study, "ppo", 1, lambda c: c.head(2).assign(frames=[1e5, 2.5e5]))
    study = changed(study, "ppo", 2, lambda c: c.assign(**{"return": math.nan}))
    curve = study["cartpole"]["ppo"].curve("return")
    np.testing.assert_allclose(curve.index, [0.1, 0.2, 0.3, 0.4])
    assert curve.to_dict("list") == {0: [1, 2, 3, 4], 1: [1, 1, 2, 2]}
    assert len(study["cartpole"]["ppo"].crossings) == 3


def test_verdicts_follow_the_interval():
    assert verdicts.verdict(Estimate(1.0, 0.1, 2.0, 5)) == "confirmed"
    assert verdicts.verdict(Estimate(1.0, 0.1, 2.0, 4)) == "confirmed (4 seeds)"
    assert verdicts.verdict(Estimate(1.0, -0.1, 2.0, 5)) == "not confirmed"
    assert verdicts.verdict(Estimate(-1.0, -2.0, -0.1, 5)) == "different"
    for rule in (verdicts.verdict, lambda gap: verdicts.no_gain(gap, 0.5)):
        assert rule(Estimate(1.0, -math.inf, math.inf)) == "undecided"
    assert verdicts.no_gain(Estimate(1.0, 0.1, 2.0, 5), 0.5) == "different"
    assert verdicts.no_gain(Estimate(1.0, -0.1, 2.0, 5), 0.5) == "not confirmed"
    assert verdicts.no_gain(Estimate(0.1, -0.1, 0.3, 5), 0.5) == "confirmed"
    assert verdicts.no_gain(Estimate(0.2, 0.1, 0.3, 5), 0.5) == "confirmed", "a gain, but below the margin"
    assert verdicts.more((10, 10), (2, 10)) == "confirmed"
    assert verdicts.more((2, 10), (10, 10)) == "different"
    assert verdicts.more((10, 10), (9, 10)) == "not confirmed"
    assert verdicts.more((5, 10), (0, 10)) == "confirmed", "p = 0.016"
    assert verdicts.more((4, 10), (0, 10)) == "not confirmed", "p = 0.043, on one side"
    assert verdicts.more((3, 4), (1, 4)) == "not confirmed (4 seeds)"
    assert verdicts.joined({"return": "a", "speed": "a"}) == "a"
    assert verdicts.joined({"than PPO": "a", "speed": "b"}) == "than PPO: a, speed: b"


# Per method: evaluated returns of both sides, the point at which training gets there, symmetry loss.
PAPER_IS_RIGHT = {
    "ppo": (-1.4, -3.4, 10, 10.0),
    "loss-0.1": (-2.4, -2.9, 11, 1.0),
    "loss-1": (-2.6, -3.0, 12, 0.1),
    "loss-10": (-4.0, -4.2, 16, 0.01),
    "aug": (-1.3, -1.3, 3, 0.001),
    "aug+loss-0.1": (-1.3, -1.3, 3, 0.001),
    "aug-random": (-1.3, -1.3, 3, 0.001),
    "aug-naive": (-8.0, -8.0, None, 10.0),
    "aug-naive-raw": (-8.0, -8.0, None, 10.0),
    "aug+init-4": (-2.0, -2.0, 8, 100.0),
    "aug+loss-0.1+init-4": (-2.0, -2.0, 8, 0.01),
    "aug+init-0.1": (-1.1, -1.1, 1, 0.001),
}
PAPER_IS_WRONG = {
    "ppo": (-1.3, -1.3, 6, 0.001),
    "loss-0.1": (-1.2, -1.2, 5, 0.01),
    "loss-1": (-1.2, -1.2, 4, 0.1),
    "loss-10": (-1.1, -1.1, 2, 1.0),
    "aug": (-1.4, -3.4, 14, 10.0),
    "aug+loss-0.1": (-1.2, -1.2, 5, 0.1),
    "aug-random": (-3.0, -3.0, 14, 10.0),
    "aug-naive": (-1.3, -1.3, 6, 0.001),
    "aug-naive-raw": (-1.3, -1.3, 6, 0.001),
    "aug+init-4": (-1.3, -1.3, 6, 0.01),
    "aug+loss-0.1+init-4": (-1.3, -1.3, 6, 1.0),
    "aug+init-0.1": (-5.0, -5.0, 20, 10.0),
}


def world(methods, seeds=10):
    noise = np.random.default_rng(0)
    returns, curves, columns = {}, {}, {}
    for name, (right, left, start, loss) in methods.items():
        returns[name] = np.array([[right, left]] * seeds) + noise.normal(size=(seeds, 2)) * 0.005
        curves[name] = np.full((seeds, 30), -8.0) + noise.normal(size=(seeds, 30)) * 0.005
        if start is not None:
            curves[name][:, start:] += 6.5
        columns[name, "mirror_loss"] = loss
        columns[name, "log_prob_copies"] = -1000.0 if start is None else -1.0
    return make_study(returns, curves, columns=columns)


RIGHT, WRONG = (Evaluated(world(each)["cartpole"]) for each in (PAPER_IS_RIGHT, PAPER_IS_WRONG))
OF_CARTPOLE = [claim for claim in claims.CLAIMS if claim.applies(RIGHT)]


def test_all_claims_but_those_of_robots_apply_to_cartpole():
    names = [claim.judge.__name__ for claim in claims.CLAIMS if claim not in OF_CARTPOLE]
    assert names == ["_recovery", "_turning"]


@pytest.mark.parametrize("claim", OF_CARTPOLE, ids=lambda claim: claim.judge.__name__)
def test_every_verdict_turns_with_the_data(claim):
    evidence, outcome = claim.judge(RIGHT)
    assert outcome == "confirmed", evidence
    evidence, outcome = claim.judge(WRONG)
    # All seeds reach the threshold there, with and without re-evaluated probabilities.
    assert outcome == ("not confirmed" if claim.judge.__name__ == "_naive" else "different"), evidence


def test_results_survive_writing_and_reading(tmp_path):
    setting = SETTINGS["cartpole"].replace(iterations=2, num_envs=8, horizon=4)
    run = Run("cartpole", "ppo", 5, setting, tmp_path / "run", episodes=2)
    assert run.result() is None
    run.execute()
    assert run.progress()[0] == run.iterations == 2
    lost = dataclasses.replace(run, seed=6, folder=tmp_path / "lost")
    write(tmp_path / "results", [run, lost], [lost], {"workers": 1})
    study = read(tmp_path / "results")
    results = study["cartpole"]["ppo"]
    assert (list(study), list(study["cartpole"]), results.seeds) == (["cartpole"], ["ppo"], [5])
    assert study.about["failed"] == ["cartpole ppo 6"]
    evaluated = results.evaluated()
    stored = [r["return"] for r in run.result()["evaluation"] if r["actions"] == "deterministic"]
    assert list(evaluated) == ["right", "left"]
    np.testing.assert_allclose(evaluated.loc[5], stored, rtol=1e-5)
    losses = results.curve("mirror_loss")
    assert losses.index.tolist() == [32e-6, 64e-6]
    np.testing.assert_allclose(losses[5], [row["mirror_loss"] for row in read_curve(run.folder)], rtol=1e-5)
    # What was trained elsewhere says so, wherever it is collected.
    stored = run.result()
    other = dataclasses.replace(run, seed=7, setting=setting.replace(seed=7), folder=tmp_path / "other")
    shutil.copytree(run.folder, other.folder)
    (here,) = stored["origins"]
    elsewhere = {"machine": "elsewhere", "versions": here["versions"] | {"torch": "0"}, "revision": "r"}
    write_json(other.folder / "result.json", stored | other.request() | {"origins": [elsewhere]})
    write(tmp_path / "results", [run, other], [], {"workers": 1})
    about = read(tmp_path / "results").about
    assert about["machine"] == " / ".join(sorted([here["machine"], "elsewhere"]))
    assert about["versions"] == here["versions"] | {"torch": f"0 / {torch.__version__}"}
    assert about["revisions"] == sorted([here["revision"], "r"])
    # A field of the configuration that there was not yet had its default.
    for name in ("request.json", "result.json"):
        old = json.loads((run.folder / name).read_text())
        del old["stages"][0]["config"]["tie_std"]
        write_json(run.folder / name, old)
    assert run.result() is not None
    run.execute()
    write(tmp_path / "results", [run], [], {})
    assert "tie_std" not in read(tmp_path / "results")["cartpole"]["ppo"].stages[0]["config"], "as stored"
    assert EarlierResults(tmp_path / "results").record(run) is not None
    assert dataclasses.replace(run, setting=setting.replace(tie_std=True)).result() is None
    # Asked for something else, it counts as not done, and its folder is refused.
    assert dataclasses.replace(run, episodes=3).result() is None
    longer = dataclasses.replace(run, setting=setting.replace(iterations=3))
    assert longer.result() is None
    with pytest.raises(ValueError, match="got a run with other settings"):
        longer.execute()


def test_the_policy_of_the_best_seed_is_kept(tmp_path):
    setting = SETTINGS["anymal_push"].replace(iterations=1, num_envs=4, horizon=4, minibatches=1)
    setting = dataclasses.replace(setting, evaluations={"task": {"episode_seconds": 0.1}}, then=())
    runs = [Run("anymal_push", "ppo", s, setting.replace(seed=s), tmp_path / str(s), 1) for s in (0, 1)]
    for run in runs:
        run.execute()
        found = run.result()["evaluation"]
        assert {row["goal"] for row in found if row["turning"] > 0} == set(AnymalPush.goal_names)
    write(tmp_path / "results", runs, [], {"workers": 1})
    means = [
        np.mean([row["return"] for row in run.result()["evaluation"] if row["actions"] == "deterministic"])
        for run in runs
    ]
    env = environment("anymal_push")(num_envs=1)
    kept = load_actor(tmp_path / "results/policies/anymal_push/ppo", env, env.symmetry)
    best = load_actor(runs[int(np.argmax(means))].folder / "stage_0", env, env.symmetry)
    assert all(map(torch.equal, kept.state_dict().values(), best.state_dict().values()))
    assert np.isfinite(read(tmp_path / "results")["anymal_push"]["ppo"].returns("turning")).all()
    # Also where one of the runs, the better or the other, is known from results alone.
    for known in runs:
        where = tmp_path / f"extended_{known.seed}"
        write(where, [known], [], {"workers": 1})
        lost = dataclasses.replace(known, folder=tmp_path / "lost")
        both = [lost if run is known else run for run in runs]
        write(where, both, [], {"workers": 1}, earlier=EarlierResults(where))
        for name in ("runs.csv", "curves.csv"):
            assert (where / name).read_text() == (tmp_path / "results" / name).read_text()
        kept = load_actor(where / "policies/anymal_push/ppo", env, env.symmetry)
        assert all(map(torch.equal, kept.state_dict().values(), best.state_dict().values()))


def test_a_later_stage_that_diverges_early_leaves_the_policy_of_the_one_before(tmp_path):
    tiny = SETTINGS["cartpole"].replace(iterations=2, num_envs=8, horizon=4, minibatches=1)
    worse = tiny.replace(entropy_coeff=3e38)  # its gradient is not finite
    setting = dataclasses.replace(tiny, then=worse.stages)
    run = Run("cartpole", "ppo", 0, setting, tmp_path / "run", episodes=2)
    run.execute()
    result = run.result()
    assert result["outcome"].startswith("diverged") and len(result["evaluation"]) == 4
    assert RunFolder(run.folder / "stage_1").load()["iteration"] == 0
    env = environment("cartpole")(num_envs=1)
    whole = (load_actor(folder, env, env.symmetry) for folder in (run.folder, run.folder / "stage_0"))
    assert all(map(torch.equal, *(actor.state_dict().values() for actor in whole)))
    write(tmp_path / "results", [run], [], {"workers": 1})
    results = read(tmp_path / "results")["cartpole"]["ppo"]
    assert results.diverged == {0}
    assert np.isfinite(results.returns()).all()


def test_stages_follow_each_other_also_after_an_interruption(tmp_path):
    tiny = SETTINGS["cartpole"].replace(iterations=2, num_envs=8, horizon=4, checkpoint_interval=1)
    setting = dataclasses.replace(tiny, then=tiny.replace(iterations=3, gamma=0.9).stages)
    whole = Run("cartpole", "ppo", 0, setting, tmp_path / "whole", episodes=2)
    whole.execute()
    curve = read_curve(whole.folder)
    assert [row["stage"] for row in curve] == [0, 0, 1, 1, 1]
    assert [row["frames"] for row in curve] == [32, 64, 96, 128, 160]
    assert whole.progress()[0] == whole.iterations == 5
    killed = dataclasses.replace(whole, folder=tmp_path / "killed")
    stages = killed.setting.stages
    make_env = environment("cartpole")
    first = list(
        train(stages[0].config, make_env, make_env(num_envs=1).symmetry, folder=killed.folder / "stage_0")
    )
    assert len(first) == 2
    second = train(
        stages[1].config,
        make_env,
        make_env(num_envs=1).symmetry,
        folder=killed.folder / "stage_1",
        start_from=killed.folder / "stage_0",
    )
    next(second)
    second.close()
    killed.execute()
    keys = ("frames", "mirror_loss", "log_prob", "kl")
    assert [[row[key] for key in keys] for row in read_curve(killed.folder)] == [
        [row[key] for key in keys] for row in curve
    ]
    assert killed.result()["evaluation"] == whole.result()["evaluation"]


def test_episodes_that_never_end_are_refused(monkeypatch):
    monkeypatch.setattr(run_module, "MAX_STEPS", 5)
    env = environment("cartpole")(num_envs=2, seed=0, episode_seconds=0.1)
    still = TensorDictModule(lambda x: torch.zeros_like(x[..., :1]), ["observation"], ["action"])
    outcome = run_module.evaluate_plainly(env, still, ExplorationType.DETERMINISTIC)
    assert outcome.returns.shape == (1, 2)
    assert outcome.mean == pytest.approx(-math.pi / 2 * 0.1, rel=0.1)
    env = environment("cartpole")(num_envs=2, seed=0, episode_seconds=0.2)
    with pytest.raises(ValueError, match="expected episodes of at most 5 steps"):
        run_module.evaluate_plainly(env, still, ExplorationType.DETERMINISTIC)


def test_an_unknown_task_says_what_is_expected():
    for task in ("cartpool", "no_such_module:make", "math:no_such_function", "math:pi", ".x:make", "math"):
        with pytest.raises(ValueError, match="expected a task of"):
            environment(task)
    assert task_setting("cartpole") is SETTINGS["cartpole"]


def test_a_module_where_the_command_was_given_takes_the_place_of_no_other(tmp_path, monkeypatch):
    (tmp_path / "wave.py").write_text("raise RuntimeError('imported from the working directory')")
    (tmp_path / "somebodys.py").write_text("SETTING = 3\nmake = dict")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [path for path in sys.path if path])
    monkeypatch.delitem(sys.modules, "wave", raising=False)
    environment("wave:open")
    with pytest.raises(ValueError, match=r"expected SETTING of somebodys .* got int"):
        task_setting("somebodys:make")
