"""Every script runs with tiny settings, and so does the code in the README."""

import ast
import json
import re
from pathlib import Path

import pytest
import tyro
from PIL import Image

import results_page
import speed
from comparison import study
from comparison.tables import tables
from tasks.settings import SETTINGS
from tests.launch import Script
from torchrl_sym.recipes import RunFolder

ROOT = Path(__file__).parents[1]
TINY = ["--config.iterations", "2", "--config.num-envs", "8", "--config.horizon", "8"]


def run(script: str, *arguments: str) -> str:
    """Output of a script, which must succeed."""
    result = Script(ROOT / script, *arguments).wait()
    assert result.returncode == 0, result.stderr[-3000:]
    return result.stdout


def test_all_examples_are_run():
    """Most of them here; one needs another MuJoCo, with which this file cannot be imported."""
    source = "".join(path.read_text() for path in Path(__file__).parent.glob("test_*.py"))
    missing = [
        path.name for path in (ROOT / "examples").glob("*.py") if f"examples/{path.name}" not in source
    ]
    assert not missing


def test_scripts_begin_with_nothing_of_ours(tmp_path):
    """They run in forks of one server, and must find their own way to what they import."""
    text = (
        "import os, sys\nprint(sys.argv[1:], os.getcwd())\nprint({m.split('.')[0] for m in sys.modules})\n"
    )
    ended = Script(text + "sys.exit(3)", "a", folder=tmp_path).wait()
    assert ended.returncode == 3
    where, loaded = ended.stdout.splitlines()
    assert where == f"['a'] {tmp_path.resolve()}"
    assert "torch" in loaded
    assert not {"torchrl_sym", "tasks", "comparison"} & ast.literal_eval(loaded)


def test_augment_batch():
    assert "64 samples become 256" in run("examples/augment_batch.py")


def test_mirror_loss_falls():
    losses = [float(x) for x in re.findall(r"mirror ([\d.]+)", run("examples/mirror_loss.py", "40"))]
    assert losses[-1] < 0.5 * losses[0]


def test_symmetric_ppo():
    assert "iteration 1" in run("examples/symmetric_ppo.py", "2")


@pytest.mark.slow
def test_ray_collectors():
    assert "iteration 1" in run("examples/ray_collectors.py", "2", "1")


def test_memory():
    tiny = ["--seeds", "1", "--iterations", "2", "--num-envs", "4", "--steps", "5"]
    output = run("examples/memory.py", *tiny)
    assert re.search(r"recurrent, seed 0: return -\d.*of mirror images", output)
    assert re.search(r"with memory -\d[\d.]*, without -\d", output)


def test_rsl_rl_trains_with_a_symmetry_from_a_file():
    pytest.importorskip("rsl_rl", reason="pip install rsl-rl-lib")
    output = run("examples/rsl_rl_ppo.py", "--iterations", "2", "--num-envs", "8")
    assert '"reflect-x": "-0..2"' in output
    assert re.search(r"after 2 iterations: mirror error [\d.]+ of the mean action", output)


@pytest.mark.parametrize("script", ["examples/sac.py", "examples/td3.py"])
def test_off_policy_examples(script):
    output = run(script, "250")
    assert re.search(r"250 steps: return of the last episodes -?[\d.]+, mirror error [\d.]+\n$", output)


def test_own_environment_tells_right_from_wrong():
    output = run("examples/own_environment.py")
    assert "the model's symmetry is exact" in output
    assert "symmetric: 16 states" in output
    assert re.search(r"one sign wrong: kinematics .* FAILED +position\[2\]", output)


def test_train_and_continue(tmp_path):
    few = ["--episodes", "4"]
    first = run("examples/train.py", "cartpole", "--folder", tmp_path, *TINY, *few)
    assert re.search(r"mean return -\d", first)
    run("examples/train.py", "cartpole", "--folder", tmp_path, *TINY[2:], "--config.iterations", "3", *few)
    assert len((tmp_path / "stage_0" / "metrics.csv").read_text().splitlines()) == 4
    film = tmp_path / "policy.gif"
    watch = ["--checkpoint", tmp_path, "--stochastic", "--seconds", "0.1", "--width", "64", "--out", film]
    run("examples/watch.py", "cartpole", *watch)
    assert film.exists()


def test_settings_of_several_stages_are_trained_in_order(tmp_path):
    few = ["--episodes", "1", "--config.gamma", "0.9"]
    changed = ["--task-kwargs", "episode_seconds", "0.5", "yaw", "9.0"]
    with pytest.raises(AssertionError, match="yaw: expected"):
        run("examples/train.py", "trifinger_repose", "--folder", tmp_path, *TINY, *few, *changed)
    few += changed[:3]
    output = run("examples/train.py", "trifinger_repose", "--folder", tmp_path, *TINY, *few)
    assert re.search(r"difficulty 1: mean return -?\d[^\n]*\n  right .*success", output)
    configs = [RunFolder(tmp_path / f"stage_{number}").load()["config"] for number in (0, 1)]
    assert [config["gamma"] for config in configs] == [0.9, 0.9]
    assert [config["std_schedule"] for config in configs] == [None, (0.1, 0.1)]
    watch = ["--checkpoint", tmp_path, "--task-kwargs", "yaw", "3.0", "--seconds", "0.1", "--width", "64"]
    run("examples/watch.py", "trifinger_repose", *watch, "--out", tmp_path / "watch.gif")
    with pytest.raises(AssertionError, match="yaw: expected"):
        run("examples/watch.py", "trifinger_repose", *watch[:4], "9.0", "--out", tmp_path / "watch.gif")


