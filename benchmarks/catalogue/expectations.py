"""What is expected of a public model, and whether what was found agrees: verdicts, and who goes where.

Left and right are paired by names alone here, so that the library, which pairs by geometry, is held against
something it does not know of.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path

import tomllib

HERE = Path(__file__).parent
USUAL = ("reflect-x", "reflect-y", "rot-180", "rot-120", "rot-90")
VERDICTS = ("exact", "approximate", "no", "cannot tell", "nothing")


@dataclass(frozen=True)
class Expectation:
    """One entry of expectations.toml; the top of that file says what the fields mean."""

    files: tuple[str, ...]
    kind: str
    has: Mapping[str, str]
    sides: tuple[tuple[str, str], ...] = ()
    mirror: str = "reflect-y"
    why: str = ""

    def __post_init__(self) -> None:
        wrong = [
            part for verdict in self.has.values() for part in verdict.split("|") if part not in VERDICTS
        ]
        if wrong:
            raise ValueError(f"{self.files[0]}: expected verdicts of {VERDICTS}, got {wrong}")

    def matches(self, key: str) -> bool:
        return any(fnmatchcase(key, pattern) for pattern in self.files)

    def image(self, name: str) -> str:
        """The name that takes the place of another when left and right change sides."""
        for one, other in self.sides:
            found = re.search(f"{_word(one)}|{_word(other)}", name)
            if found is not None:
                token = other if re.fullmatch(_word(one), found[0]) else one
                return name[: found.start()] + token.removeprefix("^") + name[found.end() :]
        return name

    def complaints(self, verdicts: Mapping[str, str], images: Sequence[Mapping[str, str]]) -> list[str]:
        """What disagrees: verdicts by element, and images of named things under the mirror, kind by kind.

        Elements that nobody asks for are judged if they are expected. A name that has no counterpart
        (`left_camera`, or `left_hip_link` beside `right_hip`) may go anywhere.
        """
        said = [
            f"{element}: expected {self.has.get(element, 'no')}, got {verdict}"
            for element, verdict in verdicts.items()
            if element in self.has or element in USUAL
            if verdict not in self.has.get(element, "no").split("|")
        ]
        said += [
            f"{element}: expected {expected}, not found"
            for element, expected in self.has.items()
            if element not in verdicts and "no" not in expected.split("|")
        ]
        for table in images if self.sides else ():
            expected = {name: self.image(name) for name in table}
            said += [
                f"{self.mirror}: {name} goes to {image}, expected {expected[name]}"
                for name, image in table.items()
                if image != expected[name] and expected[name] in table
            ]
        return said


def _word(token: str) -> str:
    """A token as a word of a name: `left` in `left_hip`, not in `cleft`; `^l` at the beginning."""
    if token.startswith("^"):
        return f"^{re.escape(token[1:])}"
    before = "(?<![a-z])" if token[0].islower() else "(?<![A-Z])"
    after = "(?![a-z])" if token[-1].isalpha() else ""
    return before + re.escape(token) + after


def read(path: Path = HERE / "expectations.toml") -> list[Expectation]:
    """All expectations, in order: the first that matches a key is its own."""
    entries = tomllib.loads(path.read_text())["model"]
    return [
        Expectation(
            tuple(entry.pop("files")), sides=tuple(tuple(pair) for pair in entry.pop("sides", ())), **entry
        )
        for entry in entries
    ]


def expectation(key: str, all_of_them: list[Expectation]) -> Expectation | None:
    """The first entry that matches a key."""
    return next((entry for entry in all_of_them if entry.matches(key)), None)
