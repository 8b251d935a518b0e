"""What a run leaves on disk: a folder with one table of metrics, one checkpoint and a lock.

``metrics.csv`` has one row per iteration, ``checkpoint.pt`` everything that decides the future of the run.
The checkpoint is replaced as a whole, after its row was written; when a run is continued, rows beyond the
checkpoint are cut off. So a run that was killed at any time and started again leaves the same files as one
that was not, but for the columns that tell the time. A folder belongs to one process at a time.

There is a checkpoint before there is a row. So a table without one, like a table that lacks iterations, has
lost something; the run is then refused, and nothing of it is touched.
"""

from __future__ import annotations

import fcntl
import io
import os
import pickle
import zipfile
from pathlib import Path
from typing import IO, Any, cast

import torch
from torchrl.record.loggers import Logger, get_logger

from torchrl_sym.extras import require
from torchrl_sym.recipes.table import MetricsTable, replace_file

_KEYS = {"config", "iteration", "seconds", "parts"}  # of every checkpoint, also of an exported policy


class RunFolder:
    """Metrics and checkpoint of one run; nothing is created before something is written.

    ``with RunFolder(folder):`` holds its lock, as for a folder with the runs of several processes.

    Args:
        folder: where they are.

    Raises:
        NotADirectoryError: there is a file of that name.
    """

    def __init__(self, folder: str | os.PathLike) -> None:
        self.path = Path(folder)
        if self.path.exists() and not self.path.is_dir():
            raise NotADirectoryError(f"expected a folder, got the file {self.path}; choose another name")
        self.table = MetricsTable(self.path / "metrics.csv")
        self.checkpoint = self.path / "checkpoint.pt"
        self._lock: IO | None = None

    def lock(self) -> None:
        """Claim the folder for this object until :meth:`release` or the end of the process.

        Raises:
            BlockingIOError: another run holds it, in this process or in another one.
        """
        self.path.mkdir(parents=True, exist_ok=True)
        lock = (self.path / "lock").open("a+")
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            lock.seek(0)
            holder = lock.read().strip() or "unknown"
            lock.close()
            raise BlockingIOError(
                f"expected a folder that nobody trains in, but process {holder} holds {self.path}; wait "
                "for it, end it, or use another folder"
            ) from None
        lock.truncate(0)
        lock.write(str(os.getpid()))
        lock.flush()
        self._lock = lock

    def release(self) -> None:
        """Give the folder up."""
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    def __enter__(self) -> RunFolder:
        self.lock()
        return self

    def __exit__(self, *reason: object) -> None:
        self.release()

    def save(self, checkpoint: dict[str, Any]) -> None:
        """Replace the checkpoint; a kill or a full disk leaves the old one or the new one, whole.

        Raises:
            TypeError: it could not be read back, since something in it is not a plain number, text or
                tensor. The old checkpoint is kept.
            OSError: it could not be written; the old one is kept.
        """
        buffer = io.BytesIO()
        torch.save(checkpoint, buffer)
        _require_readable(checkpoint, buffer)
        self.path.mkdir(parents=True, exist_ok=True)
        self.table.sync()  # a checkpoint must not outlive its rows
        replace_file(self.checkpoint, buffer.getvalue())

    def load(self) -> dict[str, Any] | None:
        """The checkpoint, None if there is none.

        Raises:
            ValueError: it is damaged, or not one of this recipe.
        """
        if not self.checkpoint.exists():
            return None
        remedy = "restore it from a copy, or delete the folder to train anew"
        content = io.BytesIO(self.checkpoint.read_bytes())
        try:
            with zipfile.ZipFile(content) as archive:
                if archive.testzip() is not None:  # torch does not look at the checksums
                    raise zipfile.BadZipFile("wrong checksum")
            content.seek(0)
            checkpoint = torch.load(content, weights_only=True, map_location="cpu")
        except Exception as error:
            raise ValueError(
                f"expected a checkpoint in {self.checkpoint}, got a file that cannot be read "
                f"({type(error).__name__}); {remedy}"
            ) from error
        missing = _KEYS - set(checkpoint) if isinstance(checkpoint, dict) else _KEYS
        if missing:
            raise ValueError(
                f"expected a checkpoint of recipes.train in {self.checkpoint}, got one without "
                f"{sorted(missing)}; {remedy}"
            )
        return checkpoint


def _require_readable(checkpoint: dict[str, Any], buffer: io.BytesIO) -> None:
    """TypeError, which names the entries, if a checkpoint cannot be loaded with ``weights_only=True``."""
    buffer.seek(0)
    try:
        torch.load(buffer, weights_only=True)
    except pickle.UnpicklingError as error:
        kinds = sorted(_foreign("checkpoint", checkpoint)) or ["checkpoint"]
        raise TypeError(
            f"expected a checkpoint of tensors, numbers and texts, which loads with weights_only=True, got "
            f"{', '.join(kinds)}; give save_state() plain values: float(x), int(x), torch.as_tensor(x)"
        ) from error


def _foreign(name: str, value: Any) -> set[str]:
    """Places in nested containers with a type that ``weights_only=True`` refuses."""
    if isinstance(value, dict):
        return {found for key, item in value.items() for found in _foreign(f"{name}[{key!r}]", item)}
    if type(value) in (list, tuple, set):
        return {found for item in value for found in _foreign(name, item)}
    plain = (
        value is None or isinstance(value, torch.Tensor) or type(value) in (bool, int, float, str, bytes)
    )
    return set() if plain else {f"{type(value).__module__}.{type(value).__qualname__} in {name}"}


def require_logger(kind: str | None) -> None:
    """ValueError unless there is such a logger; ImportError without the package of it."""
    if kind not in (None, "csv", "tensorboard", "wandb"):
        raise ValueError(f"expected logger 'csv', 'tensorboard' or 'wandb', got {kind!r}")
    if kind in ("tensorboard", "wandb"):
        require(f"logger {kind!r}", kind, {kind: ""})


def make_logger(kind: str | None, folder: str | os.PathLike | None, name: str) -> Logger | None:
    """TorchRL logger beside the metrics table: ``"tensorboard"``, ``"wandb"``, or None for ``"csv"``.

    The csv log is ``metrics.csv`` itself: TorchRL's CSVLogger writes a file per scalar and appends
    repeated rows when a run is continued.
    """
    if kind is None or kind == "csv":
        return None
    return get_logger(cast(Any, kind), logger_name=str(folder or "."), experiment_name=name)
