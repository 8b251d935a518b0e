"""Write the files that CI may install, each with its SHA-256: constraints-hashes.txt and -mjlab-hashes.txt.

    make lock    # whenever constraints.txt or constraints-mjlab.txt has changed

For every Python that a file is for, pip says which wheel of each pinned version it would install on Linux
(x86_64) and what the wheel's hash is; nothing is installed. torch is the CPU build, whose files are not on
PyPI: pip has to find them, as CI does, by

    export PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu

Only CI installs from these files. The constraints stay without hashes: pip would then demand one for
everything, the project itself and other builds of torch included.
"""

import json
import os
import re
import subprocess
import sys
import tempfile
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).parent.parent
# What is locked, and for which Pythons.
LOCKED = {"constraints": ("3.10", "3.11", "3.12", "3.13", "3.14"), "constraints-mjlab": ("3.11",)}
# Wheels for the oldest glibc that torch 2.13 runs on; every newer Linux takes them too.
PLATFORMS = [*(f"manylinux_2_{minor}_x86_64" for minor in range(28, 4, -1)), "manylinux2014_x86_64"]


def header(name: str) -> str:
    """The first lines of a file with hashes."""
    return f"""\
# {name}.txt with the hash of every file that CI may install; made by `make lock`, see .ci/lock.py.
# Linux (x86_64), Python {", ".join(LOCKED[name])}.
"""


def normalized(name: str) -> str:
    """A package's name as indexes compare it."""
    return re.sub(r"[-_.]+", "-", name).lower()


def pinned(text: str) -> list[Requirement]:
    """Every ``name==version; marker`` of a file, with or without hashes."""
    lines = re.findall(r"^[\w.-]+==[^\\\n]+", text, re.MULTILINE)
    return [Requirement(line) for line in lines]


def files(requirements: list[Requirement], python: str) -> dict[str, tuple[str, str]]:
    """What pip would install for one Python: normalized name to version and SHA-256."""
    # pip evaluates markers for the Python it runs on, whatever --python-version says
    asked = [r for r in requirements if r.marker is None or r.marker.evaluate({"python_version": python})]
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        command = [sys.executable, "-m", "pip", "install", "--quiet", "--dry-run", "--ignore-installed"]
        command += ["--no-deps", "--only-binary", ":all:", "--python-version", python, "--target", folder]
        command += [part for platform in PLATFORMS for part in ("--platform", platform)]
        command += ["--report", str(report), *(f"{r.name}{r.specifier}" for r in asked)]
        subprocess.run(command, check=True, env=os.environ | {"PIP_CONSTRAINT": os.devnull})
        installed = json.loads(report.read_text())["install"]
    return {
        normalized(item["metadata"]["name"]): (
            item["metadata"]["version"],
            item["download_info"]["archive_info"]["hashes"]["sha256"],
        )
        for item in installed
    }


def locked(name: str) -> str:
    """Constraints with the hash of every file, for all Pythons that they are for."""
    requirements = pinned((ROOT / f"{name}.txt").read_text())
    found = {python: files(requirements, python) for python in LOCKED[name]}
    for python, chosen in found.items():
        version, _ = chosen.get("torch", ("+cpu", ""))
        if not version.endswith("+cpu"):
            sys.exit(
                f"expected the CPU build of torch for Python {python}, got {version}; "
                "export PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu and try again"
            )
    lines = [header(name)]
    for requirement in requirements:
        package, version = normalized(requirement.name), str(requirement.specifier).removeprefix("==")
        chosen = {files_of.get(package, ("", "")) for files_of in found.values()}
        hashes = sorted(hash_ for release, hash_ in chosen if release.partition("+")[0] == version)
        lines.append(" \\\n    ".join([str(requirement), *(f"--hash=sha256:{x}" for x in hashes)]) + "\n")
    return "".join(lines)


def main() -> None:
    """Ask pip for every Python, and write what all of them need."""
    texts = {name: locked(name) for name in LOCKED}
    for name, text in texts.items():
        (ROOT / f"{name}-hashes.txt").write_text(text)


if __name__ == "__main__":
    main()
