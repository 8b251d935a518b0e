"""What a run leaves on disk: nothing is lost, nothing is mixed, and what is damaged says so."""

import dataclasses
import functools
import time
from pathlib import Path

import numpy as np
import pytest
import torch

import tasks
from tasks.environment import BatchedEnv
from tests.launch import Script
from torchrl_sym.recipes import PPOConfig, RunFolder, export_actor, load_actor, read_metrics, train
from torchrl_sym.recipes.table import MetricsTable

TINY = PPOConfig(iterations=3, num_envs=4, horizon=8, epochs=1, minibatches=1)
LONGER = dataclasses.replace(TINY, iterations=4)
MAKE_ENV = functools.partial(tasks.make_env, "cartpole", num_threads=1)
SYMMETRY = MAKE_ENV(num_envs=1, seed=0).symmetry


@pytest.fixture(scope="module")
def finished(tmp_path_factory) -> Path:
    """A run of three iterations; copy it before changing it."""
    folder = tmp_path_factory.mktemp("finished")
    train(TINY, MAKE_ENV, SYMMETRY, folder=folder).run()
    return folder


@pytest.fixture
def folder(finished, tmp_path) -> Path:
    for path in finished.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    return tmp_path


def content(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.name != "lock"}


# --- the lock ---------------------------------------------------------------------------------------------

HOLDER = """
import functools, sys, tasks
from torchrl_sym.recipes import PPOConfig, train
make_env = functools.partial(tasks.make_env, "cartpole", num_threads=1)
config = PPOConfig(iterations=10**6, num_envs=4, horizon=8, epochs=1, minibatches=1)
for row in train(config, make_env, make_env(num_envs=1).symmetry, folder=sys.argv[1]):
    print(row["iteration"], flush=True)
"""


def test_one_process_trains_in_a_folder_and_a_kill_gives_it_up(tmp_path):
    holder = Script(HOLDER, tmp_path)
    while not holder.output()[0]:
        assert holder.process.is_alive(), holder.output()
        time.sleep(0.01)
    config = dataclasses.replace(TINY, iterations=10**6)
    with pytest.raises(BlockingIOError, match=f"process {holder.process.pid} holds"):
        train(config, MAKE_ENV, SYMMETRY, folder=tmp_path)
    holder.kill()
    done = RunFolder(tmp_path).load()["iteration"]
    training = train(config, MAKE_ENV, SYMMETRY, folder=tmp_path)
    assert next(training)["iteration"] == done + 1
    training.close()
    rows = read_metrics(tmp_path / "metrics.csv")
    assert [row["iteration"] for row in rows] == list(range(1, done + 2))


def test_a_folder_is_given_up_at_the_end_and_by_what_is_not_begun(folder):
    with pytest.warns(RuntimeWarning, match="never begun"):
        train(LONGER, MAKE_ENV, SYMMETRY, folder=folder)
    waiting = train(LONGER, MAKE_ENV, SYMMETRY, folder=folder)
    with pytest.raises(BlockingIOError, match="nobody trains in"):
        train(LONGER, MAKE_ENV, SYMMETRY, folder=folder)
    assert waiting.run()["iteration"] == 4
    assert train(LONGER, MAKE_ENV, SYMMETRY, folder=folder).run() == {}
    with pytest.raises(ValueError, match="another configuration"):
        train(dataclasses.replace(TINY, gamma=0.5), MAKE_ENV, SYMMETRY, folder=folder)
    train(LONGER, MAKE_ENV, SYMMETRY, folder=folder).close()  # a refused one gave it up too


# --- everything is checked when a training is built -------------------------------------------------------


class Stateful(BatchedEnv):
    """A CartPole whose saved state can be spoilt."""

    def save_state(self):
        return super().save_state() | {"level": np.float64(1.0)}


class Talkative(BatchedEnv):
    """A CartPole that measures something that is no number."""

    def metrics(self):
        return super().metrics() | {"level": "high"}


def of(cls):
    return lambda *, num_envs, seed: cls(MAKE_ENV(num_envs=1).task, num_envs, num_threads=1, seed=seed)


def test_a_state_that_could_not_be_read_back_is_refused_before_the_first_iteration(tmp_path):
    with pytest.raises(TypeError, match=r"numpy\.float64 in checkpoint\['env'\]\['level'\]"):
        train(TINY, of(Stateful), SYMMETRY, folder=tmp_path)
    assert not (tmp_path / "checkpoint.pt").exists()


