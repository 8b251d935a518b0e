"""What `infer` returns: a symmetry that says where it comes from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from tensordict import NestedKey

from torchrl_sym.entries import Exchanged
from torchrl_sym.groups import PointGroup
from torchrl_sym.printing import code, table
from torchrl_sym.representations import Representation
from torchrl_sym.symmetry import Symmetry


class InferredSymmetry(Symmetry):
    """A :class:`~torchrl_sym.Symmetry` found by :func:`~torchrl_sym.mujoco.infer`.

    Args:
        group: as of a symmetry.
        representations: as of a symmetry.
        labels: what each entry seems to be, by key: the joint, sensor or body whose value it equals.
        notes: what to know before it is used.

    Example:
        >>> from torchrl_sym.representations import polar
        >>> group = PointGroup.reflection("y")
        >>> InferredSymmetry(group, {"v": polar(group)}, {}, ["v[2] never changes"]).notes
        ['v[2] never changes']
    """

    def __init__(
        self,
        group: PointGroup,
        representations: Mapping[NestedKey | Exchanged, Representation],
        labels: Mapping[NestedKey, Sequence[str]],
        notes: Sequence[str],
    ) -> None:
        super().__init__(group, representations)
        self.labels = dict(labels)
        self.notes = list(notes)

    def __str__(self) -> str:
        lines = [table(self.group, self._declaration.parts, self.labels)]
        return "\n".join([*lines, *(f"note: {note}" for note in self.notes)])

    def code(self) -> str:
        """The declaration of this symmetry as a person would write it, to be pasted and reviewed."""
        return code(self.group, self._declaration.parts, labels=self.labels)
