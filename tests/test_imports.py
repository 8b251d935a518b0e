"""The core stands beside anything: each part is imported with nothing installed but what its extra brings.

What `make build` does with the wheel in clean environments is done here with the sources in fresh
interpreters, from which all other packages are hidden.
"""

import re
import subprocess
import sys
from collections.abc import Set
from importlib.metadata import PackageNotFoundError, packages_distributions, requires
from pathlib import Path

import numpy
import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

try:
    import tomllib
except ModuleNotFoundError:  # Python 3.10, where pytest brings its twin
    import tomli as tomllib

ROOT = Path(__file__).parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
CORE, EXTRAS = PROJECT["dependencies"], PROJECT["optional-dependencies"]
HIDE = """
import sys
class Without:
    def __init__(self, finder): self.finder = finder
    def find_spec(self, name, path=None, target=None):
        hidden = name.partition(".")[0] in {hidden!r}
        return None if hidden else self.finder.find_spec(name, path, target)
    def __getattr__(self, name): return getattr(self.finder, name)
sys.meta_path[:] = map(Without, sys.meta_path)
sys.path[:0] = [{root!r}, {root!r} + "/tests"]
"""


def closure(requirements: list[str]) -> set[str]:
    """Names of the distributions that these requirements bring, as far as they are installed here."""
    found: set[str] = set()
    waiting = [Requirement(line) for line in requirements]
    while waiting:
        requirement = waiting.pop()
        extras = [{"extra": extra} for extra in ("", *requirement.extras)]
        name = canonicalize_name(requirement.name)
        if name in found:
            continue
        found.add(name)
        try:
            needed = [Requirement(line) for line in requires(name) or []]
        except PackageNotFoundError:
            continue
        waiting += [r for r in needed if not r.marker or any(map(r.marker.evaluate, extras))]
    return found


def run(code: str, requirements: list[str], hidden: Set[str] = frozenset()):
    """Code in an interpreter that sees nothing but the standard library, us, and what these bring."""
    brought = closure(requirements)
    others = {
        module
        for module, names in packages_distributions().items()
        if not {canonicalize_name(name) for name in names} & brought
    }
    prelude = HIDE.format(hidden=(others - {"torchrl_sym", "tasks"}) | hidden, root=str(ROOT))
    return subprocess.run([sys.executable, "-c", prelude + code], capture_output=True, text=True, cwd=ROOT)


def test_the_core_alone():
    ran = run("import smoke_wheel\nsmoke_wheel.check_parts('core')\nsmoke_wheel.use_core()", CORE)
    assert ran.returncode == 0, ran.stderr


def test_mujoco_alone_and_its_command_without_tyro():
    pytest.importorskip("mujoco")
    code = """
import runpy, smoke_wheel
smoke_wheel.check_parts("mujoco")
smoke_wheel.use_mujoco()
runpy.run_module("torchrl_sym.mujoco", run_name="__main__")
"""
    ran = run(code, CORE + EXTRAS["mujoco"], hidden={"tyro"})
    assert ran.stderr == (
        "python -m torchrl_sym.mujoco needs tyro, which is not installed: "
        "pip install 'torchrl_sym[mujoco]'\n"
    )
    assert ran.returncode == 1


def test_loggers_films_and_dm_control_name_theirs():
    pytest.importorskip("torchrl_sym.recipes", exc_type=ImportError)
    pytest.importorskip("tasks.rendering", exc_type=ImportError)
    code = """
import tasks
from torchrl_sym.recipes.storage import require_logger
from tasks.rendering import save
import numpy as np
for act in (
    lambda: require_logger("tensorboard"),
    lambda: require_logger("wandb"),
    lambda: tasks.load("cartpole"),
    lambda: save("a.mp4", [np.zeros((2, 2, 3), np.uint8)] * 2),
):
    try:
        act()
    except ImportError as error:
        print(error)
"""
    ran = run(code, CORE + EXTRAS["tasks"] + EXTRAS["train"], hidden={"dm_control"})
    named = re.findall(r"torchrl_sym\[(\w+)\]", ran.stdout)
    assert named == ["tensorboard", "wandb", "tasks", "video"], ran.stderr


def test_too_old_is_refused_as_missing_is(monkeypatch):
    from torchrl_sym.extras import require

    monkeypatch.setattr(numpy, "__version__", "1.9.10")
    require("this", "one", {"numpy": "1.9.9"})
    message = r"this needs numpy 1.10 or newer, got 1.9.10: pip install 'torchrl_sym\[one\]'; or that"
    with pytest.raises(ImportError, match=message):
        require("this", "one", {"numpy": "1.10"}, "or that")


def test_a_broken_package_raises_its_own_error(tmp_path, monkeypatch):
    from torchrl_sym.extras import require

    (tmp_path / "broken.py").write_text("import nothing_of_the_kind")
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(ModuleNotFoundError, match="nothing_of_the_kind"):
        require("this", "one", {"broken": ""})


@pytest.mark.parametrize(
    ("file", "extra"), [("torchrl_sym/mujoco/__init__.py", "mujoco"), ("tasks/__init__.py", "tasks")]
)
def test_the_oldest_mujoco_is_the_one_that_is_declared(file, extra):
    (asked,) = re.findall(r'"mujoco": "([\d.]+)"', (ROOT / file).read_text())
    (declared,) = [line for line in EXTRAS[extra] if line.startswith("mujoco")]
    assert f">={asked}," in declared
