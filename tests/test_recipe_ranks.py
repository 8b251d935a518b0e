"""Several processes share a training: together they do what one does, and continue exactly."""

import itertools
import math
import socket
import time

import pytest
import torch

from tests import sharing
from tests.launch import ROOT, Script
from torchrl_sym.recipes import RunFolder, read_metrics, train
from torchrl_sym.recipes.ranks import Ranks
from torchrl_sym.recipes.table import TIMING

SYMMETRY = sharing.MAKE_ENV(num_envs=1, seed=0).symmetry
attempts = itertools.count()


def start(job, folder):
    """A job of `tests/sharing.py`, in two processes."""
    store = f"store_{next(attempts)}"
    return [Script(ROOT / "tests" / "sharing.py", job, store, rank, 2, folder) for rank in range(2)]


def finish(scripts):
    for script in scripts:
        done = script.wait(60)
        assert done.returncode == 0, done.stderr


def without_times(rows):
    return [{key: str(value) for key, value in row.items() if key not in TIMING} for row in rows]


@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    """The folder of the job "whole", what its processes have found, and what one has."""
    folder = tmp_path_factory.mktemp("shared")
    env = sharing.MAKE_ENV(num_envs=8, seed=0)
    with torch.no_grad():
        actor = sharing.make_networks(sharing.CONFIG, env, SYMMETRY)[0]
        torch.save(env.rollout(sharing.CONFIG.horizon, actor), folder / "data.pt")
    train(sharing.SHORT, sharing.MAKE_ENV, SYMMETRY, folder=folder / "alone").run()
    processes = start("whole", folder)
    with pytest.MonkeyPatch.context() as patch:
        for name in ("sample", "rsample"):  # which the curve replaces
            patch.setattr(sharing.IndependentNormal, name, getattr(sharing.IndependentNormal, name))
        alone = {"updates": sharing.updates(folder), "curve": sharing.curve()}
    finish(processes)
    found = [torch.load(folder / f"found_{rank}.pt", weights_only=False) for rank in range(2)]
    return folder, *found, alone


def test_gradients_and_reports_are_those_of_one_process(shared):
    first, second, alone = (found["updates"] for found in shared[1:])
    assert torch.equal(first["gradients"], second["gradients"])
    assert first["report"] == second["report"]
    assert alone["gradients"][0].norm() > 0.1
    torch.testing.assert_close(first["gradients"][0], alone["gradients"][0], rtol=0, atol=1e-6)
    # later ones are those of parameters that Adam's steps have moved a little further apart
    torch.testing.assert_close(first["gradients"], alone["gradients"], rtol=0, atol=1e-4)
    for name in ("loss_objective", "loss_critic", "loss_entropy", "kl", "gradient_norm", "learning_rate"):
        assert first["report"][name] == pytest.approx(alone["report"][name], rel=1e-4, abs=1e-6), name


def test_the_curve_is_that_of_one_process(shared):
    first, second, alone = (found["curve"] for found in shared[1:])
    assert without_times(first) == without_times(second)
    own = {"ESS", "max_ratio", "explained_variance"}  # not linear in the rows, of which a process has half
    for mine, other in zip(first, alone, strict=True):
        for name in mine.keys() - own - set(TIMING):
            assert mine[name] == pytest.approx(other[name], rel=1e-3, abs=1e-4), (name, mine["iteration"])
    assert all(math.isfinite(row["return"]) for row in first)
    assert len({row["learning_rate"] for row in first}) > 1


def test_a_run_goes_on_exactly_after_a_process_was_killed(shared):
    folder = shared[0]
    processes = start("killed", folder)
    table = folder / "killed" / "metrics.csv"
    while not table.exists() or len(table.read_text().splitlines()) < 6:
        assert all(script.process.is_alive() for script in processes)
        time.sleep(0.001)
    processes[1].kill()
    processes[0].process.join(5)  # it finds nobody to exchange gradients with
    processes[0].kill()
    assert len(read_metrics(table)) < sharing.SHORT.iterations
    finish(start("killed", folder))

    whole, killed = (RunFolder(folder / name) for name in ("whole", "killed"))
    assert without_times(read_metrics(table)) == without_times(read_metrics(whole.table.path))
    a, b = whole.load(), killed.load()
    assert str(a["parts"]) == str(b["parts"]) and str(a["others"]) == str(b["others"])
    (other,) = a["others"]
    for name in ("rng", "env"):  # a process has random numbers of its own
        assert str(other[name]) == str(b["others"][0][name]) != str(a[name])


def test_another_number_of_processes_is_refused(shared):
    folder, *found, _ = shared
    for arguments in ({"folder": folder / "whole"}, {"start_from": folder / "whole"}):
        with pytest.raises(ValueError, match=r"expected as many processes .* 2, .*--nproc-per-node=2"):
            train(sharing.SHORT, sharing.MAKE_ENV, SYMMETRY, **arguments)
    assert "others" not in RunFolder(folder / "alone").load()
    for each in found:  # not only in the process that reads the checkpoint
        assert "--nproc-per-node=1" in each["refusal"]


def test_what_cannot_be_shared_is_refused(monkeypatch):
    monkeypatch.setattr(Ranks, "__init__", lambda self: vars(self).update(count=3, index=1))
    with pytest.raises(ValueError, match=r"num_envs: expected a multiple of the 3 processes.*, got 8"):
        train(sharing.SHORT, sharing.MAKE_ENV, SYMMETRY)


def test_no_two_environments_have_one_seed():
    ranks, seeds = Ranks(), set()
    for ranks.index in range(8):
        seeds |= {ranks.seed(seed) for seed in range(32)}
    assert len(seeds) == 8 * 32
    ranks.index = 0
    assert [ranks.seed(seed) for seed in range(3)] == [0, 1, 2]
    assert max(seeds) < 2**63


EXAMPLE = """
import os, runpy, sys
os.environ |= dict(RANK=sys.argv[1], LOCAL_RANK=sys.argv[1], WORLD_SIZE="2", MASTER_ADDR="127.0.0.1")
os.environ["MASTER_PORT"] = sys.argv[2]
sys.argv[:] = sys.argv[3:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""


def test_the_example_shares_what_torchrun_starts(tmp_path):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    small = {"iterations": 2, "num_envs": 8, "horizon": 8, "epochs": 1, "minibatches": 2}
    options = [text for name, value in small.items() for text in (f"--config.{name}", str(value))]
    command = [
        ROOT / "examples" / "train.py",
        "cartpole",
        "--folder",
        tmp_path,
        "--episodes",
        "2",
        *options,
    ]
    processes = [Script(EXAMPLE, rank, port, *command) for rank in range(2)]
    finish(processes)
    outputs = [script.output()[0] for script in processes]
    assert "mean return" in outputs[0] and "mean return" not in outputs[1]
    (checkpoint,) = tmp_path.rglob("checkpoint.pt")
    assert len(torch.load(checkpoint, weights_only=True)["others"]) == 1
