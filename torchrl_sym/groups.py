"""Finite point groups: which rigid symmetries a robot and its task have.

A symmetric task has N transformations ``G = {g_0, ..., g_{N-1}}`` with the identity first (Mittal et
al., section II-B). For a robot under gravity each of them is an isometry of space that keeps the
vertical axis in place: a turn about z, or a reflection in a vertical plane. Together they form a finite
subgroup of O(3), a *point group*. Everything else in this package (how an observation transforms, what
a symmetric copy of a sample is) is derived from the 3 x 3 matrices and the product table kept here.
"""

from __future__ import annotations

import functools
import math
import reprlib
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from torchrl_sym import checks

_TOLERANCE = 1e-9
_DISTINCT = 1e-6  # elements that differ by less are one and the same
_MAX_ORDER = 120  # the largest finite rotation group with reflections, that of the icosahedron
_EXACT = sorted({s * v for s in (-1, 1) for v in (0.0, 0.5, math.sqrt(0.5), math.sqrt(0.75), 1.0)})


class PointGroup:
    """A finite subgroup of O(3), closed from its generators.

    Use one of the constructors: :meth:`trivial`, :meth:`reflection`, :meth:`rotation`,
    :meth:`klein_four`, :meth:`dihedral` or, for anything else, :meth:`generate`.

    Attributes:
        matrices: the elements as orthogonal matrices, ``(N, 3, 3)`` float64, identity first. Entries that
            are a sine or cosine of a multiple of 30 or 45 degrees are exact to the last bit.
        names: a readable name per element, e.g. ``("identity", "reflect-x", "reflect-y", "rot-180")``.
            ``reflect-x`` sends x to -x; ``rot-120`` turns by 120 degrees about the vertical axis.
        table: product table ``(N, N)``: ``table[g, h]`` is the index of ``g h`` (first h, then g).
        inverse: index of the inverse of each element, ``(N,)``.
        det: determinant of each element, ``(N,)``: +1 for rotations, -1 for reflections.

    Example:
        >>> group = PointGroup.klein_four()
        >>> group.names
        ('identity', 'reflect-x', 'reflect-y', 'rot-180')
        >>> group.names[group.table[group.index("reflect-x"), group.index("reflect-y")]]
        'rot-180'
    """

    matrices: Tensor
    names: tuple[str, ...]
    table: Tensor
    inverse: Tensor
    det: Tensor

    def __init__(self, matrices: Tensor, names: Sequence[str] | None = None) -> None:
        """Build a group from all of its elements; prefer the named constructors.

        Args:
            matrices: every element, ``(N, 3, 3)``, identity first.
            names: one distinct name per element. Defaults to names read off the matrices.

        Raises:
            ValueError: a matrix is not orthogonal, the identity is not first, the set is not closed, or
                has more than 120 elements.
            TypeError: no matrices, or names that are none.
        """
        matrices = checks.array("matrices", matrices, finite=False)
        if matrices.ndim != 3 or matrices.shape[1:] != (3, 3):
            raise ValueError(f"expected matrices of shape (N, 3, 3), got {tuple(matrices.shape)}")
        if not 1 <= len(matrices) <= _MAX_ORDER:
            raise ValueError(f"expected 1 to {_MAX_ORDER} elements, got {len(matrices)}; list the identity")
        eye = torch.eye(3, dtype=torch.float64, device="cpu")
        for i, matrix in enumerate(matrices):
            if not torch.allclose(matrix @ matrix.T, eye, rtol=0, atol=_TOLERANCE):
                raise ValueError(
                    f"expected orthogonal matrices, got element {i} = {matrix.tolist()}; "
                    "pass rotations and reflections only"
                )
        if not torch.allclose(matrices[0], eye, rtol=0, atol=_TOLERANCE):
            raise ValueError("expected the identity as element 0; list it first")
        self.matrices = _snap(matrices)
        self.names = tuple(map(_name, self.matrices) if names is None else checks.names("names", names))
        if len(set(self.names)) != len(matrices) or len(self.names) != len(matrices):
            raise ValueError(
                f"expected {len(matrices)} distinct names, got {list(self.names)}; "
                "is an element listed twice?"
            )
        distance = (self.matrices[:, None] - self.matrices).abs().amax(dim=(-2, -1))
        for i, j in (distance < _DISTINCT).triu(diagonal=1).nonzero().tolist():
            raise ValueError(
                f"expected distinct elements, but {self.names[i]!r} and {self.names[j]!r} are the same"
            )
        self.table = self._product_table()
        self.inverse = (self.table == 0).long().argmax(dim=1)
        self.det = torch.linalg.det(self.matrices).round()

    def _product_table(self) -> Tensor:
        products = torch.einsum("gij,hjk->ghik", self.matrices, self.matrices)
        distance = (products[:, :, None] - self.matrices).abs().amax(dim=(-2, -1))  # (N, N, N)
        residual, table = distance.min(dim=-1)
        if (residual > _TOLERANCE).any():
            g, h = (residual > _TOLERANCE).nonzero()[0].tolist()
            raise ValueError(
                f"expected a closed set, but {self.names[g]} after {self.names[h]} is not in it; "
                "use PointGroup.generate, which adds the missing elements"
            )
        return table

    @classmethod
    def trivial(cls) -> PointGroup:
        """The group of the identity alone, C_1: no symmetry."""
        return cls.generate({})

    @classmethod
    def reflection(cls, axis: str | float) -> PointGroup:
        """The two-fold group that sends one horizontal axis to its negative.

        Args:
            axis: ``"x"`` (front and back change places), ``"y"`` (left and right change places), or the
                angle of the axis from x, in degrees: the normal of any vertical mirror plane.

        Example:
            >>> PointGroup.reflection(30.0).names
            ('identity', 'reflect-30')
        """
        if isinstance(axis, int | float) and not isinstance(axis, bool):
            angle = math.radians(checks.real("axis", axis))
            return cls.generate({f"reflect-{axis:g}": _mirror(math.cos(angle), math.sin(angle))})
        normals = {"x": (1.0, 0.0), "y": (0.0, 1.0)}
        if not isinstance(axis, str) or axis not in normals:
            raise ValueError(
                f"expected axis 'x' or 'y', or its angle from x in degrees, got {axis!r}; a reflection "
                "that moves gravity can be built with PointGroup.generate"
            )
        return cls.generate({f"reflect-{axis}": _mirror(*normals[axis])})

    @classmethod
    def rotation(cls, n: int) -> PointGroup:
        """The n turns by multiples of 360/n degrees about the vertical axis, C_n; n is 1 to 120."""
        n = checks.whole("n", n, 1, _MAX_ORDER)
        return cls.generate({"turn": _turn(2 * math.pi / n)} if n > 1 else {})

    @classmethod
    def klein_four(cls) -> PointGroup:
        """Identity, reflect-x, reflect-y and the half turn: a quadruped with four equal legs, K_4."""
        return cls.generate({"x": _mirror(1.0, 0.0), "y": _mirror(0.0, 1.0)})

    @classmethod
    def dihedral(cls, n: int) -> PointGroup:
        """The n turns of C_n and n reflections in vertical planes, one of which is y -> -y; order 2n.

        Args:
            n: number of turns, 1 to 60.
        """
        n = checks.whole("n", n, 1, _MAX_ORDER // 2)
        return cls.generate({"turn": _turn(2 * math.pi / n), "mirror": _mirror(0.0, 1.0)})

    @classmethod
    def generate(cls, generators: Mapping[str, Tensor], *, fixes_vertical: bool = True) -> PointGroup:
        """The smallest group that contains the given isometries.

        Args:
            generators: orthogonal ``(3, 3)`` matrices by name. Names serve in error messages; elements
                are named after what they do (``rot-90``, ``reflect-y``) or after a product of generators.
            fixes_vertical: refuse generators that move the z axis, since gravity breaks them.

        Raises:
            ValueError: a generator is not orthogonal or moves the vertical axis, or the group they
                generate is infinite (or has more than 120 elements).

        Example:
            >>> quarter = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
            >>> PointGroup.generate({"quarter turn": quarter}).names
            ('identity', 'rot-90', 'rot-180', 'rot-270')
        """
        eye = torch.eye(3, dtype=torch.float64, device="cpu")
        moves = {}
        checks.flag("fixes_vertical", fixes_vertical)
        for name, value in checks.mapping("generators", generators, "names to matrices").items():
            matrix = checks.array(f"generator {name!r}", value, finite=False)
            if matrix.shape != (3, 3) or not torch.allclose(
                matrix @ matrix.mT, eye, rtol=0, atol=_TOLERANCE
            ):
                raise ValueError(
                    f"generator {name!r}: expected an orthogonal 3 x 3 matrix, got {matrix.tolist()}; "
                    f"it must be orthogonal to {_TOLERANCE:g}, so compute it in float64"
                )
            if fixes_vertical and abs(matrix[2, 2].item() - 1) > _TOLERANCE:
                raise ValueError(
                    f"generator {name!r} moves the vertical axis, which gravity forbids; "
                    "pass fixes_vertical=False if the task has no gravity"
                )
            moves[name] = _snap(matrix)
        found, words = [eye], ["identity"]
        for known, word in zip(found, words, strict=True):  # both lists grow while they are walked
            for name, move in moves.items():
                candidate = _snap(move @ known)
                if all((candidate - f).abs().max() > _DISTINCT for f in found):
                    found.append(candidate)
                    words.append(name if word == "identity" else f"{name}*{word}")
                if len(found) > _MAX_ORDER:
                    raise ValueError(
                        f"the generators {reprlib.repr(list(moves))} do not close to a finite group of at "
                        f"most {_MAX_ORDER} elements; check their angles (a divisor of 360 degrees?)"
                    )
        order = sorted(range(len(found)), key=lambda i: _sort_key(found[i]))
        names = [_name(found[i], fallback=words[i]) for i in order]
        return cls(torch.stack([found[i] for i in order]), names)

    @property
    def order(self) -> int:
        """Number of elements N, the identity included."""
        return len(self.names)

    def index(self, element: int | str) -> int:
        """Index of an element given by name (or by index, which is checked)."""
        if isinstance(element, str):
            if element not in self.names:
                raise KeyError(f"no element {element!r} in this group, which has {list(self.names)}")
            return self.names.index(element)
        if type(element) is not int:  # on the path of every call of a representation
            element = checks.whole("an element's index (or its name)", element)
        if not 0 <= element < self.order:
            raise KeyError(f"expected an element index in [0, {self.order}), got {element}")
        return element

    def turned(self, degrees: float) -> PointGroup:
        """The same group with its mirror planes turned about the vertical axis: T g T^-1 for every g.

        Example:
            >>> PointGroup.dihedral(3).turned(10.0).names[:3]
            ('identity', 'reflect-40', 'reflect-100')
        """
        turn = _turn(math.radians(checks.real("degrees", degrees)))
        moved = turn @ self.matrices @ turn.mT
        names = None if all(_planar_angle(m) for m in self.matrices) else self.names
        order = sorted(range(self.order), key=lambda i: _sort_key(_snap(moved[i])))
        order = order if names is None else range(self.order)
        return PointGroup(moved[list(order)], names)

    def subgroup(self, elements: Sequence[int | str]) -> PointGroup:
        """The subgroup generated by some of the elements.

        Example:
            >>> PointGroup.dihedral(4).subgroup(["rot-90"]).order
            4
        """
        chosen = [self.index(e) for e in checks.sequence("elements", elements)]
        members, frontier = {0}, {0}
        while frontier:
            reached = {int(self.table[g, h]) for g in chosen for h in frontier}
            frontier = reached - members
            members |= frontier
        kept = sorted(members)
        return PointGroup(self.matrices[kept], [self.names[i] for i in kept])

    @functools.cached_property
    def element_order(self) -> tuple[int, ...]:
        """The smallest n >= 1 with g^n = identity, per element."""
        orders = []
        for g in range(self.order):
            power, n = g, 1
            while power != 0:
                power, n = int(self.table[g, power]), n + 1
            orders.append(n)
        return tuple(orders)

    def __len__(self) -> int:
        return self.order

    def __eq__(self, other: object) -> bool:
        return (
            isinstance(other, PointGroup)
            and self.names == other.names
            and torch.allclose(self.matrices, other.matrices, rtol=0, atol=_TOLERANCE)
        )

    def __hash__(self) -> int:
        return hash(self.names)

    def __repr__(self) -> str:
        return f"PointGroup({', '.join(self.names)})"


def check_group(group: Any) -> PointGroup:
    """The group, if it is one.

    Raises:
        TypeError: it is not.
    """
    return checks.instance("group", group, PointGroup, "PointGroup.reflection('y') makes one")


def _turn(angle: float) -> Tensor:
    c, s = math.cos(angle), math.sin(angle)
    return torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64, device="cpu")


