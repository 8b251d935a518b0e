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


@pytest.mark.parametrize("name", ["constraints", "constraints-mjlab"])
def test_the_hashes_are_of_the_pinned_versions(lock, name):
    pins = lock.pinned((ROOT / f"{name}.txt").read_text())
    assert len(pins) > 50
    hashes = (ROOT / f"{name}-hashes.txt").read_text()
    assert hashes.startswith(lock.header(name))
    assert lock.pinned(hashes) == pins, "run `make lock`"


@pytest.mark.parametrize("name", ["constraints", "constraints-mjlab"])
def test_every_pin_has_a_hash(lock, name):
    text = re.sub(r"\\\n\s*", "", (ROOT / f"{name}-hashes.txt").read_text())
    lines = [line for line in text.splitlines() if not line.startswith("#")]
    assert all(re.fullmatch(r"\S+==[^#]+( --hash=sha256:[0-9a-f]{64})+ ?", line) for line in lines)
    for line in lines:
        if line.startswith("torch=="):
            assert line.count("--hash") >= len(lock.LOCKED[name]), "its wheels are of one Python each"


def test_every_dependency_is_pinned(lock):
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = project["optional-dependencies"]
    parts = [line for part in ("dev", "gpu", "mujoco", "tasks", "train") for line in extras[part]]
    required = [*project["dependencies"], *(line for line in parts if not line.startswith("torchrl_sym["))]
    names = {lock.normalized(re.match(r"[\w.-]+", line)[0]) for line in required}
    pins = {lock.normalized(pin.name) for pin in lock.pinned((ROOT / "constraints.txt").read_text())}
    assert not names - pins


def test_the_tests_of_the_core_exist():
    (names,) = re.findall(r"^CORE := ((?:.*\\\n)*.*)", (ROOT / "Makefile").read_text(), re.MULTILINE)
    names = names.replace("\\", "").split()
    assert len(names) > 20
    assert [name for name in names if not (ROOT / "tests" / f"test_{name}.py").exists()] == []


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
    """Of every Python that a pin is for, once where they share a file, in the order of the constraints."""
    constraints = """# comment
ETILS==1.15.0
torch==2.13.0
dm_control==1.0.50; python_version < "3.12"
numpy==2.2.6; python_version < "3.12"
numpy==2.4.6; python_version >= "3.12"
"""
    monkeypatch.setattr(lock, "ROOT", tmp_path)
    monkeypatch.setattr(lock, "LOCKED", {"few": ("3.11", "3.12")})
    (tmp_path / "few.txt").write_text(constraints)
    shared = {"etils": ("1.15.0", "e")}
    reported = {
        "3.11": {"dm-control": ("1.0.50", "d"), "numpy": ("2.2.6", "n"), "torch": ("2.13.0+cpu", "b")},
        "3.12": {"numpy": ("2.4.6", "m"), "torch": ("2.13.0+cpu", "a")},
    }
    monkeypatch.setattr(lock, "files", lambda requirements, python: shared | reported[python])
    lock.main()
    assert (tmp_path / "few-hashes.txt").read_text() == lock.header("few") + (
        "ETILS==1.15.0 \\\n    --hash=sha256:e\n"
        "torch==2.13.0 \\\n    --hash=sha256:a \\\n    --hash=sha256:b\n"
        'dm_control==1.0.50; python_version < "3.12" \\\n    --hash=sha256:d\n'
        'numpy==2.2.6; python_version < "3.12" \\\n    --hash=sha256:n\n'
        'numpy==2.4.6; python_version >= "3.12" \\\n    --hash=sha256:m\n'
    )
    reported["3.12"]["torch"] = ("2.13.0", "c")
    with pytest.raises(
        SystemExit, match=r"CPU build of torch for Python 3.12, got 2.13.0; export PIP_EXTRA"
    ):
        lock.main()


def test_pip_is_asked_for_what_one_python_takes(lock, monkeypatch):
    """pip itself evaluates markers for the Python on which it runs."""
    asked = []

    def run(command, **kwargs):
        asked.extend(part for part in command if "==" in part)
        Path(command[command.index("--report") + 1]).write_text('{"install": []}')

    monkeypatch.setattr(lock.subprocess, "run", run)
    pins = lock.pinned("a==1; python_version < '3.11'\nb==2; python_version >= '3.11'\nc==3\n")
    lock.files(pins, "3.10")
    assert asked == ["a==1", "c==3"]
