"""The rules of the source tree: imports go one way, files stay short, the public surface is listed.

Each rule is a function from a tree of files to a list of complaints. The rules run on this
repository, and once each on a small bad tree, to prove that they can fail.
"""

import ast
import graphlib
import importlib
import inspect
import re
import shutil
import subprocess
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
MAX_LINES = 400

# Reading order is dependency order. A module imports from its own layer (without cycles) and from
# the layers above it in this list. `__init__` collects them all, so none of them imports it.
LAYERS = (
    "checks extras _torchrl",
    "groups",
    "representations",
    "entries normalization segments",
    "declaration files printing",
    "environments",
    "symmetry",
    "orbits memory networks outputs",
    "augment transforms replay mirror_loss symmetric_ppo modules vecnorm mujoco testing",
    "bridges",
    "recipes",
    "__init__",
)

# The same for the rooms of torchrl_sym.mujoco, one per verb.
ROOMS = ("model", "derive", "audit symmetrize verify", "symmetries infer", "__init__ __main__")

# Top-level packages that the files of a folder must not import.
FORBIDDEN = {
    "torchrl_sym": {"tasks", "benchmarks", "comparison", "examples", "tests"},
    "tasks": {"benchmarks", "comparison", "examples", "tests"},
    "examples": {"benchmarks", "comparison", "examples", "tests"},
}

# Absolute paths of somebody's machine; the lookbehind leaves URLs and relative paths alone.
MACHINE_PATH = re.compile(r"(?<![\w.-])/(?:tmp|home|root|opt|work|Users)/")


def python_files(root: Path, *folders: str) -> Iterator[Path]:
    for folder in folders:
        yield from sorted((root / folder).rglob("*.py"))


def imported_names(path: Path, root: Path) -> Iterator[str]:
    """Absolute dotted names a file imports anywhere; `from a import b` gives `a.b`."""
    package = path.relative_to(root).parent.parts
    for node in ast.walk(ast.parse(path.read_text(), filename=str(path))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) + 1 - node.level] if node.level else ()
            base = ".".join((*above, *filter(None, [node.module])))
            yield from (f"{base}.{alias.name}" for alias in node.names)


def library_imports(root: Path, inside: tuple[str, ...] = ()) -> dict[str, set[str]]:
    """Module of torchrl_sym (or of a package inside) -> others there it imports; a subpackage is one."""
    above = ("torchrl_sym", *inside)
    folder = root.joinpath(*above)
    modules = {path.stem for path in folder.iterdir() if path.suffix == ".py" or path.is_dir()}
    modules.discard("__pycache__")
    graph: dict[str, set[str]] = {}
    for path in python_files(folder, "."):
        module = Path(path.relative_to(folder).parts[0]).stem
        graph.setdefault(module, set())
        for name in imported_names(path, root):
            parts = tuple(name.split("."))
            if parts[: len(above)] == above:
                rest = parts[len(above) :]
                target = rest[0] if rest and rest[0] in modules else "__init__"
                graph[module] |= {target} - {module}
    return graph


def wrong_layers(root: Path, layers: tuple[str, ...] = LAYERS, inside: tuple[str, ...] = ()) -> list[str]:
    graph, above = library_imports(root, inside), ".".join(("torchrl_sym", *inside))
    rank = {module: number for number, layer in enumerate(layers) for module in layer.split()}
    complaints = [
        f"{above}.{module} has no layer: add it to LAYERS or ROOMS in tests/test_layout.py"
        for module in graph
        if module not in rank
    ]
    complaints += [
        f"{above}.{module} imports {above}.{target}, which comes after it"
        for module, targets in graph.items()
        for target in sorted(targets)
        if rank.get(target, 0) > rank.get(module, len(LAYERS))
    ]
    try:
        graphlib.TopologicalSorter(graph).prepare()
    except graphlib.CycleError as error:
        complaints.append(f"cycle in {above}: {' <- '.join(error.args[1])}")
    return complaints


def wrong_rooms(root: Path) -> list[str]:
    return wrong_layers(root, ROOMS, ("mujoco",)) if (root / "torchrl_sym" / "mujoco").is_dir() else []


def forbidden_imports(root: Path) -> list[str]:
    return [
        f"{path.relative_to(root)} imports {name}"
        for folder, forbidden in FORBIDDEN.items()
        for path in python_files(root, folder)
        for name in imported_names(path, root)
        if name.split(".")[0] in forbidden
    ]


