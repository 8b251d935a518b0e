"""Command line: where everything in a model goes, and how exact the symmetry is.

python -m torchrl_sym.mujoco robot.xml --group klein_four
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from torchrl_sym.extras import require

try:
    require("python -m torchrl_sym.mujoco", "mujoco", {"tyro": ""})
except ImportError as error:
    sys.exit(str(error))

import tyro

from torchrl_sym import checks
from torchrl_sym.groups import PointGroup
from torchrl_sym.mujoco.audit import audit
from torchrl_sym.mujoco.derive import derive
from torchrl_sym.mujoco.model.types import mj
from torchrl_sym.mujoco.symmetrize import symmetrize_with_report

GROUPS = {
    "reflect-x": lambda: PointGroup.reflection("x"),
    "reflect-y": lambda: PointGroup.reflection("y"),
    "klein_four": PointGroup.klein_four,
}


@dataclass
class Arguments:
    """Derive and audit the symmetry of a MuJoCo model; exit status 1 if it has none."""

    model: Annotated[Path, tyro.conf.Positional]
    """An MJCF or URDF file."""
    group: str = "reflect-y"
    """reflect-x, reflect-y (left and right), klein_four, rotation-N or dihedral-N."""
    keyframe: str | None = None
    """A pose that the group keeps, by name; the model's reference pose by default."""
    carried: tuple[str, ...] = ()
    """Free or mocap bodies that a turn of the world only carries along, such as a cube under rotation-3."""
    out: Path | None = None
    """Where to write the model with everything averaged over the group (MJCF, six digits)."""


def named_group(name: str) -> PointGroup:
    """The group a name stands for.

    Raises:
        ValueError: an unknown name; the message lists the known ones.

    Example:
        >>> named_group("rotation-3").names
        ('identity', 'rot-120', 'rot-240')
    """
    kind, _, fold = checks.instance("group", name, str).partition("-")
    if name in GROUPS:
        return GROUPS[name]()
    if kind in ("rotation", "dihedral") and fold.isdecimal():
        return getattr(PointGroup, kind)(int(fold))
    raise ValueError(f"expected one of {list(GROUPS)}, rotation-N or dihedral-N, got {name!r}")


def main(arguments: Arguments) -> int:
    """Print the tables; returns the exit status."""
    group = named_group(arguments.group)
    model = mj.MjModel.from_xml_path(str(arguments.model))
    pose, carried = arguments.keyframe, arguments.carried
    report = audit(model, group, pose, carried=carried)
    try:
        tables = f"{derive(model, group, pose, carried=carried)}\n\n"
    except ValueError:  # the report says why
        tables = ""
    sys.stdout.write(f"{tables}{report}\n")
    if arguments.out is not None and report.reason is None:
        spec = mj.MjSpec.from_file(str(arguments.model))
        spec, changes = symmetrize_with_report(spec, group, pose, carried=carried)
        arguments.out.write_text(spec.to_xml())
        written = audit(mj.MjModel.from_xml_path(str(arguments.out)), group, pose, carried=carried)
        sys.stdout.write(
            f"\n{changes}\n\nwritten to {arguments.out}: {written.verdict}\n"
            "(MJCF is written with six digits; for an exact model compile what symmetrize returns)\n"
        )
    return 0 if report.reason is None else 1


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Arguments)))
