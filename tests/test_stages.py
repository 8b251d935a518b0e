"""Stages follow each other, in one folder, and are all checked before the first."""

import dataclasses
import functools

import pytest

import tasks
from torchrl_sym.recipes import PPOConfig, RunFolder, Stage, load_actor, train_stages
from torchrl_sym.recipes.runs import read_progress, trained_folder

TINY = PPOConfig(iterations=2, num_envs=4, horizon=8, epochs=1, minibatches=1)
STEADY = dataclasses.replace(TINY, std_schedule=(0.4, 0.1), iterations=3)
MAKE_ENV = functools.partial(tasks.make_env, "cartpole", num_threads=1)
SYMMETRY = MAKE_ENV(num_envs=1, seed=0).symmetry
STAGES = (Stage(TINY), Stage(STEADY, {"episode_seconds": 2.0}))


def test_a_stage_begins_where_the_one_before_ended(tmp_path):
    rows = list(train_stages(STAGES, MAKE_ENV, SYMMETRY, folder=tmp_path))
    assert [(row["stage"], row["iteration"]) for row in rows] == [(0, 1), (0, 2), (1, 1), (1, 2), (1, 3)]
    assert [row["std"] for row in rows[2:]] == pytest.approx([0.4, 0.2, 0.1])
    assert trained_folder(tmp_path) == tmp_path / "stage_1"
    assert read_progress(tmp_path)[0] == 5
    env = MAKE_ENV(num_envs=1)
    actors = (load_actor(folder, env, SYMMETRY) for folder in (tmp_path, tmp_path / "stage_1"))
    first, second = (dict(actor.state_dict()) for actor in actors)
    assert all(bool((first[name] == second[name]).all()) for name in first)
    assert train_stages(STAGES, MAKE_ENV, SYMMETRY, folder=tmp_path).run() == {}


def test_a_stage_is_continued_in_its_own_environment(tmp_path):
    train_stages(STAGES, MAKE_ENV, SYMMETRY, folder=tmp_path).run()
    other = (STAGES[0], Stage(STEADY, {"episode_seconds": 3.0}))
    with pytest.raises(ValueError, match=r"another environment.*episode_seconds"):
        train_stages(other, MAKE_ENV, SYMMETRY, folder=tmp_path).run()
    assert RunFolder(tmp_path / "stage_1").load()["environment"]["episode_seconds"] == 2.0


@pytest.mark.parametrize(
    ("stages", "message"),
    [
        ((), "at least one Stage"),
        ((TINY,), "expected a sequence of at least one Stage"),
        ((STAGES[0], Stage(dataclasses.replace(TINY, num_envs=8))), "^num_envs: expected the same"),
        ((STAGES[0], Stage(dataclasses.replace(TINY, hidden=(8,)))), "^hidden: expected the same"),
        ((STAGES[0], Stage(TINY, {"episode_seconds": -1.0})), "episode_seconds"),
        ((STAGES[0], Stage(TINY, {"height": 1.0})), "height"),
    ],
)
def test_what_a_later_stage_cannot_do_is_said_before_the_first(stages, message, tmp_path):
    with pytest.raises((ValueError, TypeError), match=message):
        train_stages(stages, MAKE_ENV, SYMMETRY, folder=tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_iterations_of_a_schedule_cannot_change_afterwards():
    stored = dataclasses.asdict(STEADY)
    longer = dataclasses.replace(STEADY, iterations=4)
    assert longer.differences(stored) == {"iterations": (3, 4)}
    constant = dataclasses.replace(STEADY, std_schedule=(0.1, 0.1))
    assert dataclasses.replace(constant, iterations=4).differences(dataclasses.asdict(constant)) == {}
