"""One model under every element: which symmetries it has, how exactly, where, and how long that took."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from catalogue.expectations import Expectation
from catalogue.sources import load
from torchrl_sym import PointGroup
from torchrl_sym.mujoco import ModelSymmetry, derive, symmetries

GROUPS = {
    "reflect-x": PointGroup.reflection("x"),
    "reflect-y": PointGroup.reflection("y"),
    "rot-180": PointGroup.rotation(2),
}
"""Elements that may exchange left and right."""


@dataclass
class Row:
    """What is known of one file."""

    key: str
    error: str = ""
    """Why there is nothing else: it does not compile, it took too long, the library failed."""
    verdicts: dict[str, str] = field(default_factory=dict)
    """exact, approximate, no, cannot tell, nothing, by element."""
    words: dict[str, str] = field(default_factory=dict)
    """The verdict in full, by element."""
    worst: dict[str, str] = field(default_factory=dict)
    """The largest residual and where it is, by element; nothing where all is exact."""
    pose: str = ""
    axis: tuple[float, float] = (0.0, 0.0)
    stand_ins: tuple[str, ...] = ()
    """Meshes that were not at hand."""
    seconds: float = 0.0
    """Processor time of the whole search."""
    against: list[str] = field(default_factory=list)
    """What disagrees with what was expected."""


def examine(key: str, path: Path, expected: Expectation | None) -> dict[str, Any] | None:
    """The row of a file, as plain data; None for a file that is a piece of others."""
    loaded = load(path)
    if loaded.is_piece:
        return None
    if loaded.model is None:
        return asdict(Row(key, f"does not compile: {loaded.error}"))

    started = time.process_time()
    report = symmetries(loaded.model)
    seconds = time.process_time() - started

    row = Row(key, pose=report.pose, axis=report.axis, stand_ins=loaded.stand_ins, seconds=seconds)
    for candidate in report.candidates:
        audit = candidate.report
        row.verdicts[candidate.name] = audit.outcome
        row.words[candidate.name] = audit.verdict
        worst = audit.worst
        if worst is not None and worst.residual > audit.tolerance:
            row.worst[candidate.name] = f"{worst.residual:.2g}, {worst.term} of {worst.name}"
    if expected is not None:
        images: list[dict[str, str]] = []
        if row.verdicts.get(expected.mirror) in ("exact", "approximate") and expected.sides:
            robot = derive(loaded.model, GROUPS[expected.mirror])
            images = [_named(robot, kind, expected.mirror) for kind in ("joint", "actuator")]
        row.against = expected.complaints(row.verdicts, images)
    return asdict(row)


def _named(robot: ModelSymmetry, kind: str, element: str) -> dict[str, str]:
    """Images of what has a name of its own, without signs."""
    table = robot.table(kind, element)
    return {name: image.lstrip("+-") for name, image in table.items() if not name.startswith(f"{kind} ")}
