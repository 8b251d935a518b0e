"""A symmetry as text: a table of every entry, and the code of its declaration.

Both are for review. The table says of each element where every entry of an image comes from; the code is
what a person would have written, and makes an equal symmetry.
"""

from __future__ import annotations

import json
import re
import textwrap
from collections.abc import Iterator, Mapping, Sequence

import torch
from tensordict import NestedKey
from torch import Tensor

from torchrl_sym.entries import path
from torchrl_sym.groups import PointGroup
from torchrl_sym.representations import Representation
from torchrl_sym.representations.blocks import join
from torchrl_sym.segments import Segment, factors, segments

Parts = Sequence[tuple[list[NestedKey], Representation]]
Labels = Mapping[NestedKey, Sequence[str]]
_WIDTH = 100


def table(group: PointGroup, parts: Parts, labels: Labels | None = None) -> str:
    """Every entry of every key, and what becomes it under each element.

    Args:
        group: the group.
        parts: keys that are mapped together, with their representation.
        labels: what entries are, by key; they may be missing.
    """
    lines = [f"Symmetry under {', '.join(group.names)}"]
    for keys, representation in parts:
        names = _labels(keys, representation, labels)
        lines += ["", f"{' and '.join(map(_shown, keys))}: {_count(representation.dim)}"]
        rows = [["", "", *group.names[1:]]]
        for segment in segments(representation, names):
            rows.append([_span(segment), segment.builder])
            for i in range(segment.start, segment.start + segment.size):
                rows.append([f"  {i}", names[i], *_sources(representation, i)])
        widths = [max(len(row[c]) for row in rows if c < len(row)) for c in range(group.order + 1)]
        lines += [
            "  ".join(f"{x:<{w}s}" for x, w in zip(row, widths, strict=False)).rstrip() for row in rows
        ]
    return "\n".join(lines)


def code(group: PointGroup, parts: Parts, strict: bool = True, labels: Labels | None = None) -> str:
    """Python that declares the symmetry, as the variable ``symmetry``.

    Args:
        group: the group.
        parts: keys that are mapped together, with their representation.
        strict: whether the symmetry is.
        labels: what entries are, by key; they may be missing.
    """
    writer = _Writer(group)
    entries = []
    for keys, representation in parts:
        names = ", ".join(map(_quoted, keys))
        key = names if len(keys) == 1 else f"Exchanged({names})"
        entries.append((key, writer.sum(keys, representation, _labels(keys, representation, labels))))
    body = "".join(f"        {key}: {text},\n" for key, text in entries)
    exchanged = any(len(keys) > 1 for keys, _ in parts)
    names = sorted({"PointGroup", "Symmetry"} | ({"Exchanged"} if exchanged else set()))
    made = f"group = {_group_code(group)}\n" + "".join(writer.definitions)
    options = "" if strict else "    strict=False,\n"
    symmetry = f"symmetry = Symmetry(\n    group,\n    {{\n{body}    }},\n{options})"
    imports = f"from torchrl_sym import {', '.join(names)}\n"
    used = sorted(writer.used, key=lambda name: (name[0].islower(), name))
    line = f"from torchrl_sym.representations import {', '.join(used)}"
    if len(line) > _WIDTH:
        line = f"from torchrl_sym.representations import (\n    {_wrapped(used, 4).strip()},\n)"
    imports += f"{line}\n"
    if "torch." in made + symmetry:
        imports = "import torch\n\n" + imports
    return f"{imports}\n{made}\n{symmetry}"


class _Writer:
    """Writes representations, each permutation once."""

    def __init__(self, group: PointGroup) -> None:
        self.group = group
        self.used: set[str] = set()
        self.definitions: list[str] = []
        self.known: list[tuple[Tensor, str]] = []

    def sum(self, keys: list[NestedKey], representation: Representation, labels: Sequence[str]) -> str:
        """All pieces, one a line, with the entries they are for."""
        stem = re.sub(r"\W+", "_", "_".join(path(keys[0])))
        pieces = segments(representation, labels)
        texts = [self.piece(piece, f"{stem}_{piece.start}", labels) for piece in pieces]
        lines = []
        for text, run in _runs(texts, pieces):
            times = f" * {len(run)}" if len(run) > 1 else ""
            last = run[-1]
            lines.append(f"{text}{times}  # {_span(run[0], last.start + last.size)}")
        if len(pieces) == 1:
            whole = texts[0]
        else:
            whole = "(\n            " + "\n            + ".join(lines) + "\n        )"
        shape = representation.event_shape
        return whole if len(shape) == 1 else f"{whole}.unflatten({shape})"

    def piece(self, piece: Segment, name: str, labels: Sequence[str]) -> str:
        """The call that makes a piece; permutations, items and matrices get a variable."""
        if piece.builder in ("signed_permutation", "items", "Representation"):
            for matrices, variable in self.known:
                if matrices.shape == piece.matrices.shape and torch.equal(matrices, piece.matrices):
                    return variable
            self.known.append((piece.matrices, name))
            names = _names(labels, piece.start, piece.size)
            self.definitions.append(f"{name} = {self.definition(piece, names)}\n")
            return name
        self.used.add(piece.builder)
        call = f"{piece.builder}(group{', ' + piece.arguments if piece.arguments else ''})"
        return f"{call}.flatten()" if piece.builder == "rotation_matrix" else call

    def definition(self, piece: Segment, names: Sequence[str]) -> str:
        """What a variable is."""
        if piece.builder == "Representation":
            self.used.add("Representation")
            return f"Representation(group, {_tensor(piece.matrices)})"
        if piece.builder == "items":
            places, value = factors(piece.matrices, piece.value)
            items = [f"item {i}" for i in range(len(places[0]))]
            self.used.add("items")
            inner = [self.inline(p) for p in segments(Representation(self.group, value))]
            parts = textwrap.indent(f"{self.maps(places, items)},\n{' + '.join(inner)},\n", "    ")
            return f"items(\n{parts}).flatten()"
        return self.maps(piece.matrices, names)

    def inline(self, piece: Segment) -> str:
        """A piece of an item, without a variable."""
        if piece.builder in ("signed_permutation", "items"):
            return self.maps(piece.matrices, [f"part {i}" for i in range(piece.size)])
        if piece.builder == "Representation":
            return self.definition(piece, [])
        return self.piece(piece, "", [])

    def maps(self, matrices: Tensor, names: Sequence[str]) -> str:
        """A permutation of names, with signs if there are any."""
        builder = "signed_permutation" if (matrices < 0).any() else "permutation"
        self.used.add(builder)
        maps = []
        for g in _generators(self.group):
            pairs = []
            for i, name in enumerate(names):  # where entry i goes
                j = int(matrices[g][:, i].abs().argmax())
                sign = "-" * bool(matrices[g][j, i] < 0)
                pairs.append(f'"{name}": "{sign}{names[j]}"')
            maps.append(f'        "{self.group.names[g]}": {{{_wrapped(pairs, 12)}}},\n')
        listed = _wrapped([f'"{name}"' for name in names], 8)
        return f"{builder}(\n    group,\n    [{listed}],\n    {{\n{''.join(maps)}    }},\n)"


