"""Declares the tables of stored results whole, for results from before `study.json` described them.

    python benchmarks/seal.py paper-push paper-climb

Afterwards a table that has lost a row is refused wherever it is read. Tables that have been described
already are compared, never described anew.
"""

from dataclasses import dataclass
from pathlib import Path

import tyro

from comparison.files import digest, read_json, write_json
from comparison.records import ABOUT, RESTORE, TABLES, read_about, rows_of

HERE = Path(__file__).parent


@dataclass
class Arguments:
    """Describe the tables of results in their study.json."""

    names: tyro.conf.Positional[tuple[str, ...]]
    """What the results are called."""
    results: Path = HERE / "results"
    """Where results are, in a folder of their name."""


def seal(folder: Path) -> None:
    """Describe the tables of a results folder, or compare them with their description.

    Raises:
        FileNotFoundError: there are no results.
        Damaged: a table is not as it was described.
    """
    path = folder / "study.json"
    about = read_json(path, ABOUT, RESTORE)
    if not about:
        raise FileNotFoundError(f"expected results in {folder} (study.json), found none")
    if "tables" not in about:
        tables = {name: digest((folder / name).read_bytes().decode()) for name in TABLES}
        write_json(path, about | {"tables": tables})
    about = read_about(folder)
    for name in TABLES:
        rows_of(folder, name, about)


def main(arguments: Arguments) -> None:
    for name in arguments.names:
        seal(arguments.results / name)
        print(f"sealed {name}")


if __name__ == "__main__":
    main(tyro.cli(Arguments))
