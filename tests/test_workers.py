"""Workers end with the process that started them, however that ended."""

import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

PARENT = """
import multiprocessing, sys, time
from concurrent.futures import ProcessPoolExecutor
from workers import end_with_parent

def work(path):
    import os
    with open(path, "w") as file:
        file.write(str(os.getpid()))
    time.sleep(60)

if __name__ == "__main__":
    context = multiprocessing.get_context(sys.argv[2])
    with ProcessPoolExecutor(1, mp_context=context, initializer=end_with_parent) as pool:
        pool.submit(work, sys.argv[1]).result()
"""


def alive(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize("method", ["spawn", "forkserver"])
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM])
def test_a_worker_ends_with_its_parent(method, how, tmp_path):
    script, started = tmp_path / "parent.py", tmp_path / "pid"
    script.write_text(PARENT)
    shutil.copy(ROOT / "torchrl_sym" / "recipes" / "workers.py", tmp_path)  # alone, it needs no torch
    with subprocess.Popen([sys.executable, script, started, method]) as parent:
        while not started.exists() or not started.read_text():
            assert parent.poll() is None
            time.sleep(0.05)
        parent.send_signal(how)
    worker, deadline = int(started.read_text()), time.monotonic() + 10
    while alive(worker):
        assert time.monotonic() < deadline, "the worker outlives its parent"
        time.sleep(0.05)
