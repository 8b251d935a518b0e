"""A trained policy for where there is no TorchRL: as a program of PyTorch, or of ONNX.

What is exported is what a robot runs: from observations to the deterministic action (the mean of a
Gaussian), with every module of the actor, a normaliser inside it too. Both formats come from the same
``torch.export`` program, which is compared with the actor before it is written.
"""

from __future__ import annotations

import copy
import os
from pathlib import Path

import torch
from tensordict import NestedKey, TensorDict
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor, nn
from torchrl.envs import EnvBase, TransformedEnv

from torchrl_sym import checks
from torchrl_sym.extras import require
from torchrl_sym.mirror_loss import check_network, deterministic_action
from torchrl_sym.recipes.runs import load_actor
from torchrl_sym.symmetry import Symmetry

FORMATS = (".onnx", ".pt2")


def export_policy(
    source: ProbabilisticTensorDictSequential | str | os.PathLike,
    path: str | os.PathLike,
    env: EnvBase,
    symmetry: Symmetry | None = None,
) -> Path:
    """Write a policy's deterministic action as a program with a free batch size.

    ``.pt2`` is read by ``torch.export.load(path).module()``, ``.onnx`` by any ONNX runtime (to write it,
    ``pip install 'torchrl_sym[onnx]'``). The inputs are the observations that the actor reads, in the order
    of ``actor.in_keys`` and under these names, of nested keys the parts joined by ``_``; each is
    ``(batch, *event)``. The output is ``action``, ``(batch, *event)``.

    Args:
        source: an actor, or the folder of a run of :func:`train` or :func:`train_stages`.
        path: the file, which ends in ``.pt2`` or ``.onnx``; its folder is created if missing.
        env: an environment with the observations of training.
        symmetry: what was passed to :func:`train`; needed with a folder.

    Returns:
        The file.

    Raises:
        ValueError: another ending; the actor reads what is no observation of the environment, such as a
            memory, or what a transform of the environment makes; or the program differs from the actor.
        ImportError: ONNX's packages are not installed.
        FileNotFoundError: nothing has been trained in the folder.

    Example:
        >>> import tasks, tempfile
        >>> from torchrl_sym.recipes import PPOConfig, make_actor
        >>> env, actor = (
        ...     tasks.make_env("cartpole", num_envs=1),
        ...     make_actor(PPOConfig(), ["observation"], 3, 1),
        ... )
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     path = export_policy(actor, f"{folder}/policy.pt2", env)
        ...     torch.export.load(path).module()(torch.zeros(5, 3)).shape
        torch.Size([5, 1])
    """
    path = Path(path)
    if path.suffix not in FORMATS:
        raise ValueError(f"path: expected a file that ends in one of {list(FORMATS)}, got {path.name!r}")
    if path.suffix == ".onnx":
        require("an .onnx file", "onnx", {"onnx": "", "onnxscript": ""}, "a .pt2 file needs none")
    checks.instance("env", env, EnvBase)
    if isinstance(source, str | os.PathLike):
        if symmetry is None:
            raise ValueError("symmetry: expected that of the training beside its folder, got None")
        source = load_actor(source, env, symmetry)
    check_network("source", source)

    actor = copy.deepcopy(source).to("cpu").eval()
    program = _program(Deterministic(actor), _observations(actor, env))
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".pt2":
        torch.export.save(program, path)
    else:
        torch.onnx.export(
            program,
            f=path,
            dynamo=True,
            verbose=False,
            external_data=False,
            input_names=_names(actor.in_keys),
            output_names=["action"],
        )
    return path


class Deterministic(nn.Module):
    """The deterministic action of an actor as a function of tensors.

    Args:
        actor: a policy with a distribution of one action.
    """

    def __init__(self, actor: ProbabilisticTensorDictSequential) -> None:
        super().__init__()
        self.actor = actor

    def forward(self, *observations: Tensor) -> Tensor:
        """``(batch, *event)`` for each of ``actor.in_keys`` to ``(batch, *event)`` of the action."""
        batch = TensorDict({}, batch_size=observations[0].shape[:1])
        for key, value in zip(self.actor.in_keys, observations, strict=True):
            batch.set(key, value)
        return deterministic_action(self.actor.get_dist(batch))


def _program(policy: Deterministic, examples: tuple[Tensor, ...]) -> torch.export.ExportedProgram:
    """The policy as a program, compared with it on another batch than the one it was traced on."""
    batch = torch.export.Dim("batch", min=1)
    shapes = {"observations": tuple({0: batch} for _ in examples)}
    with torch.no_grad():
        program = torch.export.export(policy, examples, dynamic_shapes=shapes)
        others = tuple(torch.cat([torch.randn_like(x), x]) for x in examples)
        error = float((program.module()(*others) - policy(*others)).abs().max())
    if not error < 1e-5:
        raise ValueError(
            f"expected a program that acts as the actor does, got one that differs by {error:.3g}; does a "
            "module of the actor decide in Python, by numbers of its input?"
        )
    return program


def _observations(actor: ProbabilisticTensorDictSequential, env: EnvBase) -> tuple[Tensor, ...]:
    """Two rows of everything that the actor reads."""
    observed = list(env.observation_spec.keys(True, True))
    missing = [key for key in actor.in_keys if key not in observed]
    if missing:
        raise ValueError(
            f"expected an actor that reads observations of the environment only, {observed}, got one that "
            f"also reads {missing}; a policy with memory has to be exported by hand, with its memory as an "
            "input and an output"
        )
    changed = [key for key in actor.in_keys if key in _made_by_transforms(env)]
    if changed:
        raise ValueError(
            f"expected observations as the simulation makes them, got {changed} from transforms of the "
            "environment, which are no part of the actor; normalise inside the network "
            "(PPOConfig.normalize_observations), or pass env.base_env if the robot does their work"
        )
    specs = [env.observation_spec[key] for key in actor.in_keys]
    return tuple(torch.randn(2, *spec.shape[env.batch_dims :]).to(spec.dtype) for spec in specs)


def _made_by_transforms(env: EnvBase) -> set[NestedKey]:
    made: set[NestedKey] = set()
    while isinstance(env, TransformedEnv):
        made |= set(env.transform.out_keys or ())
        env = env.base_env
    return made


def _names(keys: list[NestedKey]) -> list[str]:
    return ["_".join(map(str, key)) if isinstance(key, tuple) else str(key) for key in keys]
