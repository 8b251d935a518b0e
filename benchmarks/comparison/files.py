"""Files that a kill or a full disk leaves whole, and that say so where they are not.

A file is written beside its place, brought to the disk, and renamed: what is read is the old content or the
new one. Files that belong together change in one moment too: the description of a study names its tables by
content, so a table whose renaming was still to come is found beside its place.
"""

import hashlib
import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from torchrl_sym.recipes.table import replace_file

Kind = type | tuple[type, ...]


class Damaged(ValueError):
    """A file is not as it was written; the message names it and the remedy."""


def partial_of(path: Path) -> Path:
    """Where the next content of a file is written."""
    return path.with_suffix(".partial")


def stage(path: Path, text: str) -> None:
    """Bring the next content of a file to the disk, beside its place."""
    with partial_of(path).open("w", encoding="utf-8", newline="") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())


def settle(path: Path) -> None:
    """Put the staged content of a file in its place."""
    os.replace(partial_of(path), path)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def finish(path: Path, expected: Any) -> None:
    """Put the staged content of a file in its place if its `digest` is the expected one."""
    staged = partial_of(path)
    if staged.exists() and digest(staged.read_bytes().decode(errors="replace")) == expected:
        settle(path)


def write_whole(path: Path, text: str) -> None:
    """Replace a file at once."""
    replace_file(path, text.encode())


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Replace a file at once by JSON; numbers that are not finite become text."""
    write_whole(path, json.dumps(plain(content), indent=1, allow_nan=False) + "\n")


def plain(value: Any) -> Any:
    """A value as it comes back from JSON."""
    if isinstance(value, dict):
        return {key: plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [plain(each) for each in value]
    return value if not isinstance(value, float) or math.isfinite(value) else str(value)


def read_json(path: Path, kinds: Mapping[str, Kind], remedy: str) -> dict[str, Any]:
    """What `write_json` wrote.

    Args:
        path: the file; none is an empty dictionary.
        kinds: keys that must be there, and the types of their values.
        remedy: what to do about a damaged file.

    Raises:
        Damaged: it cannot be read, is not JSON, or lacks a key.
    """
    if not path.exists():
        return {}
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise Damaged(f"expected {path} to be JSON, as it was written, got {error}; {remedy}") from error
    check_kinds(path, content, kinds, remedy)
    return content


def check_kinds(path: Path, content: Any, kinds: Mapping[str, Kind], remedy: str) -> None:
    """Refuse content of a file that is no dictionary with these keys and types of values.

    Raises:
        Damaged: names the file and what is wrong.
    """
    if not isinstance(content, dict):
        raise Damaged(f"expected {path} to hold a dictionary, got {type(content).__name__}; {remedy}")
    wrong = [
        f"no {key}" if key not in content else f"{key} = {str(content[key])[:40]!r}"
        for key, kind in kinds.items()
        if not isinstance(content.get(key), kind)
    ]
    if wrong:
        raise Damaged(f"expected {path} as it was written, got {', '.join(wrong)}; {remedy}")


def digest(text: str) -> dict[str, Any]:
    """What tells whether a table is whole: how many rows it has, and a hash of its content."""
    return {"rows": text.count("\n") - 1, "sha256": hashlib.sha256(text.encode()).hexdigest()}


def read_table(path: Path, expected: Mapping[str, Any], remedy: str) -> str:
    """The text of a table, which must be the one that was written.

    Args:
        path: the table.
        expected: its `digest`.
        remedy: what to do about a damaged table.

    Raises:
        Damaged: neither the table nor what is staged beside it is that one.
    """
    found = "none"
    for place in (partial_of(path), path):
        try:
            text = place.read_bytes().decode()
        except (OSError, ValueError) as error:
            found = str(error) if place.exists() else "none"
            continue
        if digest(text) == dict(expected):
            return text
        found = f"{digest(text)['rows']} rows and another content"
    raise Damaged(f"expected {path} with its {expected['rows']} rows, as written, got {found}; {remedy}")
