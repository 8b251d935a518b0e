"""What cannot be inferred, entry by entry: where, how far off, what it looks like, and what to do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from tensordict import NestedKey

from torchrl_sym.mujoco.derive import SymmetryError
from torchrl_sym.representations import Representation

_SHOWN = 12  # entries that a message lists


@dataclass(frozen=True)
class Unexplained:
    """An entry without an image.

    Attributes:
        key: of the observation, or ``"action"``.
        index: in the flattened entry.
        label: what it seems to be, such as the joint whose position it equals; ``""`` if nothing fits.
        element: name of the element under which it has no image.
        residual: distance from the best image, relative to the entry's size.
        reason: what the image looks like.
    """

    key: NestedKey
    index: int
    label: str
    element: str
    residual: float
    reason: str

    def __str__(self) -> str:
        key = self.key if isinstance(self.key, str) else str(tuple(self.key))
        label = f" ({self.label})" if self.label else ""
        return f"{key}[{self.index}]{label} under {self.element}: {self.reason}"


class InferenceError(SymmetryError):
    """Some entries have no image, or too little happened to tell; the message names them and a remedy.

    Attributes:
        entries: what is at fault, entry by entry.
        partial: representations of the keys that were found.
    """

    def __init__(
        self,
        message: str,
        entries: Sequence[Unexplained] = (),
        partial: Mapping[NestedKey, Representation] | None = None,
    ) -> None:
        lines = [message, *(f"  {entry}" for entry in entries[:_SHOWN])]
        if len(entries) > _SHOWN:
            lines.append(f"  and {len(entries) - _SHOWN} more (.entries lists all)")
        super().__init__("\n".join(lines))
        self.entries = list(entries)
        self.partial = dict(partial or {})
