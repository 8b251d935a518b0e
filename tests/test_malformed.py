"""Malformed groups, representations and symmetries are refused at once, by a message that says what to do.

Every subject is called with each of its arguments wrong in every way of its kind, see malformed.py. What is
accepted is a result that is wrong in silence; what hangs is a day lost. The right call of every subject is
made as well: a call that is refused for another reason would prove nothing.
"""

import time

import numpy as np
import pytest
import torch

import tasks
from tests.malformed import (
    Argument,
    array,
    assert_refused,
    choice,
    count,
    each,
    element,
    flag,
    judge,
    names,
    number,
    optional,
    subject,
    tensor,
    thing,
)
from tests.networks import make_batch, make_symmetry
from torchrl_sym import PointGroup, Symmetry
from torchrl_sym import representations as r

K4, C3, MIRROR = PointGroup.klein_four(), PointGroup.rotation(3), PointGroup.reflection("y")
TURN, POLAR, SIGN = C3.matrices[1], r.polar(K4), r.pseudoscalar(K4)
SYMMETRY, BATCH = make_symmetry("K4"), make_batch()
ENV = tasks.make_env("cartpole", num_envs=2, num_threads=1)
SWAP = {"left": "-right", "right": "-left", "knee": "knee"}

k4, c3, mirror = (
    thing(group, representation=POLAR, name="klein_four", matrices=group.matrices)
    for group in (K4, C3, MIRROR)
)
polar = thing(POLAR, builder=r.polar, group=K4, matrices=POLAR.matrices)
another = {"of another group": r.polar(MIRROR)}
batch = thing(BATCH, **{"a plain dictionary": dict(BATCH.items()), "an entry": BATCH["observation"]})


def generators() -> Argument:
    """Not a mapping, or one in which a matrix is wrong."""
    other = {"scaled": 2 * TURN, "in single precision": TURN.float(), "moves the vertical": -torch.eye(3)}
    wrong = {
        f"a matrix, {label}": {"turn": value} for label, value in {**array(TURN).wrong, **other}.items()
    }
    one = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 0]], dtype=torch.float64)  # of turns by 1 rad
    turns = {f"turn {n}": torch.linalg.matrix_exp(n * one) for n in range(1, 1001)}
    wrong |= {"an irrational turn": {"turn": turns["turn 1"]}, "a thousand of them": turns}
    wrong |= {"None": None, "text": "turn", "a number": 3, "one matrix": TURN, "a list": [TURN]}
    return Argument({"turn": TURN}, wrong)


def maps(signed: bool = True) -> Argument:
    targets = SWAP if signed else {"left": "right", "right": "left", "knee": "knee"}
    wrong = {
        "nobody": targets | {"toe": "toe"},
        "unsigned": {name: name for name in targets} | {"left": "+right"},
        "missing": {"left": "left"},
        "colliding": targets | {"left": "knee"},
        "numbers": {"left": 1, "right": 0, "knee": 2},
        "Nones": dict.fromkeys(targets),
        "a list": list(targets),
        "text": "left",
        "None": None,
    }
    wrong |= {} if signed else {"signed": SWAP}
    outer = {
        "None": None,
        "text": "left",
        "a list": [targets],
        "empty": {},
        "of nobody": {"reflect-q": targets},
    }
    return Argument({"reflect-y": targets}, outer | {k: {"reflect-y": v} for k, v in wrong.items()})


def keys(right: object = "observation") -> Argument:
    """Names of entries of a batch, written in every way that is none."""
    wrong = {
        "None": None,
        "a number": 3,
        "empty": "",
        "an empty tuple": (),
        "a tuple with a number": ("a", 3),
        "a tuple with nothing": ("a", ""),
        "a next entry": ("next", "observation"),
        "next itself": "next",
        "next in a tuple": ("next",),
    }
    return Argument(right, wrong)


def declared(key: object = "observation", value: object = POLAR, **more: object) -> Symmetry:
    return Symmetry(K4, {key: value, "action": SIGN} | more)


def spelt_twice(key: object) -> Symmetry:
    return Symmetry(K4, {"a": SIGN, ("b", "c"): SIGN, key: POLAR})