def test_numbers_of_numpy_in_a_configuration_are_kept_as_numbers(tmp_path):
    config = dataclasses.replace(TINY, gamma=np.float64(0.9), iterations=np.int64(1), hidden=[np.int64(4)])
    train(config, MAKE_ENV, SYMMETRY, folder=tmp_path).run()
    stored = torch.load(tmp_path / "checkpoint.pt", weights_only=True)["config"]
    assert (stored["gamma"], stored["iterations"], stored["hidden"]) == (0.9, 1, (4,))


def test_metrics_of_an_environment_are_numbers():
    with pytest.raises(TypeError, match="'high' for 'level'"):
        train(TINY, of(Talkative), SYMMETRY).run()


@pytest.mark.parametrize("argument", range(3))
def test_arguments_of_other_types_are_refused(argument):
    arguments = [TINY, MAKE_ENV, SYMMETRY]
    arguments[argument] = "cartpole"
    with pytest.raises(TypeError, match=r"expected (PPOConfig|a function|Symmetry), got"):
        train(*arguments)


def test_another_environment_is_refused(folder):
    with pytest.raises(ValueError, match=r"another environment.*episode_seconds"):
        train(LONGER, functools.partial(MAKE_ENV, episode_seconds=2.0), SYMMETRY, folder=folder)
    other = functools.partial(tasks.make_env, "trifinger_repose", num_threads=1)
    with pytest.raises(ValueError, match=r"another environment.*cartpole.*trifinger_repose"):
        train(LONGER, other, other(num_envs=1).symmetry, folder=folder)
    with pytest.raises(ValueError, match=r"policy with the observations and actions.*another task"):
        load_actor(folder, other(num_envs=1), other(num_envs=1).symmetry)


def test_an_exported_policy_is_not_trained_further(folder, tmp_path):
    export_actor(folder, tmp_path / "policy")
    with pytest.raises(ValueError, match="exported policy"):
        train(LONGER, MAKE_ENV, SYMMETRY, folder=tmp_path / "policy")
    with pytest.raises(FileNotFoundError, match="expected a checkpoint with"):
        train(LONGER, MAKE_ENV, SYMMETRY, start_from=tmp_path / "policy")


def test_a_misspelt_folder_is_not_created(tmp_path):
    env = MAKE_ENV(num_envs=1)
    for use in (load_actor, lambda folder, *_: export_actor(folder, tmp_path / "target")):
        with pytest.raises(FileNotFoundError, match="train there first"):
            use(tmp_path / "misspelt", env, SYMMETRY)
    assert list(tmp_path.iterdir()) == []


# --- damage -----------------------------------------------------------------------------------------------


def test_every_damaged_checkpoint_is_named_and_kept(folder):
    whole = (folder / "checkpoint.pt").read_bytes()
    generator = np.random.default_rng(0)
    damaged = [whole[:cut] for cut in generator.integers(0, len(whole), 25)]
    for start in generator.integers(0, len(whole) - 200, 25):
        damaged.append(whole[:start] + generator.bytes(200) + whole[start + 200 :])
    damaged += [b"", b"not a checkpoint", whole[::-1]]
    torch.save({"config": 1}, folder / "other.pt")
    torch.save([1, 2], folder / "list.pt")
    damaged += [(folder / name).read_bytes() for name in ("other.pt", "list.pt")]
    named = 0
    for data in damaged:
        (folder / "checkpoint.pt").write_bytes(data)
        before = content(folder)
        try:
            train(LONGER, MAKE_ENV, SYMMETRY, folder=folder).close()
        except ValueError as error:
            assert str(folder / "checkpoint.pt") in str(error) and "restore it from a copy" in str(error)
            named += 1
        assert content(folder) == before
    assert named >= len(damaged) - 10, "bytes of a tensor can be others without a sign of it"


def test_a_lost_checkpoint_never_deletes_a_table(folder):
    (folder / "checkpoint.pt").unlink()
    before = content(folder)
    with pytest.raises(ValueError, match=r"expected a checkpoint beside .*metrics\.csv"):
        train(TINY, MAKE_ENV, SYMMETRY, folder=folder)
    assert content(folder) == before


