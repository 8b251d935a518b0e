"""Command line: which symmetries a model has, where everything in it goes, and how exact that is.

python -m torchrl_sym.mujoco robot.xml
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from torchrl_sym.extras import require

try:
    require("python -m torchrl_sym.mujoco", "mujoco", {"tyro": ""})
except ImportError as error:
    sys.exit(str(error))

import tyro

from torchrl_sym import checks
from torchrl_sym.groups import PointGroup
from torchrl_sym.mujoco.audit import AuditReport, audit
from torchrl_sym.mujoco.derive import derive
from torchrl_sym.mujoco.model.files import load_spec
from torchrl_sym.mujoco.model.types import mj
from torchrl_sym.mujoco.symmetries import symmetries
from torchrl_sym.mujoco.symmetrize import symmetrize_with_report

GROUPS = {"klein_four": PointGroup.klein_four}
_SYMMETRIC = ("exact", "approximate")


@dataclass
class Arguments:
    """Which symmetries a MuJoCo model has; exit status 1 if it has none, 2 for a mistake in the call."""

    model: Annotated[Path, tyro.conf.Positional]
    """An MJCF or URDF file."""
    group: str | None = None
    """Try this group only: reflect-x (front and back), reflect-y (left and right), reflect-30 (the angle of
    the mirror's normal from x, in degrees), klein_four, rotation-N or dihedral-N. Default: try all."""
    plane: float = 0.0
    """Degrees by which the mirror planes of --group are turned about the vertical axis."""
    keyframe: str | None = None
    """A pose that the group keeps, by name; found by default."""
    axis: tuple[float, float] | None = None
    """Where the vertical axis stands, x and y in metres; found by default."""
    tolerance: float = 1e-8
    """Largest residual that counts as exact."""
    carried: tuple[str, ...] = ()
    """Free or mocap bodies that a turn of the world only carries along, such as a cube under rotation-3."""
    free_base: bool = False
    """Set the base free first: a URDF, or a robot whose free joint is in another file."""
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
    kind, _, rest = checks.instance("group", name, str).partition("-")
    if name in GROUPS:
        return GROUPS[name]()
    if kind in ("rotation", "dihedral") and rest.isdecimal():
        return getattr(PointGroup, kind)(int(rest))
    if kind == "reflect" and rest in ("x", "y"):
        return PointGroup.reflection(rest)
    try:
        return PointGroup.reflection(float(rest if kind == "reflect" else "none"))
    except ValueError as error:
        known = ["reflect-x", "reflect-y", *GROUPS]
        raise ValueError(
            f"expected one of {known}, reflect-DEGREES, rotation-N or dihedral-N, got {name!r}"
        ) from error


def main(arguments: Arguments) -> int:
    """Print what was found; returns the exit status."""
    try:
        for text in _answers(arguments):
            sys.stdout.write(f"{text}\n")
    except _NoSymmetry:
        return 1
    except BrokenPipeError:  # whoever read the output has seen enough
        sys.stdout = None
        return 0
    except (KeyError, OSError, TypeError, ValueError) as error:
        reason = error.args[0] if isinstance(error, KeyError) else error
        sys.stderr.write(f"error: {' '.join(str(reason).split())}\n")
        return 2
    return 0


class _NoSymmetry(Exception):
    """The model lacks the group; the report, printed before, says why."""


def _answers(arguments: Arguments) -> Iterator[str]:
    if arguments.plane and arguments.group is None:
        raise ValueError(
            "expected --group beside --plane, which turns its mirrors; without, all planes are tried"
        )
    if arguments.out is not None and not arguments.out.parent.is_dir():
        raise ValueError(f"expected a folder to write to, {arguments.out.parent} is none; make it first")

    spec = load_spec(arguments.model, arguments.free_base)
    model = spec.compile()
    where: dict[str, Any] = {"axis": arguments.axis, "carried": arguments.carried}
    if arguments.group is None:
        found = symmetries(model, arguments.keyframe, tolerance=arguments.tolerance, **where)
        yield f"{found}\n"
        group, report = found.group, found.audit
        if group.order == 1:
            if arguments.out is not None:
                yield _unwritten(arguments.out)
            raise _NoSymmetry
    else:
        group = named_group(arguments.group).turned(arguments.plane)
        report = audit(model, group, arguments.keyframe, tolerance=arguments.tolerance, **where)

    if report.outcome in _SYMMETRIC:
        yield f"{derive(model, group, arguments.keyframe, **where)}\n"
    yield str(report)
    if report.outcome not in _SYMMETRIC:
        if arguments.out is not None:
            yield _unwritten(arguments.out)
        raise _NoSymmetry
    if arguments.out is not None:
        yield _write(arguments, spec, group, where)


def _unwritten(path: Path) -> str:
    return f"\n{path} was not written: there is no symmetry to average over"


def _write(arguments: Arguments, spec: Any, group: PointGroup, where: dict[str, Any]) -> str:
    assert arguments.out is not None
    spec, changes = symmetrize_with_report(spec, group, arguments.keyframe, **where)
    spec.compile()
    arguments.out.write_text(spec.to_xml())
    model = mj.MjModel.from_xml_path(str(arguments.out))
    written: AuditReport = audit(model, group, arguments.keyframe, tolerance=arguments.tolerance, **where)
    return (
        f"\n{changes}\n\nwritten to {arguments.out}: {written.verdict}\n"
        "(MJCF is written with six digits; for an exact model compile what symmetrize returns)"
    )


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Arguments, prog="python -m torchrl_sym.mujoco")))