def _mirror(nx: float, ny: float) -> Tensor:
    normal = torch.tensor([nx, ny, 0.0], dtype=torch.float64, device="cpu")
    return torch.eye(3, dtype=torch.float64, device="cpu") - 2 * torch.outer(normal, normal)


def _snap(matrices: Tensor) -> Tensor:
    """Replace entries within 1e-9 of 0, 1/2, sqrt(1/2), sqrt(3/4) or 1 by that number, exactly."""
    exact = torch.tensor(_EXACT, dtype=torch.float64, device="cpu")
    distance, nearest = (matrices[..., None] - exact).abs().min(dim=-1)
    return torch.where(distance < _TOLERANCE, exact[nearest], matrices)


def _planar_angle(matrix: Tensor) -> tuple[float, float] | None:
    """(determinant, degrees) of an isometry that fixes z: the turn, or the normal of the mirror."""
    if abs(matrix[2, 2].item() - 1) > _TOLERANCE:
        return None
    det = round(torch.linalg.det(matrix).item())
    angle = math.degrees(math.atan2(matrix[1, 0].item(), matrix[0, 0].item())) % 360
    # the mirror with normal (cos a, sin a) has first column (-cos 2a, -sin 2a)
    degrees = angle if det > 0 else ((angle + 180) % 360) / 2
    return det, round(degrees, 6) % (360 if det > 0 else 180)


def _name(matrix: Tensor, fallback: str | None = None) -> str:
    if torch.equal(matrix, torch.eye(3, dtype=matrix.dtype, device="cpu")):
        return "identity"
    planar = _planar_angle(matrix)
    if planar is None:
        return fallback if fallback is not None else str(matrix.round(decimals=3).tolist())
    det, degrees = planar
    if det > 0:
        return f"rot-{degrees:g}"
    return {0.0: "reflect-x", 90.0: "reflect-y"}.get(degrees, f"reflect-{degrees:g}")


def _sort_key(matrix: Tensor) -> tuple:
    """Identity, reflections, turns, each by angle: for K_4 this is the order of the paper's table."""
    planar = _planar_angle(matrix)
    if torch.equal(matrix, torch.eye(3, dtype=matrix.dtype, device="cpu")):
        return (0, 0.0)
    if planar is None:
        return (3, *matrix.flatten().tolist())
    det, degrees = planar
    return (2 if det > 0 else 1, degrees)
