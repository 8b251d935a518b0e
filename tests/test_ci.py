"""What the CI installs and runs is named by its hash, and is what constraints.txt pins."""

import importlib.util
import re
from pathlib import Path

import pytest
import tomllib

ROOT = Path(__file__).parent.parent
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.y*ml"))


@pytest.fixture(scope="module")
def lock():
    spec = importlib.util.spec_from_file_location("lock", ROOT / ".ci" / "lock.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_hashes_are_of_the_pinned_versions(lock):
    pins = lock.pinned(lock.CONSTRAINTS.read_text())
    assert len(pins) > 50
    hashes = lock.HASHES.read_text()
    assert hashes.startswith(lock.HEADER)
    assert lock.pinned(hashes) == pins, "run `make lock`"


def test_every_pin_has_a_hash(lock):
    text = re.sub(r"\\\n\s*", "", lock.HASHES.read_text())
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    assert all(re.fullmatch(r"\S+==\S+( --hash=sha256:[0-9a-f]{64})+ ?", line) for line in lines)
    (torch,) = [line for line in lines if line.startswith("torch==")]
    assert torch.count("--hash") == len(lock.PYTHONS), "its wheels are of one Python each"


def test_every_dependency_is_pinned(lock):
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    required = [*project["dependencies"], *project["optional-dependencies"]["dev"]]
    names = {lock.normalized(re.match(r"[\w.-]+", line)[0]) for line in required}
    pins = {lock.normalized(name) for name in lock.pinned((ROOT / "constraints.txt").read_text())}
    assert not names - pins


def test_actions_are_named_by_their_commit():
    used = [
        line.strip()
        for path in WORKFLOWS
        for line in path.read_text().splitlines()
        if re.match(r"\s*(- )?uses:", line)
    ]
    assert used
    named = r"(- )?uses: [\w.-]+/[\w./-]+@[0-9a-f]{40} # v\d+(\.\d+)*"
    assert [line for line in used if not re.fullmatch(named, line)] == []


def test_the_ci_installs_from_nothing_but_verified_files():
    steps = [line for path in WORKFLOWS for line in path.read_text().splitlines()]
    (download,) = [number for number, line in enumerate(steps) if "pip download" in line]
    assert "--require-hashes" in steps[download]
    assert not any("pip install" in line for line in steps)
    first = min(number for number, line in enumerate(steps) if "run: make" in line)
    offline = [number for number, line in enumerate(steps) if "PIP_NO_INDEX=1" in line]
    assert len(offline) == 1 and download < offline[0] < first


def test_the_lock_holds_what_pip_reports(lock, tmp_path, monkeypatch):
    """Of both Pythons, once where they share a file, in the order of the constraints."""
    constraints = "# comment\nETILS==1.15.0\ntorch==2.13.0\ndm_control==1.0.50\n"
    monkeypatch.setattr(lock, "CONSTRAINTS", tmp_path / "constraints.txt")
    monkeypatch.setattr(lock, "HASHES", tmp_path / "hashes.txt")
    lock.CONSTRAINTS.write_text(constraints)
    shared = {"etils": ("1.15.0", "e"), "dm-control": ("1.0.50", "d")}
    builds = {"3.11": ("2.13.0+cpu", "b"), "3.12": ("2.13.0+cpu", "a")}
    monkeypatch.setattr(lock, "files", lambda python: {**shared, "torch": builds[python]})
    lock.main()
    assert lock.HASHES.read_text() == lock.HEADER + (
        "ETILS==1.15.0 \\\n    --hash=sha256:e\n"
        "torch==2.13.0 \\\n    --hash=sha256:a \\\n    --hash=sha256:b\n"
        "dm_control==1.0.50 \\\n    --hash=sha256:d\n"
    )
    builds["3.12"] = ("2.13.0", "c")
    with pytest.raises(
        SystemExit, match=r"CPU build of torch for Python 3.12, got 2.13.0; export PIP_EXTRA"
    ):
        lock.main()