def long_files(root: Path) -> list[str]:
    lengths = {
        path: len(path.read_text().splitlines())
        for path in python_files(root, "torchrl_sym", "tasks", "examples", "benchmarks", "tests")
    }
    return [
        f"{path.relative_to(root)} has {length} lines, at most {MAX_LINES} are allowed: split it"
        for path, length in lengths.items()
        if length > MAX_LINES
    ]


def prints(root: Path) -> list[str]:
    return [
        f"{path.relative_to(root)}:{node.lineno} prints; return, raise or log instead"
        for path in python_files(root, "torchrl_sym", "tasks")
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id == "print"
    ]


def machine_paths(root: Path, files: Iterable[str]) -> list[str]:
    complaints = []
    for name in files:
        path = root / name
        try:
            lines = path.read_text().splitlines()
        except (UnicodeDecodeError, FileNotFoundError, IsADirectoryError):
            continue  # a picture, or a file deleted and not yet committed
        complaints += [
            f"{name}:{number} names a path of one machine: {line.strip()[:80]}"
            for number, line in enumerate(lines, start=1)
            if MACHINE_PATH.search(line)
        ]
    return complaints


def sort_key(name: str) -> tuple[int, str]:
    """The order ruff keeps (RUF022): CONSTANTS, Classes, then everything else."""
    return (0 if name.isupper() and len(name) > 1 else 1 if name[0].isupper() else 2, name)


def unlisted_names(package_name: str) -> list[str]:
    """What `__all__` has too much or too little, compared with what the package itself defines."""
    package = importlib.import_module(package_name)
    listed = list(package.__all__)
    complaints = [
        f"{package_name}.__all__ lists {name!r}, which does not exist"
        for name in listed
        if not hasattr(package, name)
    ]
    if listed != sorted(set(listed), key=sort_key):
        complaints.append(f"{package_name}.__all__ is not sorted, or lists a name twice: {listed}")
    own = {
        name
        for name, value in vars(package).items()
        if not name.startswith("_")
        and not inspect.ismodule(value)
        and (getattr(value, "__module__", None) or "").split(".")[0] == package_name
    }
    complaints += [
        f"{package_name}.{name} is public but not in __all__" for name in sorted(own - set(listed))
    ]
    return complaints


def tracked_files() -> list[str]:
    if shutil.which("git") is None or not (ROOT / ".git").exists():
        pytest.skip("needs a git checkout")
    command = ["git", "ls-files", "-z"]
    listing = subprocess.run(command, cwd=ROOT, check=True, capture_output=True, text=True).stdout
    return [name for name in listing.split("\0") if name]


@pytest.mark.parametrize("rule", [wrong_layers, wrong_rooms, forbidden_imports, long_files, prints])
def test_repository(rule):
    assert not rule(ROOT)


def test_no_machine_paths():
    assert not machine_paths(ROOT, tracked_files())


@pytest.mark.parametrize("package_name", ["torchrl_sym", "tasks"])
def test_public_names(package_name):
    assert not unlisted_names(package_name)


# The rules themselves: each one finds its fault in a small bad tree, and nothing in a good one.


def write_tree(root: Path, files: dict[str, str]) -> Path:
    tree = {"torchrl_sym/__init__.py": "from torchrl_sym.groups import G\n"} | files
    for name, text in tree.items():
        path = root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return root


def test_rules_accept_a_good_tree(tmp_path):
    good = {
        "torchrl_sym/groups.py": "import torch\n",
        "torchrl_sym/symmetry.py": "from . import groups\nfrom .groups import G\n",
        "torchrl_sym/modules.py": "import torchrl_sym.symmetry\n",
        "torchrl_sym/mirror_loss.py": "from torchrl_sym.modules import symmetrize_\n",
        "tasks/cartpole.py": "from torchrl_sym import PointGroup\n# print(1)\n",
        "examples/train.py": "import tasks\nprint(1)\n",
    }
    root = write_tree(tmp_path, good)
    assert not [wrong for rule in (wrong_layers, forbidden_imports, prints, long_files)
                for wrong in rule(root)]  # fmt: skip
    assert not machine_paths(root, good)


