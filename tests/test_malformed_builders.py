"""Malformed arguments of the builders for events of several dimensions, images and clocks."""

import math

import torch

from tests.malformed import (
    Argument,
    array,
    assert_refused,
    choice,
    count,
    each,
    number,
    optional,
    subject,
    thing,
)
from torchrl_sym import PointGroup
from torchrl_sym import representations as r

K4, C3, MIRROR = PointGroup.klein_four(), PointGroup.rotation(3), PointGroup.reflection("y")
POLAR = r.polar(K4)
LEGS = r.permutation(MIRROR, ["l", "r"], {"reflect-y": {"l": "r", "r": "l"}})
FORCES = r.items(LEGS, r.polar(MIRROR))

k4, mirror = (thing(group, representation=POLAR, name="klein_four") for group in (K4, MIRROR))
polar = thing(r.polar(MIRROR), builder=r.polar, group=K4).but("a list")
another = {"of another group": POLAR}


def sizes(right: tuple[int, ...], **more: object) -> Argument:
    wrong = {
        "None": None,
        "a number": 12,
        "text": "ab",
        "fractions": [0.5] * len(right),
        "NaN": [math.nan] * len(right),
        "negative": [-size for size in right],
        "too many": [*right, 7],
        "too few": right[:-1],
        "words": ["a"] * len(right),
    }
    return Argument(right, wrong | more)


def shifts() -> Argument:
    wrong = {
        f"a shift, {label}": {"reflect-y": value} for label, value in number(0.5, -math.inf).wrong.items()
    }
    wrong |= {"a third": {"reflect-y": 1 / 3}, "of nobody": {"reflect-q": 0.5}, "empty": {}}
    return Argument({"reflect-y": 0.5}, wrong | {"None": None, "a number": 0.5, "text": "reflect-y"})


SUBJECTS = [
    subject(
        "items",
        r.items,
        places=thing(LEGS, mixing=r.planar(C3), **another),
        value=Argument(
            r.polar(MIRROR),
            polar.but(**another).wrong
            | {
                "an empty list": [],
                "one too few": [r.polar(MIRROR)],
                "Nones": [None, None],
                "that differ": [r.polar(MIRROR), r.axial(MIRROR)],
                "of two sizes": [r.polar(MIRROR), r.planar(MIRROR)],
                "too large": r.invariant(MIRROR, 900_000),
            },
        ),
    ),
    subject(
        "image",
        r.image,
        group=k4,
        shape=sizes((4, 4, 2), **{"far too many": (10**4, 10**4, 3), "none": (0, 4, 2)}),
        layout=choice("HWC"),
        rows=choice("-x", diagonal="xy", sideways="right"),
        columns=choice("-y", diagonal="xy", same="x", vertical="z"),
        value=Argument(
            r.planar(K4),
            polar.but("None").wrong | {"of another group": r.planar(MIRROR), "of three": POLAR},
        ),
    ),
    subject("gait_clock", r.gait_clock, group=mirror, shifts=shifts()),
    subject(
        "height_map, order",
        r.height_map,
        group=k4,
        x=array(torch.tensor([-0.1, 0.0, 0.1])).but("another size", "one more dimension"),
        y=array(torch.tensor([-0.1, 0.0, 0.1])).but("another size", "one more dimension"),
        order=choice("xy", one="x"),
    ),
    subject("unflatten", FORCES.unflatten, shape=sizes((3, 2))),
    subject("leading", FORCES.leading, k=count(1, **{"too many": 3})),
    subject(
        "value of an image without channels",
        lambda value: r.image(K4, (4, 4), value=value),
        value=optional(Argument(r.scalar(K4), {"of two": r.planar(K4), "a number": 1})),
    ),
]


@each(SUBJECTS)
def test_malformed_arguments_are_refused(tried):
    assert_refused(tried)
