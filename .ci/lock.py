"""Write constraints-hashes.txt: the files that CI may install, each with its SHA-256.

    make lock    # whenever constraints.txt has changed

For every Python that the project runs on, pip says which wheel of each pinned version it would install on
Linux (x86_64) and what the wheel's hash is; nothing is installed. torch is the CPU build, whose files are
not on PyPI: pip has to find them, as CI does, by

    export PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu

Only CI installs from that file. constraints.txt stays without hashes: pip would then demand one for
everything, the project itself and other builds of torch included.
"""

import json
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parent.parent
CONSTRAINTS, HASHES = ROOT / "constraints.txt", ROOT / "constraints-hashes.txt"
PYTHONS = ("3.11", "3.12")
# Wheels for the oldest glibc that torch 2.13 runs on; every newer Linux takes them too.
PLATFORMS = [*(f"manylinux_2_{minor}_x86_64" for minor in range(28, 4, -1)), "manylinux2014_x86_64"]
HEADER = f"""\
# constraints.txt with the hash of every file that CI may install; made by `make lock`, see .ci/lock.py.
# Linux (x86_64), Python {" and ".join(PYTHONS)}.
"""


def normalized(name: str) -> str:
    """A package's name as indexes compare it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def pinned(text: str) -> dict[str, str]:
    """Name to version of every ``name==version``, in the order of the file."""
    return dict(re.findall(r"^([\w.-]+)==([^\s\\]+)", text, re.MULTILINE))


def files(python: str) -> dict[str, tuple[str, str]]:
    """What pip would install for one Python: normalized name to version and SHA-256."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        command = [sys.executable, "-m", "pip", "install", "--quiet", "--dry-run", "--ignore-installed"]
        command += ["--no-deps", "--only-binary", ":all:", "--python-version", python, "--target", folder]
        command += [part for platform in PLATFORMS for part in ("--platform", platform)]
        command += ["--report", str(report), "--requirement", str(CONSTRAINTS)]
        subprocess.run(command, check=True, env=os.environ | {"PIP_CONSTRAINT": os.devnull})
        installed = json.loads(report.read_text())["install"]
    return {
        normalized(item["metadata"]["name"]): (
            item["metadata"]["version"],
            item["download_info"]["archive_info"]["hashes"]["sha256"],
        )
        for item in installed
    }


def main() -> None:
    """Ask pip for every Python, and write what all of them need."""
    found = {python: files(python) for python in PYTHONS}
    for python, chosen in found.items():
        version, _ = chosen["torch"]
        if not version.endswith("+cpu"):
            sys.exit(
                f"expected the CPU build of torch for Python {python}, got {version}; "
                "export PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu and try again"
            )
    lines = [HEADER]
    for name, version in pinned(CONSTRAINTS.read_text()).items():
        hashes = sorted({chosen[normalized(name)][1] for chosen in found.values()})
        lines.append(
            " \\\n    ".join([f"{name}=={version}", *(f"--hash=sha256:{x}" for x in hashes)]) + "\n"
        )
    HASHES.write_text("".join(lines))


if __name__ == "__main__":
    main()
