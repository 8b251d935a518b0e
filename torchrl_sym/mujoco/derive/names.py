"""Names as a hint: left goes to right, front to hind.

Geometry decides where a part goes. Where it cannot, as for the fingers of a closed gripper or two equal
cubes, the names that people give their parts do.
"""

from __future__ import annotations

import functools
import re

import numpy as np

from torchrl_sym.mujoco.model.types import Array

_SIDES = (("left", "right"), ("l", "r"))
_ENDS = (("front", "hind"), ("front", "rear"), ("front", "back"), ("fore", "hind"), ("f", "h"), ("f", "b"))
_LEGS = ("fl", "fr", "hl", "hr", "rl", "rr", "bl", "br", "lf", "rf", "lh", "rh", "lb", "rb", "lr")
# words: a run of small letters, a capital and what follows it, or capitals: left_hip, LeftHip, LF_HIP
_WORD = re.compile(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|[A-Z]")


def exchanged(matrix: Array) -> tuple[bool, bool]:
    """Whether an isometry exchanges left and right, and front and hind, of a robot that looks along x."""
    det, trace = np.linalg.det(matrix), float(np.trace(matrix[:2, :2]))
    if det < 0:
        normal_along_y = float(matrix[1, 1]) < float(matrix[0, 0])
        return normal_along_y, not normal_along_y
    half = trace < -1.9
    return half, half


@functools.lru_cache(maxsize=1 << 14)  # asked for the same parts at every pose
def counterparts(name: str, sides: bool, ends: bool) -> tuple[str, ...]:
    """Names that the image of a part called so may have; empty if the name says nothing.

    Example:
        >>> counterparts("left_hip", sides=True, ends=False)
        ('right_hip',)
        >>> counterparts("LF_KFE", sides=True, ends=False)
        ('RF_KFE',)
        >>> counterparts("torso", sides=True, ends=True)
        ()
    """
    found: list[str] = []
    for end in dict.fromkeys(other for pair in _ENDS for other in pair[1:] if len(other) > 1):
        image = _WORD.sub(lambda match, end=end: _cased(match[0], sides, ends, end), name)
        if image != name and image not in found:
            found.append(image)
    return tuple(found)


def _cased(word: str, sides: bool, ends: bool, end: str) -> str:
    image = _swapped(word.lower(), sides, ends, end)
    if word.isupper():
        return image.upper()
    return image.capitalize() if word[0].isupper() else image


def _swapped(word: str, sides: bool, ends: bool, end: str) -> str:
    if word in _LEGS:  # two letters, one for the side and one for the end
        rear = end[0] if "f" in word else ""
        swaps = dict(zip("lr", "rl", strict=True)) if sides else {}
        if word[0] in "fhb" or (word[0] == "r" and word[1] in "lr"):  # the end comes first: fl, rl
            return _end_letter(word[0], ends, rear) + swaps.get(word[1], word[1])
        return swaps.get(word[0], word[0]) + _end_letter(word[1], ends, rear)
    for one, other in _SIDES:
        if sides and word in (one, other):
            return other if word == one else one
    for one, other in _ENDS:
        if ends and word in (one, other) and (word != "front" or other == end):
            return other if word == one else one
    return word


def _end_letter(letter: str, ends: bool, rear: str) -> str:
    if not ends:
        return letter
    return rear if letter == "f" else "f"