def edited(lines: list[str], how: str) -> list[str]:
    header, first, second, third = lines
    return {
        "hole": [header, first, third],
        "twice": [header, first, second, second, third],
        "short": [header, first],
        "order": [header, second, first, third],
        "field lost": [header, first, second.rsplit(",", 1)[0], third],
        "no number": [header, first, second.replace(second.split(",")[1], "many"), third],
    }[how]


@pytest.mark.parametrize("how", ["hole", "twice", "short", "order", "field lost", "no number", "lost"])
def test_a_table_that_lacks_something_is_refused_and_kept(folder, how):
    table = folder / "metrics.csv"
    if how == "lost":
        table.unlink()
    else:
        table.write_text("\n".join(edited(table.read_text().splitlines(), how)) + "\n")
    before = content(folder)
    with pytest.raises(ValueError, match=r"expected (rows of the iterations 1 to 3|\d+ numbers in line)"):
        train(LONGER, MAKE_ENV, SYMMETRY, folder=folder)
    assert content(folder) == before


def test_rows_beyond_the_checkpoint_and_half_a_row_are_cut_off(folder):
    table = folder / "metrics.csv"
    whole = table.read_text()
    last = whole.splitlines()[-1].split(",")
    for tail in ("4", ",".join(["4", *last[1:]])[:-1], ",".join(["4", *last[1:]]) + "\n"):
        table.write_text(whole + tail)
        train(TINY, MAKE_ENV, SYMMETRY, folder=folder).close()
        assert table.read_text() == whole


def test_a_new_column_shifts_nothing(tmp_path):
    table = MetricsTable(tmp_path / "metrics.csv")
    table.append({"iteration": 1, "return": -1.5})
    table.append({"iteration": 2, "success": 0.5, "return": -1.0})
    table.append({"return": -0.5, "iteration": 3})
    rows = read_metrics(table.path)
    assert [row["return"] for row in rows] == [-1.5, -1.0, -0.5]
    assert str([row["success"] for row in rows]) == "[nan, 0.5, nan]"
    MetricsTable(table.path).append({"iteration": 4, "level": 2})
    assert (
        str(read_metrics(table.path)[-1]) == "{'iteration': 4, 'return': nan, 'success': nan, 'level': 2}"
    )


FULL = """
import resource, sys, functools, signal
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[2]), int(sys.argv[2])))
import tasks
from torchrl_sym.recipes import PPOConfig, train
make_env = functools.partial(tasks.make_env, "cartpole", num_threads=1)
config = PPOConfig(iterations=4, num_envs=4, horizon=8, epochs=1, minibatches=1)
train(config, make_env, make_env(num_envs=1).symmetry, folder=sys.argv[1]).run()
"""


def test_a_full_disk_keeps_the_last_checkpoint(folder):
    before = (folder / "checkpoint.pt").read_bytes()
    result = Script(FULL, folder, len(before) // 2).wait()
    assert result.returncode != 0 and "File too large" in result.stderr
    assert (folder / "checkpoint.pt").read_bytes() == before
    assert {path.name for path in folder.iterdir()} == {"checkpoint.pt", "metrics.csv", "lock"}
    assert train(LONGER, MAKE_ENV, SYMMETRY, folder=folder).run()["iteration"] == 4


def test_killed_before_the_first_iteration(tmp_path):
    train(TINY, MAKE_ENV, SYMMETRY, folder=tmp_path / "killed").close()
    assert RunFolder(tmp_path / "killed").load()["iteration"] == 0
    with pytest.raises(FileNotFoundError, match="train there first"):
        load_actor(tmp_path / "killed", MAKE_ENV(num_envs=1), SYMMETRY)
    torch.rand(3)  # what others draw, before and after it is prepared, must not matter
    again = train(TINY, MAKE_ENV, SYMMETRY, folder=tmp_path / "killed")
    torch.rand(3)
    rows, whole = list(again), list(train(TINY, MAKE_ENV, SYMMETRY))
    assert [row["mirror_loss"] for row in rows] == [row["mirror_loss"] for row in whole]


def longer_pole(spec):
    """An edit of the model."""
    spec.geom("pole").size = [0.02, 0.3, 0.0]


def test_a_description_is_the_same_in_another_process(tmp_path):
    from torchrl_sym.recipes.checkpoint import _plain

    found = _plain({"edit": longer_pole, "partial": functools.partial(longer_pole), "span": (1, 2.0)})
    assert "0x" not in str(found) and "longer_pole" in found["edit"] and found["span"] == [1, 2.0]
