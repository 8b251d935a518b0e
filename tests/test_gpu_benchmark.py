"""The benchmark of a GPU, run tiny on the CPU, and what it says of its targets."""

import csv
import json

import pytest

from tests.test_scripts import run

pytest.importorskip("mujoco_warp", reason="the second engine is an extra: pip install 'torchrl_sym[gpu]'")

import gpu


@pytest.mark.slow
def test_it_runs_where_there_is_no_card(tmp_path):
    output = run("benchmarks/gpu.py", "--device", "cpu", "--out", tmp_path, "--seconds", "0.5")
    assert "CartPole's run of the comparison" in output
    results = json.loads((tmp_path / "gpu.json").read_text())
    assert list(results["tables"]) == list(gpu.PARTS) and results["card"] == "no card"
    assert results["tables"]["parity"][0]["qpos"] < 1e-6
    assert [row["task"] for row in results["tables"]["trainings"]] == ["anymal_push"] * 2 + ["cartpole"]
    with (tmp_path / "curves.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["method"] for row in rows} == {"aug", "equivariant"} and float(rows[0]["kl"]) >= 0
    assert "## Targets" not in (tmp_path / "gpu.md").read_text(), "they are a card's"


def test_targets_say_what_is_met():
    tables = {
        "parity": [{"task": "cartpole", "qpos": 1e-6, "qvel": 2e-3}],
        "waits": [{"what": "env.step", "waits": 0}, {"what": "a reset", "waits": 2}],
        "rates": [{"task": "cartpole", "worlds": n, "share": 0.85} for n in (1024, 4096)],
        "updates": [{"method": m, "who": "compiled", "step_ms": 1.5} for m in ("ppo", "aug")],
        "trainings": [
            {"task": "anymal_push", "method": "aug", "frames_per_second": 2e5},
            {"task": "cartpole", "method": "aug", "seconds": 14.0},
        ],
    }
    found = {name: (value, met) for name, value, met in gpu.targets(tables)}
    assert list(found.values()) == [
        (2e-3, False), (0, True), (2, False), (0.85, True), (1.5, True), (2e5, False), (14.0, True),
    ]  # fmt: skip
    assert list(gpu.targets({})) == []
    results = {"tables": tables, "device": "cuda", "card": "H", "machine": "m", "revision": "r"}
    assert "**not met**" in gpu.page(results | {"versions": {"torch": "2"}})