def _runs(texts: list[str], pieces: list[Segment]) -> Iterator[tuple[str, list[Segment]]]:
    start = 0
    for i in range(1, len(texts) + 1):
        if i == len(texts) or texts[i] != texts[start]:
            yield texts[start], pieces[start:i]
            start = i


def _generators(group: PointGroup) -> list[int]:
    """Elements that generate the group, few of them; none for the group of the identity alone."""
    chosen: list[int] = []
    reached = 1
    for g in range(1, group.order):
        order = group.subgroup([*chosen, g]).order
        if order > reached:
            chosen.append(g)
            reached = order
    return chosen


def _names(labels: Sequence[str], start: int, size: int) -> list[str]:
    """Names of entries: what they are where that is told apart and no sign is in front, or numbers."""
    names = list(labels[start : start + size]) or [""] * size
    plain = all(names) and len(set(names)) == size
    plain = plain and not any(n.startswith("-") or '"' in n or "\\" in n for n in names)
    return names if plain else [f"entry {start + i}" for i in range(size)]


def _labels(keys: list[NestedKey], representation: Representation, labels: Labels | None) -> list[str]:
    """What the entries are; entries of several keys begin with theirs."""
    labels = labels or {}
    if len(keys) == 1:
        return list(labels.get(keys[0], ())) or [""] * representation.dim
    each = representation.dim // len(keys)
    known = [list(labels.get(key, ())) for key in keys]
    if all(known):
        return [f"{_shown(k)} {x}".strip() for k, names in zip(keys, known, strict=True) for x in names]
    return [f"{_shown(key)}[{i}]" for key in keys for i in range(each)][: representation.dim]


def _sources(representation: Representation, i: int) -> list[str]:
    """For each element but the identity, what entry i of the image is."""
    index, weight = join(representation.blocks).terms
    cells = []
    for g in range(1, len(index)):
        terms = [(int(j), float(w)) for j, w in zip(index[g, i], weight[g, i], strict=True) if w != 0]
        cells.append(" ".join(_term(j, w, k == 0) for k, (j, w) in enumerate(terms)))
    return cells


def _term(j: int, w: float, first: bool) -> str:
    sign = ("-" if w < 0 else "") if first else ("- " if w < 0 else "+ ")
    return f"{sign}[{j}]" if abs(w) == 1 else f"{sign}{abs(w):.3g} [{j}]"


def _count(entries: int) -> str:
    return "1 entry" if entries == 1 else f"{entries} entries"


def _span(segment: Segment, stop: int | None = None) -> str:
    stop = segment.start + segment.size if stop is None else stop
    return f"{segment.start}" if stop - segment.start == 1 else f"{segment.start}-{stop - 1}"


def _shown(key: NestedKey) -> str:
    return key if isinstance(key, str) else repr(key)


def _quoted(key: NestedKey) -> str:
    return json.dumps(key) if isinstance(key, str) else f"({', '.join(map(json.dumps, key))})"


def _wrapped(items: Sequence[str], indent: int) -> str:
    """Comma-separated, in lines of a readable length."""
    lines, line = [], ""
    for item in items:
        if line and len(line) + len(item) > _WIDTH - indent:
            lines.append(line.rstrip())
            line = ""
        line += f"{item}, "
    lines.append(line.rstrip().removesuffix(","))
    if len(lines) == 1:
        return lines[0]
    space = "\n" + " " * indent
    return space + space.join(lines) + ",\n" + " " * (indent - 4)


def _tensor(matrices: Tensor) -> str:
    return f"torch.tensor({matrices.tolist()}, dtype=torch.float64)"


def _group_code(group: PointGroup) -> str:
    order = group.order
    known = {
        "PointGroup.trivial()": PointGroup.trivial,
        'PointGroup.reflection("x")': lambda: PointGroup.reflection("x"),
        'PointGroup.reflection("y")': lambda: PointGroup.reflection("y"),
        "PointGroup.klein_four()": PointGroup.klein_four,
        f"PointGroup.rotation({order})": lambda: PointGroup.rotation(order),
    }
    if order % 2 == 0:
        known[f"PointGroup.dihedral({order // 2})"] = lambda: PointGroup.dihedral(order // 2)
    for text, make in known.items():
        if make() == group:
            return text
    return f"PointGroup({_tensor(group.matrices)}, {list(group.names)!r})"