@pytest.mark.parametrize(
    ("module", "source", "complaint"),
    [
        ("groups", "from torchrl_sym.symmetry import Symmetry", "groups imports torchrl_sym.symm"),
        ("groups", "from torchrl_sym import symmetry", "groups imports torchrl_sym.symmetry"),
        ("groups", "from .symmetry import Symmetry", "groups imports torchrl_sym.symmetry"),
        ("groups", "def late():\n    from . import symmetry", "groups imports torchrl_sym.symm"),
        ("modules", "import torchrl_sym.recipes", "modules imports torchrl_sym.recipes"),
        ("modules", "from torchrl_sym import Symmetry", "modules imports torchrl_sym.__init__"),
        ("modules", "import torchrl_sym", "modules imports torchrl_sym.__init__"),
        ("symmetry", "from .groups import G\nfrom .transforms import T", "symmetry imports"),
        ("transforms", "import torchrl_sym.modules", "cycle in torchrl_sym"),
        ("helpers", "", "helpers has no layer"),
    ],
)
def test_wrong_layers_are_found(tmp_path, module, source, complaint):
    files = dict.fromkeys(["groups", "symmetry", "transforms", "recipes"], "")
    files |= {"modules": "import torchrl_sym.transforms", module: source}
    root = write_tree(tmp_path, {f"torchrl_sym/{name}.py": text for name, text in files.items()})
    assert complaint in "\n".join(wrong_layers(root))


def test_wrong_rooms_are_found(tmp_path):
    good = {
        "torchrl_sym/mujoco/__init__.py": "from torchrl_sym.mujoco.derive import derive",
        "torchrl_sym/mujoco/model/links.py": "import torch",
        "torchrl_sym/mujoco/derive/derive.py": "from torchrl_sym.mujoco.model.links import Link",
    }
    assert not wrong_rooms(write_tree(tmp_path, good))
    bad = {"torchrl_sym/mujoco/model/links.py": "from torchrl_sym.mujoco.derive.derive import derive"}
    complaints = "\n".join(wrong_rooms(write_tree(tmp_path, bad)))
    assert "torchrl_sym.mujoco.model imports torchrl_sym.mujoco.derive, which comes after it" in complaints
    assert "cycle in torchrl_sym.mujoco" in complaints


@pytest.mark.parametrize(
    ("file", "source"),
    [
        ("torchrl_sym/groups.py", "from tasks.cartpole import Task"),
        ("torchrl_sym/groups.py", "def late():\n    import tasks"),
        ("tasks/base.py", "import benchmarks.compare"),
        ("tasks/base.py", "from examples import train"),
        ("examples/train.py", "from benchmarks.compare import run"),
    ],
)
def test_forbidden_imports_are_found(tmp_path, file, source):
    complaints = forbidden_imports(write_tree(tmp_path, {file: source}))
    assert complaints
    assert all(complaint.startswith(file) for complaint in complaints)


def test_long_files_are_found(tmp_path):
    files = {"tasks/a.py": "x = 1\n" * MAX_LINES, "tests/b.py": "x = 1\n" * (MAX_LINES + 1)}
    (complaint,) = long_files(write_tree(tmp_path, files))
    assert complaint.startswith("tests/b.py has 401 lines")


def test_prints_are_found(tmp_path):
    source = '"""print(0)"""\n\n\ndef f():\n    print(1)\n'
    (complaint,) = prints(write_tree(tmp_path, {"tasks/a.py": source}))
    assert complaint.startswith("tasks/a.py:5")


@pytest.mark.parametrize("folder", ["tmp", "home", "root", "opt", "work", "Users"])
def test_machine_paths_are_found(tmp_path, folder):
    source = f'see = "https://example.org/{folder}/x"\nran = "../{folder}/x"\nbad = "/{folder}/x"\n'
    (complaint,) = machine_paths(write_tree(tmp_path, {"a.py": source}), ["a.py", "gone.py"])
    assert complaint.startswith("a.py:3")


@pytest.mark.parametrize(
    ("number", "source", "complaint"),
    [
        (0, "__all__ = ['Nothing']", "does not exist"),
        (1, "__all__ = ['b', 'A']\nb = A = 1", "not sorted"),
        (2, "__all__ = ['A', 'A']\nA = 1", "lists a name twice"),
        (3, "__all__ = []\ndef extra(): ...", "extra is public but not in __all__"),
    ],
)
def test_unlisted_names_are_found(tmp_path, monkeypatch, number, source, complaint):
    name = f"bad_package_{number}"  # a new name each time: imports are cached
    write_tree(tmp_path, {f"{name}/__init__.py": source})
    monkeypatch.syspath_prepend(tmp_path)
    assert complaint in "\n".join(unlisted_names(name))
