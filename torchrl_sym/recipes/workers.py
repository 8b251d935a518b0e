"""Runs in processes of their own, which must not outlive the process that started them."""

from __future__ import annotations

import multiprocessing
import os
import threading
from multiprocessing.process import BaseProcess


def end_with_parent() -> None:
    """End this process as soon as the one that started it has ended, however that came about.

    Call it first in the worker, or as ``initializer`` of a ``ProcessPoolExecutor``. A worker that was left
    alone would wait for ever, or go on training in a folder that the next start wants.
    """
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_after, args=(parent,), daemon=True).start()


def _end_after(parent: BaseProcess) -> None:
    parent.join()
    os._exit(1)  # what was written so far is enough to continue
