"""Continue a run where its last checkpoint was: what is stored, and how it is put back."""

from __future__ import annotations

import dataclasses
import warnings
from typing import Any

import torch
from torchrl.envs import EnvBase, TransformedEnv

from torchrl_sym.recipes.config import PPOConfig
from torchrl_sym.recipes.metrics import Episodes
from torchrl_sym.recipes.storage import RunFolder


def snapshot(
    config: PPOConfig,
    env: EnvBase,
    parts: dict[str, Any],
    episodes: Episodes,
    iteration: int,
    seconds: float,
) -> dict[str, Any]:
    """Everything that decides the future of the run, as plain containers of tensors and numbers."""
    return {
        "config": dataclasses.asdict(config),
        "iteration": iteration,
        "seconds": seconds,
        "parts": {name: part.state_dict() for name, part in parts.items()},
        "episodes": episodes.state_dict(),
        "rng": torch.get_rng_state(),
        "cuda_rng": torch.cuda.get_rng_state_all() if torch.cuda.is_available() else [],
        "env": call_env(env, "save_state"),
        "transforms": env.transform.state_dict() if isinstance(env, TransformedEnv) else None,
    }


def resume(
    run: RunFolder | None,
    config: PPOConfig,
    env: EnvBase,
    parts: dict[str, Any],
    episodes: Episodes,
    start_from: RunFolder | None = None,
) -> tuple[int, float]:
    """Load the folder's checkpoint, or begin; returns the iterations done and the seconds they took."""
    checkpoint = None if run is None else run.load()
    if run is None or checkpoint is None:
        if run is not None:
            run.truncate(0)  # a row that was logged before the first checkpoint
        if start_from is None:
            call_env(env, "stagger")
        else:
            _begin_from(start_from, env, parts, episodes)
        return 0, 0.0
    differences = config.differences(checkpoint["config"])
    if differences:
        raise ValueError(
            f"{run.path} holds a run with another configuration, {{field: (stored, requested)}} = "
            f"{differences}; use another folder, or delete this one to start anew"
        )
    for name, part in parts.items():
        part.load_state_dict(checkpoint["parts"][name])
    _restore_env(env, checkpoint, episodes, finished=checkpoint["iteration"] >= config.iterations)
    torch.set_rng_state(checkpoint["rng"])
    if torch.cuda.is_available() and len(checkpoint["cuda_rng"]) == torch.cuda.device_count():
        torch.cuda.set_rng_state_all(checkpoint["cuda_rng"])
    run.truncate(checkpoint["iteration"])
    return checkpoint["iteration"], checkpoint["seconds"]


def _begin_from(earlier: RunFolder, env: EnvBase, parts: dict[str, Any], episodes: Episodes) -> None:
    """Networks, optimizer, episodes and curriculum of another run, whatever its hyper-parameters."""
    checkpoint = earlier.load()
    found = [] if checkpoint is None else list(checkpoint["parts"])
    if checkpoint is None or set(parts) - set(found):
        raise FileNotFoundError(
            f"expected a checkpoint with {list(parts)} in {earlier.path} to start from, found {found}; "
            "train there first"
        )
    for name, part in parts.items():
        part.load_state_dict(checkpoint["parts"][name])
    _restore_env(env, checkpoint, episodes, finished=False)


def _restore_env(env: EnvBase, checkpoint: dict[str, Any], episodes: Episodes, *, finished: bool) -> None:
    if isinstance(env, TransformedEnv):
        env.transform.load_state_dict(checkpoint["transforms"])
    if checkpoint["env"] is not None:
        call_env(env, "restore_state", checkpoint["env"])
        episodes.load_state_dict(checkpoint["episodes"])
    else:  # new episodes begin, whose returns are theirs alone
        episodes.latest = checkpoint["episodes"]["latest"]
    if not finished and (checkpoint["env"] is None or isinstance(env, TransformedEnv)):
        warnings.warn(
            "the run continues with the networks and optimizer it had, but not exactly: the environment "
            "has transforms, or no save_state() and restore_state(), so that episodes may begin anew",
            stacklevel=4,
        )


def call_env(env: EnvBase, method: str, *arguments: Any) -> Any:
    """Call an optional method of the environment inside all transforms, if its class has it.

    The class is asked, not the object: environments of processes look attributes up in their workers.
    """
    while isinstance(env, TransformedEnv):
        env = env.base_env
    if hasattr(type(env), method):
        return getattr(env, method)(*arguments)
    return None