def test_quickstart_prints_the_table_and_draws_the_picture(tmp_path):
    picture = tmp_path / "curves.png"
    settings = ["--seeds", "1", "--iterations", "2", "--episodes", "4", "--workers", "2"]
    settings += ["--folder", tmp_path, "--picture", picture]
    output = run("examples/quickstart.py", *settings)
    assert "| PPO + augmentation | mean |" in output
    assert output.index("What you saw") < output.index("What to do next")
    assert "[torchrl]" not in output
    assert picture.stat().st_size > 10_000
    refused = pytest.raises(AssertionError, match="expected a folder that nobody trains in")
    with RunFolder(tmp_path), refused:
        run("examples/quickstart.py", *settings)


@pytest.mark.parametrize("suffix", ["png", "gif"])
def test_watch_draws_every_goal(tmp_path, suffix):
    picture = tmp_path / f"watch.{suffix}"
    settings = ["--seconds", "0.1", "--width", "64", "--frames", "2", "--out", picture]
    assert "right, left" in run("examples/watch.py", "cartpole", *settings)
    with Image.open(picture) as image:
        assert image.size == ((128, 96) if suffix == "png" else (128, 48))
        assert getattr(image, "n_frames", 1) == (1 if suffix == "png" else 3)


def test_watch_draws_paths_from_above(tmp_path):
    picture = tmp_path / "paths.png"
    settings = ["--goals", "front left", "back right", "--seconds", "0.1", "--overlay", "--out", picture]
    assert "front left, back right" in run("examples/watch.py", "anymal_push", *settings)
    assert picture.stat().st_size > 10_000


def test_the_page_about_the_tasks_is_what_the_code_says(tmp_path):
    run("benchmarks/tasks_page.py", "--out", tmp_path / "tasks.md")
    written, docs = (tmp_path / "tasks.md").read_text(), ROOT / "docs"
    assert written == (docs / "tasks.md").read_text(), "run python benchmarks/tasks_page.py"
    pictures = re.findall(r"!\[.*?\]\((.*?)\)", written)
    assert [picture for picture in pictures if not (docs / picture).exists()] == []


def test_figures_and_pages_follow_from_the_stored_results(tmp_path):
    advice = "run python benchmarks/plot.py and benchmarks/results_page.py"
    run("benchmarks/plot.py", "paper-cartpole-20", "--plots", tmp_path / "plots")
    drawn, stored = tmp_path / "plots/paper-cartpole-20", ROOT / "benchmarks/plots/paper-cartpole-20"
    assert (drawn / "tables.md").read_text() == (stored / "tables.md").read_text(), advice
    assert {path.name for path in drawn.iterdir()} == {path.name for path in stored.iterdir()}
    for name in results_page.ROBOTS:
        text = tables(study.read(ROOT / "benchmarks/results" / name))
        assert (ROOT / "benchmarks/plots" / name / "tables.md").read_text() == text, advice
    readme = tmp_path / "README.md"
    readme.write_text(re.sub(r"(?<=-->\n)\|?[^<]*(?=<!-- end)", "", (ROOT / "README.md").read_text()))
    run("benchmarks/results_page.py", "--docs", tmp_path, "--readme", readme)
    assert (tmp_path / "results.md").read_text() == (ROOT / "docs/results.md").read_text(), advice
    assert readme.read_text() == (ROOT / "README.md").read_text(), advice


@pytest.mark.parametrize(
    ("name", "task", "kind"),
    [("paper-push", "anymal_push", "touches"), ("paper-climb", "anymal_climb", "heights")],
)
def test_what_policies_do_is_drawn_from_the_stored_ones(tmp_path, name, task, kind):
    short = ["--episodes", "1", "--touching", "1", "--seconds", "0.1"]
    run("benchmarks/behaviour.py", name, "--plots", tmp_path, *short)
    drawn = {path.name for path in (tmp_path / name).iterdir()}
    assert drawn == {f"{task}_{what}.png" for what in ("paths", kind, "frames")}


@pytest.mark.slow
def test_speed_writes_its_figures(tmp_path, monkeypatch):
    small = SETTINGS["cartpole"].replace(num_envs=8, horizon=8)  # otherwise it trains whole iterations
    monkeypatch.setitem(SETTINGS, "cartpole", small)
    figures = tmp_path / "speed.json"
    tiny = ["--tasks", "cartpole", "--rounds", "1", "--settle", "1", "--num-envs", "8", "--rows", "32"]
    speed.main(tyro.cli(speed.Arguments, args=[*tiny, "--output", str(figures)]))
    results = json.loads(figures.read_text())
    assert results["env"][0]["env_over_raw"] > 0
    assert {row["order"] for row in results["loss"]} == {1, 2, 4}
    assert {row["elements"] for row in results["augment"]} == {"all", "random"}
    assert {"1000 boxes", "64 cubes", "cartpole"} <= {row["model"] for row in results["audit"]}
    assert {row["augmentation"] for row in results["iteration"]} == {"none", "all"}


@pytest.mark.parametrize("number", range(3))
def test_code_in_the_readme(number):
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), flags=re.DOTALL)
    assert len(blocks) == 3
    exec(compile(blocks[number], "README.md", "exec"), {})
