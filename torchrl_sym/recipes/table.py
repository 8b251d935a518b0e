"""The table of a run: one row of numbers per iteration, safe against a kill at any time.

A row that a kill cut short has no end of line; it is left out. Every other row that does not fit its header
is an error: a table never loses or shifts a number in silence.
"""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

TIMING = ("seconds", "frames_per_second", "collect_seconds", "physics_seconds")
"""Columns of ``metrics.csv`` that depend on the machine."""


class MetricsTable:
    """``metrics.csv`` of a run; it is created with its first row.

    Args:
        path: the file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._columns: list[str] = []  # read from the file when they are needed

    def append(self, row: dict[str, float]) -> None:
        """Add one iteration to the table; with columns that it has not had so far, it is written anew.

        What a row lacks of the columns of the table, and earlier rows of new columns, is NaN there.
        """
        if not self._columns and self.path.exists():
            self._columns = _header(self.path)
        if not self._columns:
            self._write([row])
        elif row.keys() <= set(self._columns):
            with self.path.open("a", newline="") as file:
                _writer(file, self._columns).writerow(row)
        else:
            self._write([*read_metrics(self.path), row])

    def truncate(self, iterations: int) -> None:
        """Cut the table back to the first iterations.

        Raises:
            ValueError: it does not hold each of them once.
        """
        rows = read_metrics(self.path) if self.path.exists() else []
        found = [row.get("iteration") for row in rows]
        if found[:iterations] != list(range(1, iterations + 1)):
            raise ValueError(
                f"expected rows of the iterations 1 to {iterations} of the checkpoint in {self.path}, got "
                f"{_summary(found)}; restore the table from a copy, go on from this folder in another one "
                "(start_from), or delete the folder to train anew"
            )
        if len(found) > iterations or (rows and not _ends_whole(self.path)):
            self._write(rows[:iterations])

    def require_empty(self) -> None:
        """A table without a checkpoint has lost it, since the checkpoint comes first.

        Raises:
            ValueError: there is a row.
        """
        if self.path.exists() and read_metrics(self.path):
            raise ValueError(
                f"expected a checkpoint beside {self.path}, found none; restore checkpoint.pt from a copy, "
                "or delete the folder to train anew"
            )

    def sync(self) -> None:
        """Have everything that was appended on the disk itself."""
        if self.path.exists():
            with self.path.open("rb") as file:
                os.fsync(file.fileno())

    def _write(self, rows: Sequence[dict[str, float]]) -> None:
        columns = list(dict.fromkeys(name for row in rows for name in row)) or _header(self.path)
        text = io.StringIO(newline="")
        writer = _writer(text, columns)
        writer.writeheader()
        writer.writerows(rows)
        replace_file(self.path, text.getvalue().encode())
        self._columns = columns


def read_metrics(path: str | os.PathLike) -> list[dict[str, float]]:
    """Rows of a ``metrics.csv``; a last row that a kill cut short is left out.

    Raises:
        ValueError: another row is damaged; the message names its line.
    """
    path = Path(path)
    columns, lines = _lines(path)
    return [_row(path, columns, number, line) for number, line in enumerate(lines, 2)]


def read_last(path: str | os.PathLike) -> tuple[int, dict[str, float]]:
    """How many rows a ``metrics.csv`` has, and the last of them: for those who look at it often.

    Raises:
        ValueError: the last row is damaged.
    """
    path = Path(path)
    columns, lines = _lines(path)
    return len(lines), _row(path, columns, len(lines) + 1, lines[-1]) if lines else {}


def _lines(path: Path) -> tuple[list[str], list[str]]:
    """Columns and rows of a table; what follows the last end of a line was cut short."""
    header, *lines = path.read_text().split("\n")[:-1] or [""]
    return next(csv.reader([header]), []), lines


def _row(path: Path, columns: list[str], number: int, line: str) -> dict[str, float]:
    fields = next(csv.reader([line]), [])
    try:
        return {name: _number(field) for name, field in zip(columns, fields, strict=True)}
    except ValueError as error:
        raise ValueError(
            f"expected {len(columns)} numbers in line {number} of {path}, got {fields}; restore the "
            "table from a copy, or delete its folder to train anew"
        ) from error


def _number(text: str) -> float:
    return int(text) if text.lstrip("-").isdigit() else float(text)


def _header(path: Path) -> list[str]:
    with path.open(newline="") as file:
        return next(csv.reader(file), [])


def _writer(file: Any, columns: list[str]) -> csv.DictWriter:
    return csv.DictWriter(file, columns, restval="nan", lineterminator="\n")


def _ends_whole(path: Path) -> bool:
    return path.read_bytes().endswith(b"\n")


def _summary(found: Sequence[Any]) -> str:
    if not found:
        return "none"
    twice = sorted({each for each in found if found.count(each) > 1}, key=str)
    lacking = sorted(set(range(1, int(max(found)) + 1)) - set(found))
    problems = [f"without {lacking[:5]}"] * bool(lacking) + [f"twice {twice[:5]}"] * bool(twice)
    return ", ".join([f"{len(found)} rows up to {max(found)}", *problems])


def replace_file(path: Path, content: bytes) -> None:
    """Replace a file at once: a kill, a full disk or a loss of power leaves the old one or the new one."""
    partial = path.with_name(path.name + ".partial")
    try:
        with partial.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
    except OSError:
        partial.unlink(missing_ok=True)
        raise
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)  # the new name
    finally:
        os.close(folder)
