"""Symmetries as files: read back to the last bit, small, readable, and refused where something is wrong."""

import json
import re

import pytest
import torch
from tensordict import TensorDict

from tests.point_groups import GROUPS, random
from tests.test_representations import CASES, build
from torchrl_sym import Exchanged, PointGroup, Symmetry
from torchrl_sym.representations import (
    axial,
    gait_clock,
    height_map,
    image,
    invariant,
    items,
    permutation,
    polar,
    signed_permutation,
)

K4 = PointGroup.klein_four()
MIRROR = PointGroup.reflection("y")
HANDS = permutation(MIRROR, ["l", "r"], {"reflect-y": {"l": "r", "r": "l"}})


def reloaded(symmetry: Symmetry, tmp_path) -> Symmetry:
    symmetry.save(tmp_path / "symmetry.json")
    return Symmetry.load(tmp_path / "symmetry.json")


def assert_same(one: Symmetry, other: Symmetry) -> None:
    """Equal to the last bit, in what is declared and in what it does."""
    assert one.keys() == other.keys() and one.strict is other.strict
    assert one.group.names == other.group.names and torch.equal(one.group.matrices, other.group.matrices)
    for rho, same in zip(one.representations, other.representations, strict=True):
        assert rho.event_shape == same.event_shape
        assert [type(block) for block in rho.blocks] == [type(block) for block in same.blocks]
        for block, twin in zip(rho.blocks, same.blocks, strict=True):
            assert all(torch.equal(a, b) for a, b in zip(block.terms, twin.terms, strict=True))
        for dtype in (torch.float64, torch.float32):
            x = random(3, *rho.event_shape, dtype=dtype)
            assert torch.equal(rho.orbit(x), same.orbit(x))
            g = torch.arange(3) % one.group.order
            assert torch.equal(rho(x, g), same(x, g))


@pytest.mark.parametrize("group", GROUPS)
def test_every_representation_is_read_back_to_the_last_bit(tmp_path, group):
    own = {("built", name): build(name, group) for name, of in CASES if of == group}
    assert_same(symmetry := Symmetry(GROUPS[group], own), reloaded(symmetry, tmp_path))


def test_keys_companions_and_strictness(tmp_path):
    declared = {
        Exchanged(("left", "hand"), ("right", "hand")): items(HANDS, polar(MIRROR)),
        ("agents", "deep er", 'a "quoted" [\n 1,\n 2]'): axial(MIRROR),
        "Größe": invariant(MIRROR, 2),
        "action": signed_permutation(MIRROR, ["l", "r"], {"reflect-y": {"l": "-r", "r": "-l"}}),
    }
    symmetry = Symmetry(MIRROR, declared, strict=False)
    again = reloaded(symmetry, tmp_path)
    assert_same(symmetry, again)
    assert again.together([("left", "hand")]) == [("left", "hand"), ("right", "hand")]

    batch = TensorDict({"loc": random(4, 2), "unknown": random(4, 7), "action": random(4, 2)}, [4])
    batch["left"], batch["right"] = (TensorDict({"hand": random(4, 3, seed=k)}, [4]) for k in (1, 2))
    assert (again.orbit(batch) == symmetry.orbit(batch)).all()
    with pytest.raises(KeyError, match="does not know"):
        reloaded(Symmetry(MIRROR, declared), tmp_path).orbit(batch)


def test_a_file_is_small_and_readable(tmp_path):
    lines = torch.linspace(-1, 1, 64)
    action = signed_permutation(
        K4,
        ["lf", "rf", "lh", "rh"],
        {
            "reflect-y": {"lf": "-rf", "rf": "-lf", "lh": "-rh", "rh": "-lh"},
            "reflect-x": {"lf": "lh", "lh": "lf", "rf": "rh", "rh": "rf"},
        },
    )
    scan = height_map(K4, lines, lines)
    declared = {"observation": polar(K4) + scan, "action": action}
    assert_same(symmetry := Symmetry(K4, declared), reloaded(symmetry, tmp_path))

    text = (tmp_path / "symmetry.json").read_text()
    assert len(text) < 5_000  # 4,099 entries, 4 elements
    assert "mujoco" not in text
    assert '"reflect-y": "-1 -0 -3 -2"' in text  # left and right legs change places, and signs
    assert '"reflect-x": "2 3 0 1"' in text
    assert '"rot-180": "-0 -1 2 4098..3"' in text
    assert "[-1.0, 0.0, 0.0]" in text
    assert max(map(len, text.splitlines())) < 1_000


