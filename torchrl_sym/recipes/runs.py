"""What the folder of a run tells from outside: its trained policy, and how far it has come."""

from __future__ import annotations

import dataclasses
import math
import os
from pathlib import Path
from typing import Any

from tensordict.nn import ProbabilisticTensorDictSequential
from torchrl.envs import EnvBase

from torchrl_sym.recipes.config import PPOConfig
from torchrl_sym.recipes.networks import make_networks
from torchrl_sym.recipes.storage import RunFolder
from torchrl_sym.recipes.table import read_last
from torchrl_sym.symmetry import Symmetry


def load_actor(
    folder: str | os.PathLike, env: EnvBase, symmetry: Symmetry
) -> ProbabilisticTensorDictSequential:
    """The trained policy of a run.

    Args:
        folder: where :func:`train` or :func:`train_stages` wrote; of several stages, the last is loaded.
        env: an environment with the observations and actions of the training environment.
        symmetry: the symmetry that was passed to :func:`train`.

    Raises:
        FileNotFoundError: nothing has been trained there.
        ValueError: the checkpoint is damaged, or its policy has other observations or actions.
    """
    path, checkpoint = _trained(folder)
    # where a policy acts, there may be nothing of what only its critic has read
    config = dataclasses.replace(PPOConfig(**checkpoint["config"]), device="cpu", critic_keys=None)
    actor, _ = make_networks(config, env, symmetry)
    try:
        actor.load_state_dict(checkpoint["parts"]["actor"])
    except RuntimeError as error:
        raise ValueError(
            f"expected a policy with the observations and actions of this environment in {path}, got "
            f"another one ({str(error).splitlines()[-1].strip()}); is it a run of another task?"
        ) from error
    return actor


def export_actor(folder: str | os.PathLike, target: str | os.PathLike) -> None:
    """Keep only the policy of a run: a checkpoint that :func:`load_actor` reads, a tenth of the size.

    Args:
        folder: where :func:`train` or :func:`train_stages` wrote.
        target: folder of the new checkpoint; created if missing.

    Raises:
        FileNotFoundError: nothing has been trained there.
    """
    _, checkpoint = _trained(folder)
    parts = {"actor": checkpoint["parts"]["actor"]}
    kept = {name: checkpoint[name] for name in ("config", "iteration", "seconds")}
    RunFolder(target).save({**kept, "parts": parts})


def trained_folder(folder: str | os.PathLike) -> Path:
    """Where the last checkpoint of a run is: in the folder, or in that of its last trained stage.

    Raises:
        FileNotFoundError: there is none, or nothing has been learned yet.
    """
    return _trained(folder)[0]


def _trained(folder: str | os.PathLike) -> tuple[Path, dict[str, Any]]:
    """The last checkpoint of a run, and where it is."""
    for path in (Path(folder), *reversed(stage_folders(folder))):
        checkpoint = RunFolder(path).load()
        if checkpoint is not None and checkpoint["iteration"] > 0:
            return path, checkpoint
    raise FileNotFoundError(f"expected a checkpoint in {folder}, found none; train there first")


def stage_folders(folder: str | os.PathLike) -> list[Path]:
    """Folders of the stages of a run that have begun, in order."""
    numbered = {path.name.removeprefix("stage_"): path for path in Path(folder).glob("stage_*")}
    return [numbered[number] for number in sorted(filter(str.isdigit, numbered), key=int)]


def read_progress(folder: str | os.PathLike) -> tuple[int, float]:
    """Iterations that a run has done so far in all of its stages, and its latest return (NaN at first)."""
    done, latest = 0, math.nan
    for path in (Path(folder), *stage_folders(folder)):
        try:
            rows, last = read_last(path / "metrics.csv")
        except (OSError, ValueError):  # not begun; or damaged, which is its training's to say
            continue
        if rows:
            done, latest = done + rows, last.get("return", math.nan)
    return done, latest