other_spellings = Argument(
    "d", {repr(key): key for key in (("a",), ("b", ("c",)), (("b",), "c"), (("a",),))}
)
nothing = Argument(
    {"observation": POLAR}, {"empty": {}, "None": None, "a list": [POLAR], "text": "observation"}
)
points = [[1.0, 0.5], [1.0, -0.5], [2.0, 0.0]]
grid = torch.tensor([-0.1, 0.0, 0.1])
blown = {"a billion": 10**9, "a huge number": 10**5000, "a huge float": 1e300}
row = tensor(torch.ones(4, 3), wide=torch.ones(4, 4), scalar=torch.ones(()))

SUBJECTS = [
    # groups
    subject(
        "PointGroup",
        PointGroup,
        matrices=array(
            K4.matrices, scaled=2 * K4.matrices, open=C3.matrices[:2], many=torch.eye(3).expand(5000, 3, 3)
        ),
        names=optional(names(list(K4.names), ordered=True).but("one misspelt", "one text", text="abcd")),
    ),
    subject("reflection", PointGroup.reflection, axis=choice("x", vertical="z").but("a number")),
    subject("rotation", PointGroup.rotation, n=count(3, **{"too many": 121}, **blown)),
    subject("dihedral", PointGroup.dihedral, n=count(3, **{"too many": 121}, **blown)),
    subject(
        "generate",
        PointGroup.generate,
        generators=generators(),
        fixes_vertical=flag(True),
    ),
    subject("index", K4.index, element=element("reflect-x", 4)),
    subject(
        "subgroup",
        K4.subgroup,
        elements=names(["reflect-x", "rot-180"], beyond=[4], fractions=[0.5]).but("empty", "one twice"),
    ),
    # representations
    subject(
        "Representation",
        r.Representation,
        group=k4,
        matrices=array(POLAR.matrices, scaled=2 * POLAR.matrices),
    ),
    subject(
        "representation(x, g)",
        POLAR,
        x=row,
        g=element(
            "reflect-x",
            4,
            floats=torch.zeros(4),
            flags=torch.tensor([True] * 4),
            beyond=torch.full((4,), 4),
        ),
    ),
    subject("orbit of x", POLAR.orbit, x=row),
    subject("representation *", lambda times: POLAR * times, times=count(2, **blown)),
    subject("representation +", lambda other: POLAR + other, other=Argument(POLAR, another)),
    subject("restrict", POLAR.restrict, subgroup=mirror.but(**{"another group": C3})),
    *(
        subject(build.__name__, build, group=k4)
        for build in (r.scalar, r.pseudoscalar, r.polar, r.axial, r.planar, r.heading)
    ),
    subject("invariant", r.invariant, group=k4, dim=count(2, **blown)),
    subject("rotation_matrix", r.rotation_matrix, group=c3, action=choice("left")),
    subject("rotation_6d", r.rotation_6d, group=c3, action=choice("left"), layout=choice("rows")),
    subject("quaternion", r.quaternion, group=c3, action=choice("left"), scalar_last=flag(True)),
    subject(
        "signed_permutation",
        r.signed_permutation,
        group=mirror,
        names=names(list(SWAP), ordered=True),
        maps=maps(),
    ),
    subject(
        "permutation",
        r.permutation,
        group=mirror,
        names=names(list(SWAP), ordered=True),
        maps=maps(signed=False),
    ),
    subject(
        "points",
        r.points,
        group=mirror,
        positions=array(
            torch.tensor(points), **{"one point twice": torch.ones(2, 2), "off center": torch.ones(3, 2)}
        ),
        value=Argument(None, polar.but("None", **{"of another group": POLAR}).wrong),
        tolerance=number(1e-6),
    ),
    subject(
        "height_map",
        r.height_map,
        group=k4,
        x=array(grid, two=torch.ones(2, 2), same=torch.ones(3)),
        y=array(grid).but("one more dimension"),
    ),
    # symmetries
    subject("Symmetry", Symmetry, group=k4, representations=nothing, strict=flag(True)),
    subject("Symmetry, values", declared, value=polar.but(**another)),
    subject("Symmetry, keys", declared, key=keys()),
    subject("Symmetry, spellings", spelt_twice, key=other_spellings),
    subject("symmetry[key]", SYMMETRY.__getitem__, key=keys().but("a next entry", misspelt="observatoin")),
    subject(
        "require",
        SYMMETRY.require,
        keys=names(["observation"]).but("one twice", "one text", "empty"),
        reader=Argument("x", {}),
    ),
    subject(
        "elements",
        SYMMETRY.elements,
        elements=names(["reflect-x", "rot-180"], beyond=[4], word="al", fractions=[0.5]),
    ),
    subject("symmetry(td, g)", SYMMETRY, tensordict=batch, g=element("reflect-x", 4)),
    subject(
        "symmetry(td, g, keys)",
        lambda keys: SYMMETRY(BATCH, 1, keys=keys),
        keys=optional(names(["observation"]).but("one twice", "empty")),
    ),
    subject(
        "orbit of a batch",
        SYMMETRY.orbit,
        tensordict=batch,
        elements=optional(names(["reflect-x"]).but("one twice", beyond=[4], fractions=[0.5])),
        keys=optional(names(["observation"]).but("one twice", "empty")),
    ),
    subject(
        "check_specs", ENV.symmetry.check_specs, env=thing(ENV, spec=ENV.observation_spec, task=ENV.task)
    ),
]