def test_a_large_vector_field_is_checked_in_no_time(tmp_path):
    group = PointGroup.rotation(3)
    agents = permutation(
        group,
        [f"{k}/{i}" for k in range(3) for i in range(200)],
        {"rot-120": {f"{k}/{i}": f"{(k + 1) % 3}/{i}" for k in range(3) for i in range(200)}},
    )
    assert_same(
        symmetry := Symmetry(group, {"action": items(agents, polar(group))}), reloaded(symmetry, tmp_path)
    )


def test_a_clock_beside_an_image(tmp_path):
    declared = {
        "observation": gait_clock(K4, {"reflect-y": 0.5, "reflect-x": 0.5}) + invariant(K4, 1),
        "pixels": image(K4, (3, 8, 6), "CHW"),
    }
    assert_same(symmetry := Symmetry(K4, declared), reloaded(symmetry, tmp_path))


def test_an_existing_file_is_replaced(tmp_path):
    for size in (90, 2):
        Symmetry(K4, {"action": invariant(K4, size)}).save(str(tmp_path / "symmetry.json"))
    assert Symmetry.load(str(tmp_path / "symmetry.json"))["action"].dim == 2


# Files that are wrong: a valid one, and what is done to it.


def saved(tmp_path) -> dict:
    group = PointGroup.rotation(3)
    shift = {"rot-120": {"a": "b", "b": "c", "c": "a"}}
    declared = {"observation": polar(group), "action": permutation(group, ["a", "b", "c"], shift)}
    Symmetry(group, declared).save(tmp_path / "symmetry.json")
    return json.loads((tmp_path / "symmetry.json").read_text())


def change(content: dict, path: str, value: object) -> None:
    *parents, last = [int(part) if part.isdigit() else part for part in path.split("/")]
    for part in parents:
        content = content[part]
    content[last] = value


