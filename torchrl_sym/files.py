"""The file format of a symmetry: one small text that a person can read, check and keep beside a policy.

A symmetry is found once, from a model or an environment, and then used where neither may be installed: on
a cluster, in another trainer, beside a policy on a robot. What is written is therefore what acts, not where
it came from: the group's names and matrices, and for every entry its key, its event dimensions and its
blocks. Under an element, each component of the image is written by where it comes from:

    "reflect-y": "0 -1 2 6..8 3..5"           a signed permutation: y[1] = -x[1], y[3] = x[6], ...
    "rot-120": ["-0.5*0 -0.866*1", ...]       sums of terms:        y[0] = -0.5 x[0] - 0.866 x[1]

Numbers are written such that they are read back to the last bit. What is read is checked like what a person
declares: matrices that are no group, or no representation of it, are refused.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import torch
from tensordict import NestedKey
from torch import Tensor

from torchrl_sym import checks
from torchrl_sym.entries import Exchanged
from torchrl_sym.groups import PointGroup
from torchrl_sym.representations import Representation
from torchrl_sym.representations.blocks import Block, Mixing, SignedPermutation

FORMAT, VERSION = "torchrl_sym symmetry", 1

_PERMUTATION, _SUMS = "signed permutation", "sums"
_PLACES = re.compile(r"(-?)(\d{1,12})(?:\.\.(\d{1,12}))?")  # -4, or 6..8
_TERM = re.compile(r"([^*\s]+)\*(\d{1,12})")  # -0.5*0


def write(
    file: str | os.PathLike[str],
    group: PointGroup,
    parts: Iterable[tuple[list[NestedKey], Representation]],
    strict: bool,
) -> None:
    """Write a symmetry: its parts are keys, several where they change places, and their representation.

    Raises:
        FileNotFoundError: the path is that of a folder, or in none.
    """
    target = _path(file)
    if target.is_dir() or not target.parent.is_dir():
        raise FileNotFoundError(f"path: expected a file in a folder that exists, got {str(target)!r}")
    matrices = (group.matrices + 0.0).tolist()  # no -0.0
    elements = dict(zip(group.names, matrices, strict=True))
    entries = [
        {
            "keys": [name if isinstance(name, str) else list(name) for name in names],
            "event_shape": list(representation.event_shape),
            "blocks": [_written(block, group) for block in representation.blocks],
        }
        for names, representation in parts
    ]
    content = {
        "format": FORMAT,
        "version": VERSION,
        "group": elements,
        "strict": strict,
        "entries": entries,
    }
    text = json.dumps(content, indent=1, ensure_ascii=False)
    # rows of numbers on one line; a line break inside brackets is never part of a name
    text = re.sub(r'\[\n[^\[\]{}"]*\]', lambda row: f"[{' '.join(row[0][1:-1].split())}]", text)
    target.write_text(text + "\n", encoding="utf-8")


def read(
    file: str | os.PathLike[str],
) -> tuple[PointGroup, dict[NestedKey | Exchanged, Representation], bool]:
    """Group, representations and strictness of a written symmetry.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no symmetry, one of a later format, or damaged; the message says which and where.
    """
    source = _path(file)
    if not source.is_file():
        raise FileNotFoundError(f"expected a file that Symmetry.save wrote, but {source} is none")
    try:
        content = json.loads(source.read_bytes().decode("utf-8"))
    except (ValueError, RecursionError) as error:
        raise ValueError(
            f"{source}: expected a text that Symmetry.save wrote, got another file, or only a part of one; "
            f"{error}"
        ) from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise ValueError(
            f"{source}: expected a text that Symmetry.save wrote, which begins with "
            f'"format": "{FORMAT}", got another'
        )

    try:
        version = checks.whole("version", content.get("version"), 1)
        if version <= VERSION:
            return _read(content)
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        reason = error.args[0] if error.args else error
        raise ValueError(f"{source} is damaged: {reason}; save the symmetry anew") from error
    raise ValueError(
        f"{source}: expected format {VERSION} or an earlier one, got {version}; update torchrl_sym"
    )


def _path(file: str | os.PathLike[str]) -> Path:
    return Path(checks.instance("path", file, (str, os.PathLike)))


def _read(content: dict[str, Any]) -> tuple[PointGroup, dict[NestedKey | Exchanged, Representation], bool]:
    elements, strict, entries = checks.entries("the file", content, "group", "strict", "entries")
    matrices = [
        checks.array(f"group[{name!r}]", matrix)
        for name, matrix in checks.mapping("group", elements, "names to matrices").items()
    ]
    if any(matrix.shape != (3, 3) for matrix in matrices) or not matrices:
        raise ValueError(
            f"group: expected 3 x 3 matrices, got {[tuple(matrix.shape) for matrix in matrices]}"
        )
    group = PointGroup(torch.stack(matrices), list(elements))

    representations: dict[NestedKey | Exchanged, Representation] = {}
    for number, entry in enumerate(checks.sequence("entries", entries, "entries")):
        keys, shape, blocks = checks.entries(f"entries[{number}]", entry, "keys", "event_shape", "blocks")
        names = [_key(key) for key in _list("keys", keys)]
        key = Exchanged(*names) if len(names) != 1 else names[0]
        if key in representations:
            raise ValueError(f"expected distinct keys, got {key!r} twice")
        try:
            representations[key] = _representation(group, shape, _list("blocks", blocks))
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"entry {key!r}: {error.args[0]}") from error
    return group, representations, checks.flag("strict", strict)


def _key(written: Any) -> NestedKey:
    return checks.key("keys", tuple(written) if isinstance(written, list) else written)


def _list(name: str, value: Any) -> list[Any]:
    return checks.sequence(name, checks.instance(name, value, list))


def _representation(group: PointGroup, shape: Any, blocks: list[Any]) -> Representation:
    """What the blocks make, if it is a representation."""
    ready = [_block(block, group) for block in blocks]
    for block in ready:
        Representation.from_blocks(group, list(_components(block)))  # refuses what is none
    whole = Representation.from_blocks(group, ready, check=False)
    return whole.unflatten(_list("event_shape", shape))


def _components(block: Block) -> Iterator[Block]:
    """A mixing block cut into entries that mix with one another, since to check n takes n^3 operations."""
    if isinstance(block, SignedPermutation):
        yield block
        return
    index, weight = block.terms
    label = block.components()
    for first in label.unique().tolist():
        rows = (label == first).nonzero()[:, 0]
        place = torch.full((block.dim,), -1, device="cpu")
        place[rows] = torch.arange(len(rows), device="cpu")
        inside = place[index[:, rows]]
        if (inside < 0).any():
            raise ValueError("not a representation: an element mixes entries that no other mixes back")
        yield Mixing(inside, weight[:, rows])


# One block: its size, its kind, and for every element where the entries of its image come from.


def _written(block: Block, group: PointGroup) -> dict[str, Any]:
    if isinstance(block, SignedPermutation):
        kind, parts = _PERMUTATION, zip(block.index.tolist(), block.sign.tolist(), strict=True)
        images = [" ".join(_runs(index, sign)) for index, sign in parts]
    else:
        kind, parts = _SUMS, zip(*(terms.tolist() for terms in block.terms), strict=True)
        images = [[_sum(*terms) for terms in zip(index, weight, strict=True)] for index, weight in parts]
    return {"size": block.dim, "kind": kind, "from": dict(zip(group.names, images, strict=True))}


def _block(written: Any, group: PointGroup) -> Block:
    size, kind, sources = checks.entries("a block", written, "size", "kind", "from")
    size = checks.whole("size", size, 0)
    names = list(checks.mapping("from", sources, "elements to sources"))
    if sorted(names) != sorted(group.names):
        raise ValueError(f"expected the elements {list(group.names)}, got {names}")
    images = [sources[name] for name in group.names]

    if checks.one_of("kind", kind, (_PERMUTATION, _SUMS)) == _PERMUTATION:
        parts = [_places(checks.instance("a permutation", image, str), size) for image in images]
        index, sign = (torch.stack(tensors) for tensors in zip(*parts, strict=True))
        return SignedPermutation(index, sign)
    rows = [
        _terms(checks.instance("a sum", row, str), size) for image in images for row in _rows(image, size)
    ]
    count = max(1, *(len(row) for row in rows)) if rows else 1
    padded = [row + [(0, 0.0)] * (count - len(row)) for row in rows]
    shape = (group.order, size, count)
    index = torch.tensor([[i for i, _ in row] for row in padded], dtype=torch.int64, device="cpu")
    weight = torch.tensor([[w for _, w in row] for row in padded], dtype=torch.float64, device="cpu")
    return Mixing(index.view(shape), weight.view(shape))


def _runs(index: list[int], sign: list[int]) -> Iterator[str]:
    """Source positions, runs of three or more up or down by one as first..last."""
    start = 0
    while start < len(index):
        end, step = start + 1, index[start + 1] - index[start] if start + 1 < len(index) else 0
        while (
            end < len(index) and abs(step) == 1 == index[end] * step - index[end - 1] * step
            and sign[end] == sign[start]
        ):  # fmt: skip
            end += 1
        end = end if end - start > 2 else start + 1
        minus = "-" if sign[start] < 0 else ""
        yield f"{minus}{index[start]}" + (f"..{index[end - 1]}" if end - start > 1 else "")
        start = end


def _places(text: str, size: int) -> tuple[Tensor, Tensor]:
    """Source positions and signs, ``(size,)``."""
    runs, signs = [torch.zeros(0, dtype=torch.int64)], [torch.zeros(0, dtype=torch.int64)]
    total = 0
    for token in text.split():
        found = _PLACES.fullmatch(token)
        minus, first, last = found.groups() if found else ("", "", None)
        ends = (int(first), int(last or first)) if found else (size, size)
        total += abs(ends[1] - ends[0]) + 1
        if max(ends) >= size or total > size:
            raise ValueError(
                f"expected {size} places from 0 to {size - 1}, got {checks.shown(token)} among them"
            )
        step = 1 if ends[1] >= ends[0] else -1
        runs.append(torch.arange(ends[0], ends[1] + step, step, device="cpu"))
        signs.append(torch.full_like(runs[-1], -1 if minus else 1))
    if total != size:
        raise ValueError(f"expected {size} places, got {total}")
    return torch.cat(runs), torch.cat(signs)


def _sum(index: list[int], weight: list[float]) -> str:
    return " ".join(f"{w!r}*{i}" for i, w in zip(index, weight, strict=True) if w != 0)


def _rows(image: Any, size: int) -> list[Any]:
    rows = _list("sums", image)
    if len(rows) != size:
        raise ValueError(f"expected {size} sums, got {len(rows)}")
    return rows


def _terms(text: str, size: int) -> list[tuple[int, float]]:
    terms = []
    for token in text.split():
        found = _TERM.fullmatch(token)
        if found is None or int(found[2]) >= size:
            raise ValueError(
                f"expected weight*place, a place from 0 to {size - 1}, got {checks.shown(token)}"
            )
        terms.append((int(found[2]), checks.real("a weight", float(found[1]))))
    return [term for term in terms if term[1] != 0]