@each(SUBJECTS)
def test_malformed_arguments_are_refused(tried):
    assert_refused(tried)


def test_what_can_be_taken_exactly_is_taken():
    three = PointGroup.rotation(3)
    for n in (3.0, np.int32(3), np.float64(3.0), torch.tensor(3), torch.tensor(3.0), np.array(3)):
        assert PointGroup.rotation(n) == three
        assert (r.scalar(three) * n).dim == r.invariant(three, n).dim == 3
        assert PointGroup.dihedral(n).index(n) == 3
    tables = [r.points(MIRROR, x).matrices for x in (points, np.array(points), torch.tensor(points))]
    assert torch.equal(tables[0], tables[1]) and torch.equal(tables[0], tables[2])
    assert r.points(MIRROR, points, tolerance=torch.tensor(1e-6)).dim == 3
    swap = dict.fromkeys(["left"], "right") | {"right": "left"}
    assert r.permutation(MIRROR, tuple(swap), {1: swap}).dim == 2
    assert SYMMETRY.elements({"rot-180"}) == SYMMETRY.elements(np.array(["rot-180"])) == [0, 3]
    assert Symmetry(K4, {("a", ("b",)): POLAR}, strict=np.True_).keys() == [("a", "b")]


def test_large_sums_take_linear_time():
    start = time.process_time()
    assert r.invariant(K4, 50_000).dim == 50_000
    assert time.process_time() - start < 8  # it is 18 where they are joined one by one


# The judge itself: each verdict can be reached.


def refuse(message: str) -> None:
    raise ValueError(message)


def endless() -> None:
    while True:
        pass


@pytest.mark.parametrize(
    ("call", "verdict"),
    [
        (lambda: PointGroup.rotation(0), "ours"),
        (lambda: None, "accepted"),
        (lambda: refuse("expected a number, got none; pass one"), "obscure"),  # by nobody of ours
        (lambda: PointGroup.generate(None).nothing, "ours"),
        (lambda: K4.nothing, "obscure"),
        (lambda: torch.zeros(2) @ torch.zeros(3), "obscure"),
        (lambda: refuse, "accepted"),
        (endless, "hanging"),
    ],
)
def test_judge(call, verdict, monkeypatch):
    monkeypatch.setattr("tests.malformed.PATIENCE", 0.1)
    assert judge(call)[0] == verdict


def test_unhelpful_messages_are_not_ours(monkeypatch):
    monkeypatch.setattr("tests.malformed.PACKAGES", __file__)
    assert judge(lambda: refuse("expected a number, got none"))[0] == "ours"
    assert judge(lambda: refuse("invalid"))[0] == "obscure"


def test_subjects_are_what_they_were():
    """Draws are seeded: a failure that is seen once is seen again."""
    labels = [label for tried in SUBJECTS for label, _ in tried.cases()]
    assert len(labels) > 600
    assert len({(tried.name, label) for tried in SUBJECTS for label, _ in tried.cases()}) == len(labels)
