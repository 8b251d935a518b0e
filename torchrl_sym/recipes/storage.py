"""What a run leaves on disk: one table of metrics and one checkpoint, both safe against a kill.

A run's folder holds ``metrics.csv`` (one row per iteration) and ``checkpoint.pt`` (everything that
decides the future of the run). The checkpoint is replaced atomically, after its row was written; when a
run is continued, rows beyond the checkpoint are cut off. So a run that was killed at any time and
started again leaves the same files as one that was not, but for the columns that tell the time.
"""

from __future__ import annotations

import csv
import os
from pathlib import Path
from typing import Any

import torch
from torchrl.record.loggers import Logger, get_logger

TIMING = ("seconds", "frames_per_second", "collect_seconds", "physics_seconds")
"""Columns of ``metrics.csv`` that depend on the machine."""


class RunFolder:
    """Metrics and checkpoint of one run.

    Args:
        folder: where they are; created if missing.
    """

    def __init__(self, folder: str | os.PathLike) -> None:
        self.path = Path(folder)
        self.path.mkdir(parents=True, exist_ok=True)
        self.metrics = self.path / "metrics.csv"
        self.checkpoint = self.path / "checkpoint.pt"

    def save(self, checkpoint: dict[str, Any]) -> None:
        """Replace the checkpoint; a kill leaves the old one or the new one, never half of it."""
        partial = self.checkpoint.with_suffix(".partial")
        torch.save(checkpoint, partial)
        os.replace(partial, self.checkpoint)

    def load(self) -> dict[str, Any] | None:
        """The checkpoint, None if there is none yet."""
        if not self.checkpoint.exists():
            return None
        return torch.load(self.checkpoint, weights_only=True, map_location="cpu")

    def append(self, row: dict[str, float]) -> None:
        """Add one iteration to the table."""
        new = not self.metrics.exists()
        with self.metrics.open("a", newline="") as file:
            writer = csv.DictWriter(file, fieldnames=list(row))
            if new:
                writer.writeheader()
            writer.writerow(row)

    def truncate(self, iterations: int) -> list[dict[str, float]]:
        """Drop what was logged after the given number of iterations; returns the rows that stay."""
        if not self.metrics.exists():
            return []
        if iterations == 0:
            self.metrics.unlink()
            return []
        rows = [row for row in read_metrics(self.metrics) if row["iteration"] <= iterations]
        partial = self.metrics.with_suffix(".partial")
        with partial.open("w", newline="") as file:
            writer = csv.DictWriter(file, fieldnames=list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)
        os.replace(partial, self.metrics)
        return rows


def read_metrics(path: str | os.PathLike) -> list[dict[str, float]]:
    """Rows of a ``metrics.csv``; a last row that a kill cut short is left out."""
    with Path(path).open(newline="") as file:
        rows = list(csv.DictReader(file))
    whole = [row for row in rows if None not in row and all(v not in (None, "") for v in row.values())]
    return [{name: _number(value) for name, value in row.items()} for row in whole]


def _number(text: str) -> float:
    return int(text) if text.lstrip("-").isdigit() else float(text)


def make_logger(kind: str | None, folder: str | os.PathLike | None, name: str) -> Logger | None:
    """TorchRL logger beside the metrics table: ``"tensorboard"``, ``"wandb"``, or None for ``"csv"``.

    The csv log is ``metrics.csv`` itself: TorchRL's CSVLogger writes a file per scalar and appends
    repeated rows when a run is continued.
    """
    if kind in (None, "csv"):
        return None
    if kind not in ("tensorboard", "wandb"):
        raise ValueError(f"expected logger 'csv', 'tensorboard' or 'wandb', got {kind!r}")
    return get_logger(kind, logger_name=str(folder or "."), experiment_name=name)