SUMS, PLACES = "entries/0/blocks/0/from/rot-120", "entries/1/blocks/0/from/rot-120"
DAMAGE = {
    "another format": ("format", "something else", "which begins with"),
    "no format": ("format", None, "which begins with"),
    "a newer version": ("version", 2, "update torchrl_sym"),
    "no version": ("version", None, "damaged.*version.*whole number"),
    "version 0": ("version", 0, "damaged.*version.*at least 1"),
    "strict in words": ("strict", "no", "damaged.*strict.*True or False"),
    "no group": ("group", [], "damaged.*group: expected a mapping"),
    "an empty group": ("group", {}, "damaged.*3 x 3"),
    "a matrix of words": ("group/rot-120", "abc", "damaged.*rot-120"),
    "a small matrix": ("group/rot-120", [[1.0]], "damaged.*3 x 3"),
    "a matrix that is none": ("group/rot-120", [[2.0, 0, 0], [0, 1, 0], [0, 0, 1]], "damaged.*orthogonal"),
    "a group that is none": ("group/rot-120", [[-1.0, 0, 0], [0, 1, 0], [0, 0, 1]], "damaged.*closed"),
    "entries in words": ("entries", "all", "damaged.*entries"),
    "no entries": ("entries", [], "at least one key"),
    "an entry in words": ("entries/0", "all", r"damaged.*entries\[0\]"),
    "no keys": ("entries/0/keys", [], "damaged.*Exchanged: expected two"),
    "keys in words": ("entries/0/keys", "observation", "damaged.*keys: expected list"),
    "a key that is a number": ("entries/0/keys", [3], "damaged.*expected a key"),
    "a key of numbers": ("entries/0/keys", [[1]], "damaged.*expected a key"),
    "a key twice": ("entries/0/keys", ["action"], "damaged.*'action' twice"),
    "a shape in words": ("entries/0/event_shape", "3", "damaged.*event_shape: expected list"),
    "a wrong shape": ("entries/0/event_shape", [4], "damaged.*'observation'.*multiply to 3"),
    "no blocks": ("entries/0/blocks", [], "damaged.*'observation'.*multiply to 0"),
    "an unknown kind": ("entries/0/blocks/0/kind", "sumz", "damaged.*did you mean 'sums'"),
    "a size in words": ("entries/0/blocks/0/size", "3", "damaged.*size: expected a whole number"),
    "a large size": ("entries/1/blocks/0/size", 10**12, "damaged.*expected 1000000000000 places, got 3"),
    "an element too many": ("entries/0/blocks/0/from/more", [], "damaged.*expected the elements"),
    "a sum too few": (SUMS, ["1.0*0"], "damaged.*expected 3 sums, got 1"),
    "sums in words": (SUMS, "1*0", "damaged.*sums: expected list"),
    "a sum of no terms": (SUMS, ["", "1*1", "1*2"], "damaged.*'observation'.*orthogonal"),
    "a weight in words": (SUMS, ["one*0", "1*1", "1*2"], "damaged.*one"),
    "a weight that is none": (SUMS, ["nan*0", "1*1", "1*2"], "damaged.*a weight: expected a finite"),
    "a place beyond": (SUMS, ["1.0*3", "1*1", "1*2"], "damaged.*place from 0 to 2, got '1.0\\*3'"),
    "a sum that scales": (SUMS, ["2.0*0", "1.0*1", "1.0*2"], "damaged.*orthogonal.*'rot-120'"),
    "a sum that is no turn": (SUMS, ["1.0*0", "1.0*1", "1.0*2"], "damaged.*not a representation"),
    "entries that are not mixed back": (SUMS, ["1.0*2", "1.0*0", "1.0*1"], "damaged.*not a representation"),
    "places in a list": (PLACES, [1, 2, 0], "damaged.*a permutation: expected str"),
    "places in words": (PLACES, "one two three", "damaged.*got 'one' among them"),
    "a place too many": (PLACES, "2 0 1 1", "damaged.*expected 3 places"),
    "a place too few": (PLACES, "2 0", "damaged.*expected 3 places, got 2"),
    "a place out of range": (PLACES, "2 0 3", "damaged.*from 0 to 2, got '3'"),
    "an endless run": (PLACES, "0..999999999999", "damaged.*from 0 to 2"),
    "a place twice": (PLACES, "2 0 0", "damaged.*'action'.*orthogonal"),
    "another permutation": (PLACES, "1 0 2", "damaged.*'action'.*not a representation"),
    "another sign": (PLACES, "2 -0 1", "damaged.*'action'.*not a representation"),
    "a key of the future": ("entries/0/keys", [["next", "observation"]], "without 'next'"),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_what_is_wrong_with_a_file_is_said(tmp_path, damage):
    path, value, message = DAMAGE[damage]
    content = saved(tmp_path)
    change(content, path, value)
    (tmp_path / "symmetry.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match=message):
        Symmetry.load(tmp_path / "symmetry.json")


@pytest.mark.parametrize("missing", ["version", "group", "strict", "entries", "keys"])
def test_a_missing_part_is_named(tmp_path, missing):
    content = saved(tmp_path)
    (content["entries"][0] if missing == "keys" else content).pop(missing)
    (tmp_path / "symmetry.json").write_text(json.dumps(content))
    with pytest.raises(ValueError, match=f"damaged.*{missing}"):
        Symmetry.load(tmp_path / "symmetry.json")


def test_a_half_written_file_is_refused(tmp_path):
    saved(tmp_path)
    text = (tmp_path / "symmetry.json").read_text()
    for length in range(0, len(text) - 2, 97):
        (tmp_path / "half.json").write_text(text[:length])
        with pytest.raises(
            ValueError, match=re.escape(str(tmp_path / "half.json")) + ".*only a part of one"
        ):
            Symmetry.load(tmp_path / "half.json")


@pytest.mark.parametrize("content", [b"\x80\x04\x95weights", b"[" * 100_000, b"3", b'"text"', b"[]", b"{}"])
def test_another_file_is_refused(tmp_path, content):
    (tmp_path / "other").write_bytes(content)
    with pytest.raises(ValueError, match="expected a text that"):
        Symmetry.load(tmp_path / "other")


def test_no_file_is_refused(tmp_path):
    for path in (tmp_path, tmp_path / "missing.json"):
        with pytest.raises(FileNotFoundError, match="expected a file that"):
            Symmetry.load(path)


def test_a_place_where_no_file_can_be_is_refused(tmp_path):
    symmetry = Symmetry(K4, {"action": polar(K4)})
    for path in (tmp_path, tmp_path / "missing" / "symmetry.json", ""):
        with pytest.raises(FileNotFoundError, match="expected a file in a folder"):
            symmetry.save(path)
