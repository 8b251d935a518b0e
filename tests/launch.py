"""Scripts in processes of their own, which need not import torch again.

Importing torch, TorchRL and Matplotlib takes longer than most scripts of the tests run. So a server imports
them once, and every start is a fork of it: with its own ``__main__``, arguments, working folder, output and
exit code, and with fresh imports of everything that is ours, as ``python SCRIPT ARGUMENTS`` has them. The
same server forks whatever else the tests start as processes, except where they ask for "spawn".
"""

import multiprocessing
import multiprocessing.forkserver
import os
import runpy
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
# What others wrote and what is slow to import; what is not installed is passed over.
OUTSIDE = [
    *("torchrl.collectors", "torchrl.data", "torchrl.envs", "torchrl.modules", "torchrl.objectives"),
    *("scipy.ndimage", "scipy.optimize", "scipy.stats", "matplotlib.pyplot", "PIL.Image", "tyro", "tqdm"),
]


def serve() -> None:
    """Start the server, if it does not run yet, before anybody starts one that imports something else."""
    multiprocessing.set_forkserver_preload(OUTSIDE)
    multiprocessing.forkserver.ensure_running()


class Script:
    """A script that has been started; what it prints goes to two files.

    Args:
        script: its path, or its text.
        arguments: what follows it on the command line.
        folder: where it works; by default where this process does.
    """

    def __init__(self, script: Path | str, *arguments: object, folder: Path | None = None) -> None:
        self._folder = tempfile.TemporaryDirectory()
        code, *self._outputs = (Path(self._folder.name) / name for name in ("script.py", "out", "err"))
        if isinstance(script, str):
            code.write_text(script)
            script = code
        self.command = [str(script), *map(str, arguments)]
        serve()
        context = multiprocessing.get_context("forkserver")
        self.process = context.Process(
            target=_run, args=(self.command, self._outputs, folder or Path.cwd())
        )
        self.process.start()

    def output(self) -> tuple[str, str]:
        """What it has written so far, and its complaints."""
        written, complaints = (path.read_text() if path.exists() else "" for path in self._outputs)
        return written, complaints

    def kill(self) -> None:
        """End it at once, whatever it is doing."""
        self.process.kill()
        self.process.join()

    def wait(self, timeout: float = 500) -> subprocess.CompletedProcess[str]:
        """How it ended, as `subprocess.run` tells it."""
        self.process.join(timeout)
        if self.process.is_alive():
            self.kill()
            raise TimeoutError(f"{self.command} was not done after {timeout} s: {self.output()}")
        return subprocess.CompletedProcess(self.command, self.process.exitcode or 0, *self.output())


def _run(command: list[str], outputs: list[Path], folder: Path) -> None:
    """What an interpreter does with a script, in the new process."""
    for descriptor, path in enumerate(outputs, start=1):
        with path.open("wb") as file:
            os.dup2(file.fileno(), descriptor)
    os.chdir(folder)
    os.environ["PYTHONPATH"] = str(ROOT)
    tests = {"", str(ROOT), str(ROOT / "benchmarks")}  # which pytest.ini_options of the project adds
    others = [path for path in sys.path if path not in tests]
    sys.path[:] = [str(Path(command[0]).parent), str(ROOT), *others]
    sys.argv[:] = command
    runpy.run_path(command[0], run_name="__main__")
