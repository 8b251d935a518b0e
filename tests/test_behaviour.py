"""benchmarks/behaviour.py: whose modules it imports, and what it refuses to draw."""

import dataclasses
import json
import shutil
from pathlib import Path

import pytest

import behaviour
import seal
from comparison.files import write_json

RESULTS = Path(__file__).parents[1] / "benchmarks" / "results"


def test_a_module_that_only_results_name_is_not_imported(tmp_path, monkeypatch):
    shutil.copytree(RESULTS / "paper-repose-yaw", tmp_path / "theirs")
    for name in ("study.json", "runs.csv", "curves.csv"):
        path = tmp_path / "theirs" / name
        path.write_text(path.read_text().replace("repose_yaw:make_env", "evil:make_env"))
    about = json.loads((tmp_path / "theirs/study.json").read_text())
    write_json(tmp_path / "theirs/study.json", {k: v for k, v in about.items() if k != "tables"})
    seal.seal(tmp_path / "theirs")
    (tmp_path / "evil.py").write_text("raise RuntimeError('imported')")
    monkeypatch.chdir(tmp_path)
    asked = behaviour.Arguments("theirs", results=tmp_path, plots=tmp_path / "plots", seconds=0.1)
    with pytest.raises(
        ValueError, match=r"got \['evil:make_env'\], whose modules .* add --tasks evil:make_env"
    ):
        behaviour.main(asked)
    (tmp_path / "theirs/policies/repose_yaw.make_env").rename(tmp_path / "theirs/policies/evil.make_env")
    with pytest.raises(RuntimeError, match="imported"):
        behaviour.main(dataclasses.replace(asked, tasks=("evil:make_env",)))


@pytest.mark.parametrize(
    ("changes", "complaint"),
    [
        ({"episodes": 0}, "expected --episodes of at least 1"),
        ({"touching": -1}, "expected --touching of at least 1"),
        ({"methods": ("ppo", "ppo")}, "expected different --methods"),
        ({"methods": ("ppo", "loss-7")}, r"expected --methods of paper-push, .*, got \['loss-7'\]"),
        ({"methods": ("../ppo",)}, "expected a method made of"),
        ({"name": "paper"}, "expected policies in"),
    ],
)
def test_pictures_that_cannot_be_drawn_are_refused(tmp_path, changes, complaint):
    asked = behaviour.Arguments(**{"plots": tmp_path / "plots"} | changes)
    with pytest.raises((ValueError, SystemExit), match=complaint):
        behaviour.main(asked)
    assert not (tmp_path / "plots").exists()
