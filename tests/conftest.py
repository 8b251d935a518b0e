"""Settings that hold for every test: one torch thread, a quiet TorchRL."""

import logging
import multiprocessing
import os

import pytest
import torch
import torchrl  # noqa: F401  (creates the logger that is filtered below)

from tests.launch import OUTSIDE


def _is_not_extension_notice(record: logging.LogRecord) -> bool:
    return "Failed to import torchrl C++ binaries" not in record.getMessage()


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "slow: takes more than about ten seconds")
    torch.set_num_threads(1)
    os.environ.update({"OMP_NUM_THREADS": "1", "MPLBACKEND": "Agg"})  # of the processes that are started
    # TorchRL's default is "spawn", which pickles the same, and then imports torch for seconds.
    multiprocessing.set_start_method("forkserver", force=True)
    multiprocessing.set_forkserver_preload(OUTSIDE)
    # torchrl 0.14's compiled extension was built against another torch than the pinned one. Only
    # prioritized sampling needs it, and the tests of that say themselves why they are skipped.
    logging.getLogger("torchrl").addFilter(_is_not_extension_notice)
