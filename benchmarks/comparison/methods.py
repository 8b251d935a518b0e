"""The compared methods, each a change of one task's settings.

A name is a sum of parts: what happens to the data (`ppo`, `aug`, `aug-random`, `aug-naive`,
`aug-naive-raw`), `loss-W` for a mirror loss of weight W in the paper's convention (a sum over the group
and the action's entries), `init-S` for initial weights S times as large. So `aug+loss-0.1` is augmentation
with a mirror loss, `loss-1` plain PPO with one, `aug+init-4` augmentation from large weights.
"""

import dataclasses
import math
from typing import Any

from tasks.settings import Setting

AUGMENTATION: dict[str, dict[str, Any]] = {
    "ppo": {"augmentation": "none"},
    "aug": {"augmentation": "all"},
    "aug-random": {"augmentation": "random"},
    "aug-naive": {"augmentation": "naive"},
    # Without what keeps the naive rule finite: bounds of log-ratio and deviation, and a learning rate that
    # falls when the ratios of the copies explode. Instead the rate that augmentation learns with, its cap.
    "aug-naive-raw": {
        "augmentation": "naive",
        "max_log_ratio": math.inf,
        "max_std": math.inf,
        "desired_kl": None,
        "learning_rate": 1e-2,
    },
}

LABELS = {
    "ppo": "PPO",
    "aug": "PPO + aug.",
    "aug-random": "PPO + aug. (random)",
    "aug-naive": "naive aug.",
    "aug-naive-raw": "naive aug., unprotected",
}
"""How figures and tables call the parts."""

METHOD_FIELDS = {"augmentation", "mirror_coeff", "weight_scale", "seed"}
"""Fields of the configuration that a method or a run decides."""


def parts(method: str) -> tuple[str, float, float]:
    """A method's augmentation, mirror weight and initial scale.

    Raises:
        ValueError: a part that is none of the module's, or two of a kind.
    """
    found: dict[str, Any] = {}
    for part in method.split("+"):
        kind, _, number = part.rpartition("-")
        if part in AUGMENTATION:
            kind, value = "augmentation", part
        else:
            value = _positive(number) if kind in ("loss", "init") else None
        if value is None:
            raise ValueError(
                f"expected a method made of {list(AUGMENTATION)}, loss-W and init-S with positive numbers, "
                f"joined by +, got {part!r} in {method!r}"
            )
        if kind in found:
            raise ValueError(f"expected at most one {kind} in a method, got two in {method!r}")
        found[kind] = value
    return found.get("augmentation", "ppo"), found.get("loss", 0.0), found.get("init", 1.0)


def _positive(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if 0 < value < math.inf else None


def family(method: str) -> str:
    """Methods that are tuned together: plain PPO, augmentation, mirror loss, naive augmentation."""
    augmentation, weight, _ = parts(method)
    if augmentation.startswith("aug-naive"):
        return "aug-naive"
    if augmentation == "ppo":
        return "loss" if weight else "ppo"
    return "aug"


def label(method: str) -> str:
    """How figures and tables call a method."""
    augmentation, weight, scale = parts(method)
    text = LABELS[augmentation]
    if weight:
        text += f" + loss-{weight:g}"
    return text if scale == 1.0 else f"{text}, init-{scale:g}"


def configure(
    method: str, setting: Setting, seed: int, steps: int | None = None, **changes: Any
) -> Setting:
    """Settings of one run.

    Args:
        method: a name as above.
        setting: the task's settings, with what was tuned for families of methods.
        seed: seed of the run.
        steps: environment steps, instead of the setting's; stages shrink alike.
        **changes: further changes of the configuration.
    """
    augmentation, weight, scale = parts(method)
    config = {"mirror_coeff": weight, "weight_scale": scale, "seed": seed}
    setting = setting.tuned_for(family(method)).replace(**AUGMENTATION[augmentation] | config | changes)
    if steps is None:
        return setting
    share = steps / setting.frames
    rounds = [max(1, math.ceil(stage.config.iterations * share - 1e-9)) for stage in setting.stages]
    first, *later = (
        dataclasses.replace(stage, config=dataclasses.replace(stage.config, iterations=count))
        for stage, count in zip(setting.stages, rounds, strict=True)
    )
    return dataclasses.replace(setting, config=first.config, then=tuple(later))
