"""docs/models.md: a table for each kind of robot, what disagrees, and mistakes found in public models."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

import tomllib

from catalogue.examine import Row
from catalogue.expectations import HERE, Expectation, expectation
from catalogue.sources import Source

KINDS = ("Quadrupeds", "Humanoids and animals", "Arms and hands", "Drones", "Benchmarks")
OTHERS = "Others"
"""Heading of models of which nothing is expected."""
HEADER = """# Which symmetries public models have

Made by `python benchmarks/models.py --menagerie PATH`: `symmetries(model)` of every model that compiles, of
[mujoco_menagerie](https://github.com/google-deepmind/mujoco_menagerie) and of installed packages. *Exact*:
everything that was compared agrees to 1e-8. *Approximate*: the largest residual and where it is. Elements
that a model does not have are left out; where it has none, the column says why not the usual one. *Pose*:
the one that the group keeps, and where its axis stands if that is not the origin. Files of one folder that
agree share a row.

What each model ought to have is written down beside the program
([expectations.toml](../benchmarks/catalogue/expectations.toml)); left and right are paired there by names.
"""
BUGS = """## Asymmetries that look like mistakes

Found by the audit, judged by a person: both sides as they stand in the file, with the line.
"""
LONGEST = 110  # letters of a reason


def page(
    rows: Sequence[Row], expectations: list[Expectation], sources: Sequence[Source], versions: str
) -> str:
    """The whole page."""
    of_kind: dict[str, list[Row]] = {}
    for row in rows:
        entry = expectation(row.key, expectations)
        of_kind.setdefault(OTHERS if entry is None else entry.kind, []).append(row)
    parts = [HEADER, versions, _summary(rows, expectations)]
    for kind in (*KINDS, OTHERS):
        if kind in of_kind:
            parts += [f"## {kind}\n", _table(of_kind[kind], expectations)]
    return "\n".join([*parts, _disagreements(rows), BUGS, *bugs(sources)]).rstrip() + "\n"


def _summary(rows: Sequence[Row], expectations: list[Expectation]) -> str:
    whole = [row for row in rows if not row.error]
    expected = [row for row in whole if expectation(row.key, expectations) is not None]
    wrong = sum(bool(row.against) for row in expected)
    seconds = sorted(row.seconds for row in whole)
    spread = (
        f"{seconds[len(seconds) // 2]:.2g} s at the median, {seconds[-1]:.2g} s at most" if seconds else ""
    )
    return (
        f"{len(whole)} models; {len(expected)} of them with expectations, of which {wrong} are not met. "
        f"The search over all elements takes {spread}.\n"
    )


def _table(rows: Sequence[Row], expectations: list[Expectation]) -> str:
    lines = ["| model | exact | approximate | largest residual, or why not | pose |", "| --- " * 5 + "|"]
    for folder, group in groupby(rows, key=lambda row: row.key.rpartition("/")[0]):
        cells: dict[tuple[str, ...], list[str]] = {}
        for row in group:
            entry = expectation(row.key, expectations)
            usual = "reflect-y" if entry is None else entry.mirror
            name = row.key.rpartition("/")[2].removesuffix(".xml")
            cells.setdefault(_cells(row, usual), []).append(name + "*" * bool(row.stand_ins))
        lines += [f"| {folder}: {', '.join(names)} | {' | '.join(rest)} |" for rest, names in cells.items()]
    starred = "\n\\* some meshes of 4 MB and more were not at hand; small ones stand in for them.\n"
    return "\n".join(lines) + "\n" + starred * any(row.stand_ins for row in rows)


def _cells(row: Row, usual: str) -> tuple[str, ...]:
    if row.error:
        return "", "", _short(row.error), ""
    exact = [element for element, verdict in row.verdicts.items() if verdict == "exact"]
    near = [element for element, verdict in row.verdicts.items() if verdict == "approximate"]
    if not exact and not near:
        return "", "", _short(row.words.get(usual, "no candidate")), ""
    x, y = (round(value, 4) + 0.0 for value in row.axis)
    place = "" if x == y == 0.0 else f" about ({x:g}, {y:g})"
    worst = dict.fromkeys(row.worst[element] for element in near if element in row.worst)
    return ", ".join(exact), ", ".join(near), _short("; ".join(worst)), row.pose + place


def _short(text: str) -> str:
    text = text.removeprefix("not a symmetry").strip(" ()").replace("|", "\\|")
    return text if len(text) <= LONGEST else text[: LONGEST - 3].rsplit(" ", 1)[0] + " ..."


def _disagreements(rows: Sequence[Row]) -> str:
    said = [f"- {row.key}: {'; '.join(row.against[:3])}" for row in rows if row.against]
    return "\n".join(["## Against expectations\n", *(said or ["Nothing."]), ""])


def bugs(sources: Sequence[Source]) -> list[str]:
    """What looks like a mistake of others, with a note where the file does not say so any more."""
    roots = {source.name: source.root for source in sources}
    parts = []
    for bug in tomllib.loads((HERE / "asymmetries.toml").read_text())["bug"]:
        name, _, inside = bug["model"].partition("/")
        gone = name in roots and not still_there(roots[name] / inside, bug["quotes"])
        quotes = "\n".join(f"line {line}: {text}" for line, text in bug["quotes"])
        note = " (not in the version at hand)" if gone else ""
        parts.append(f"**{bug['model']}**: {bug['where']}.{note} {bug['why']}\n\n```\n{quotes}\n```\n")
    return parts


def still_there(path: Path, quotes: Sequence[tuple[int, str]]) -> bool:
    """Whether a file has all the quoted lines, wherever they stand by now."""
    if not path.exists():
        return False
    text = " ".join(path.read_text().split())
    return all(" ".join(quote.split()) in text for _, quote in quotes)
