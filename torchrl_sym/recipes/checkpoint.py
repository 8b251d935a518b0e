"""What a checkpoint holds, and how a run continues from it, exactly.

All processes that share a training have the same networks, optimizer and running episodes, and an
environment and random numbers of their own: those of the first are entries of the checkpoint, those of the
others are in its list ``others``.
"""

from __future__ import annotations

import dataclasses
import json
import re
import warnings
from typing import Any

import torch
from torchrl.envs import EnvBase, TransformedEnv

from torchrl_sym.recipes.config import PPOConfig
from torchrl_sym.recipes.environment import Resumable, describe, offered
from torchrl_sym.recipes.metrics import Episodes
from torchrl_sym.recipes.ranks import Ranks
from torchrl_sym.recipes.storage import RunFolder

_ADDRESS = re.compile(r" at 0x[0-9a-f]+")
_STATE = {"episodes", "rng", "cuda_rng", "env", "transforms"}  # of a run, not of a policy alone


def snapshot(
    config: PPOConfig,
    env: EnvBase,
    parts: dict[str, Any],
    episodes: Episodes,
    iteration: int,
    seconds: float,
    ranks: Ranks,
) -> dict[str, Any]:
    """Everything that decides the future of the run, as plain containers of tensors and numbers."""
    resumable = offered(env, Resumable)
    own = {
        **random_state(config.device),
        "env": None if resumable is None else resumable.save_state(),
        "transforms": env.transform.state_dict() if isinstance(env, TransformedEnv) else None,
    }
    first, *others = ranks.every(own)
    return {
        "config": dataclasses.asdict(config),
        "environment": _plain(describe(env)),
        "iteration": iteration,
        "seconds": seconds,
        "parts": {name: part.state_dict() for name, part in parts.items()},
        "episodes": episodes.state_dict(),
        **first,
        **({"others": others} if others else {}),
    }


def random_state(device: str) -> dict[str, Any]:
    """State of torch's global generators, on the CPU and on a device."""
    cuda = torch.device(device).type == "cuda"
    return {"rng": torch.get_rng_state(), "cuda_rng": [torch.cuda.get_rng_state(device)] if cuda else []}


def restore_random(state: dict[str, Any], device: str) -> None:
    """Continue torch's global generators from a state that holds :func:`random_state`."""
    torch.set_rng_state(state["rng"])
    if torch.device(device).type == "cuda" and state["cuda_rng"]:
        torch.cuda.set_rng_state(state["cuda_rng"][0], device)


def require_same_ranks(run: RunFolder, checkpoint: dict[str, Any], ranks: Ranks) -> None:
    """ValueError if another number of processes wrote it: each has environments of its own."""
    count = 1 + len(checkpoint.get("others", []))
    if count != ranks.count:
        raise ValueError(
            f"expected as many processes as the run in {run.path} has, {count}, each with environments of "
            f"its own, got {ranks.count}; start it with torchrun --nproc-per-node={count}, or train anew "
            "in another folder"
        )


def own_part(checkpoint: dict[str, Any], ranks: Ranks) -> dict[str, Any]:
    """A checkpoint with this process's environment and random numbers."""
    return checkpoint | [{}, *checkpoint.get("others", [])][ranks.index]


def require_same_run(
    run: RunFolder, checkpoint: dict[str, Any], config: PPOConfig, env: EnvBase, ranks: Ranks
) -> None:
    """A run may only be continued as what it was.

    Raises:
        ValueError: the folder holds another configuration, another environment, a run of another number of
            processes, or no run at all.
    """
    if "optimizer" not in checkpoint["parts"]:
        raise ValueError(
            f"expected a run in {run.path}, got an exported policy, which can be loaded (load_actor) but "
            "not trained further; use another folder"
        )
    missing = _STATE - checkpoint.keys()
    if missing:
        raise ValueError(
            f"expected a checkpoint of recipes.train in {run.path}, got one without {sorted(missing)}; "
            "restore it from a copy, or delete the folder to train anew"
        )
    require_same_ranks(run, checkpoint, ranks)
    stored, asked = checkpoint.get("environment"), _plain(describe(env))
    other = {} if stored is None else _differences(stored, asked)  # earlier versions did not store it
    if other:
        raise ValueError(
            f"{run.path} holds a run in another environment, {{name: (stored, requested)}} = {other}; use "
            "another folder, or delete this one to start anew"
        )
    differences = config.differences(checkpoint["config"])
    if differences:
        raise ValueError(
            f"{run.path} holds a run with another configuration, {{field: (stored, requested)}} = "
            f"{differences}; use another folder, or delete this one to start anew"
        )


def restore(
    run: RunFolder, checkpoint: dict[str, Any], env: EnvBase, parts: dict[str, Any], episodes: Episodes
) -> None:
    """Continue from a checkpoint: networks, optimizer, environment, running episodes, transforms.

    Raises:
        ValueError: the networks are of other sizes.
    """
    for name, part in parts.items():
        try:
            part.load_state_dict(checkpoint["parts"][name])
        except (RuntimeError, ValueError, KeyError) as error:
            reason = str(error).strip().splitlines()[-1].strip()
            raise ValueError(
                f"expected {run.path} to hold an {name} of the sizes that configuration and environment "
                f"ask for, got another one ({reason}); is it a run of another task?"
            ) from error
    if isinstance(env, TransformedEnv):
        env.transform.load_state_dict(checkpoint["transforms"])
    resumable = offered(env, Resumable)
    if resumable is not None and checkpoint["env"] is not None:
        resumable.restore_state(checkpoint["env"])
        episodes.load_state_dict(checkpoint["episodes"])
    else:  # new episodes begin, whose returns are theirs alone
        episodes.latest = checkpoint["episodes"]["latest"]


def warn_unless_exact(env: EnvBase) -> None:
    """Say so if a run in this environment does not continue exactly."""
    if offered(env, Resumable) is None or isinstance(env, TransformedEnv):
        warnings.warn(
            "the run continues with the networks and optimizer it had, but not exactly: the environment "
            "has transforms, or no save_state() and restore_state(), so that episodes may begin anew",
            stacklevel=4,
        )


def _differences(stored: dict[str, Any], asked: dict[str, Any]) -> dict[str, tuple[Any, Any]]:
    names = dict.fromkeys([*stored, *asked])
    return {
        name: (stored.get(name), asked.get(name)) for name in names if stored.get(name) != asked.get(name)
    }


def _plain(description: dict[str, Any]) -> dict[str, Any]:
    """A description as it comes back from a file; what is neither number nor text, as text.

    The text is the same in another process: a function's has no address in it.
    """
    text = json.dumps(description, default=lambda value: _ADDRESS.sub("", repr(value)))
    return json.loads(text)
