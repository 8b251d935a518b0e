"""Which symmetries public MuJoCo models have, against what they ought to have: writes docs/models.md.

    python benchmarks/models.py                                what is installed: gymnasium, dm_control, ...
    python benchmarks/models.py --menagerie ~/mujoco_menagerie and a checkout of mujoco_menagerie
    python benchmarks/models.py --only "menagerie/unitree_*"   a part of it, printed

Every model is examined in a process of its own, with a time limit: what does not compile, hangs or fails is
a row of the page and stops nothing. Rows are kept in a file as they come, so that a run that was stopped
goes on from there. The exit status is 1 if a verdict, or a pair of left and right, is against
benchmarks/catalogue/expectations.toml.
"""

import contextlib
import sys
from dataclasses import dataclass
from fnmatch import fnmatchcase
from importlib import metadata
from pathlib import Path

import mujoco
import tyro

from catalogue import expectations, sources
from catalogue.page import page
from catalogue.run import examine_all
from comparison.files import write_whole

DOCS = Path(__file__).parents[1] / "docs"


@dataclass
class Arguments:
    """Examine public models and write the page about them."""

    menagerie: Path | None = None
    """A checkout of mujoco_menagerie."""
    also: tuple[Path, ...] = ()
    """Further folders of models; each is a source under its own name."""
    only: tuple[str, ...] = ()
    """Patterns of keys to examine; with them the page is printed, not written."""
    out: Path = DOCS / "models.md"
    """Where the page goes."""
    rows: Path = Path("runs/models.jsonl")
    """Where rows are kept as they come, until the page is written; delete it after changing the library."""
    workers: int = 2
    """Processes at a time."""
    limit: float = 60.0
    """Seconds for each model."""


def versions(found: list[sources.Source]) -> str:
    """What the page was made of."""
    numbers = []
    for source in found:
        with contextlib.suppress(metadata.PackageNotFoundError):  # a folder, not a package
            numbers.append(f"{source.name.replace('_', '-')} {metadata.version(source.name)}")
    return f"MuJoCo {mujoco.__version__}; {', '.join(numbers)}.\n"


def main(arguments: Arguments) -> int:
    """Write or print the page; returns the exit status."""
    found = sources.sources(arguments.menagerie, arguments.also)
    wanted = expectations.read()
    jobs = [
        (key, path, expectations.expectation(key, wanted))
        for source in found
        for key, path in source.files()
        if not arguments.only or any(fnmatchcase(key, pattern) for pattern in arguments.only)
    ]
    about = versions(found)
    kept = None if arguments.only else arguments.rows
    rows = examine_all(jobs, arguments.workers, arguments.limit, kept)

    text = page(rows, wanted, found, about)
    if arguments.only:
        print(text)
    else:
        write_whole(arguments.out, text)
        arguments.rows.unlink(missing_ok=True)
    return int(any(row.against for row in rows))


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Arguments)))
