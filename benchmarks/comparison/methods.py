"""The compared methods, each a change of one task's settings.

A name is a sum of parts. What happens to the data, or which network learns: `ppo`, `aug`, `aug-random`,
`aug-naive`, `aug-naive-raw`, `equivariant`, `relaxed`. Then `loss-W` for a mirror loss of weight W in the
paper's convention (a sum over the group and the action's entries), `init-S` for initial weights S times as
large, `symmetric-init` for initial weights that are symmetric. So `aug+loss-0.1` is augmentation with a
mirror loss, `loss-1` plain PPO with one, `aug+symmetric-init+init-4` augmentation from large, symmetric
weights.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from typing import Any

from tasks.settings import Setting


@dataclass(frozen=True)
class Base:
    """What a method does with its data and its network: how it is called, tuned and configured."""

    label: str
    family: str
    changes: dict[str, Any]


def _network(kind: str) -> dict[str, Any]:
    return {"augmentation": "none", "network": kind}


BASES = {
    "ppo": Base("PPO", "ppo", {"augmentation": "none"}),
    "aug": Base("PPO + aug.", "aug", {"augmentation": "all"}),
    "aug-random": Base("PPO + aug. (random)", "aug", {"augmentation": "random"}),
    "aug-naive": Base("naive aug.", "aug-naive", {"augmentation": "naive"}),
    # Without what keeps the naive rule finite: bounds of log-ratio and deviation, and a learning rate that
    # falls when the ratios of the copies explode. Instead the rate that augmentation learns with, its cap.
    "aug-naive-raw": Base(
        "naive aug., unprotected",
        "aug-naive",
        {
            "augmentation": "naive",
            "max_log_ratio": math.inf,
            "max_std": math.inf,
            "desired_kl": None,
            "learning_rate": 1e-2,
        },
    ),
    "equivariant": Base("equivariant PPO", "equivariant", _network("equivariant")),
    "relaxed": Base("relaxed PPO", "relaxed", _network("relaxed")),
}

METHOD_FIELDS = {"augmentation", "mirror_coeff", "weight_scale", "network", "initialization", "seed"}
"""Fields of the configuration that a method or a run decides."""

_NUMBERED = {"loss": "weight", "init": "scale"}


@dataclass(frozen=True)
class Method:
    """A method as its name says. Two names of the same parts, in any order, are the same method.

    Attributes:
        base: one of `BASES`.
        weight: of the mirror loss.
        scale: factor on the initial weights.
        initialization: `default` or `symmetric`.
        name: as it was given.
    """

    base: str = "ppo"
    weight: float = 0.0
    scale: float = 1.0
    initialization: str = "default"
    name: str = field(default="", compare=False)

    @classmethod
    def parse(cls, name: str) -> Method:
        """The method of a name.

        Raises:
            ValueError: a part that is none of the module's, two of a kind, or one without effect.
        """
        found: dict[str, Any] = {}
        for part in name.split("+"):
            kind, value = _part(part)
            if value is None:
                raise ValueError(
                    f"expected a method made of {list(BASES)}, loss-W and init-S with positive numbers, "
                    f"and symmetric-init, joined by +, got {part!r} in {name!r}"
                )
            if kind in found:
                raise ValueError(f"expected at most one {kind} in a method, got two in {name!r}")
            found[kind] = value
        method = cls(**found, name=name)
        if method.network != "mlp" and method.initialization != "default":
            raise ValueError(
                f"expected no symmetric-init beside {method.base}, whose network begins symmetric, got "
                f"{name!r}; leave it out"
            )
        if method.network == "equivariant" and method.weight:
            raise ValueError(
                f"expected no mirror loss beside equivariant, where it is always zero, got {name!r}; use "
                "relaxed, or leave it out"
            )
        return method

    @property
    def network(self) -> str:
        """`mlp`, `equivariant` or `relaxed`."""
        return BASES[self.base].changes.get("network", "mlp")

    @property
    def family(self) -> str:
        """Methods that are tuned together; a mirror loss beside plain PPO makes one of its own."""
        return "loss" if self.base == "ppo" and self.weight else BASES[self.base].family

    @property
    def label(self) -> str:
        """How figures and tables call it."""
        text = BASES[self.base].label + (f" + loss-{self.weight:g}" if self.weight else "")
        weights = "symmetric " * (self.initialization == "symmetric") + "init"
        if self.scale != 1.0:
            weights += f"-{self.scale:g}"
        return text if weights == "init" else f"{text}, {weights}"

    @property
    def changes(self) -> dict[str, Any]:
        """The fields of a configuration that it changes."""
        own: dict[str, Any] = {"mirror_coeff": self.weight, "weight_scale": self.scale}
        if self.initialization != "default":
            own["initialization"] = self.initialization
        return BASES[self.base].changes | own

    def configure(self, setting: Setting, seed: int, steps: int | None = None, **changes: Any) -> Setting:
        """Settings of one run.

        Args:
            setting: the task's settings, with what was tuned for families of methods.
            seed: seed of the run.
            steps: environment steps, instead of the setting's; stages shrink alike.
            **changes: further changes of the configuration.
        """
        setting = setting.tuned_for(self.family).replace(**self.changes | {"seed": seed} | changes)
        if steps is None:
            return setting
        share = steps / setting.frames
        rounds = [max(1, math.ceil(stage.config.iterations * share - 1e-9)) for stage in setting.stages]
        first, *later = (
            dataclasses.replace(stage, config=dataclasses.replace(stage.config, iterations=count))
            for stage, count in zip(setting.stages, rounds, strict=True)
        )
        return dataclasses.replace(setting, config=first.config, then=tuple(later))


def _part(part: str) -> tuple[str, Any]:
    """The attribute that a part of a name stands for, and its value; None if there is no such part."""
    if part in BASES:
        return "base", part
    if part == "symmetric-init":
        return "initialization", "symmetric"
    prefix, _, number = part.rpartition("-")
    return _NUMBERED.get(prefix, ""), _positive(number) if prefix in _NUMBERED else None


def _positive(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if 0 < value < math.inf else None
