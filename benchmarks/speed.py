"""How fast the hot paths are, as ratios to what they could be at best, measured side by side.

    python benchmarks/speed.py            # all, about fifteen minutes on two cores
    python benchmarks/speed.py --only options

Every table compares our code with its limit in one run: environments with raw physics, losses with plain
ClipPPOLoss and with bare torch of the same arithmetic, augmentation with a copy of memory, iterations of
training with rsl_rl's (where it is installed, see peer.py), audits with derive, equivariant networks with
dense ones. The variants of a row are timed in turn, round by round, so that a machine that slows down slows
all of them; a figure is the median over rounds, a ratio the median of the rounds' ratios. One torch thread.
"""

import functools
import json
import math
import platform
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from statistics import median
from typing import Literal

import mujoco
import numpy as np
import tensordict
import torch
import torchrl
import tyro
from mujoco.batch import Batch
from tensordict import TensorDict
from tensordict.nn import AddStateIndependentNormalScale, TensorDictModule
from torch import nn
from torchrl.envs import EnvBase, ParallelEnv
from torchrl.envs.libs.dm_control import DMControlWrapper
from torchrl.modules import MLP, IndependentNormal, ProbabilisticActor, ValueOperator
from torchrl.objectives import ClipPPOLoss

import tasks
from audits import measure_audits
from equivariant import measure_compiled, measure_equivariant
from iterations import measure_iterations, measure_options
from measuring import cell, interleave, ratio, show
from peer import INSTALLED
from torchrl_sym import PointGroup, SymmetricClipPPOLoss, Symmetry, SymmetryAugment
from torchrl_sym.representations import axial, polar, signed_permutation

OBSERVATION, ACTION = 48, 12  # a quadruped's proprioception and joints
LOSS = {"clip_epsilon": 0.2, "entropy_coeff": 0.01, "critic_coeff": 1.0, "loss_critic_type": "l2"}


@dataclass
class Arguments:
    """Measure and print ratios."""

    only: (
        Literal["env", "loss", "augment", "audit", "networks", "networks_compiled", "iteration", "options"]
        | None
    ) = None
    """One of the tables; those that compile for minutes are made only if they are asked for."""
    tasks: tuple[str, ...] = tasks.ALL_TASKS
    """Tasks whose environments are timed."""
    rounds: int = 15
    """Timed rounds per row."""
    settle: int = 100
    """Environment steps before the clock starts."""
    threads: int = 2
    """Physics threads."""
    num_envs: tuple[int, ...] = (64, 512, 2048)
    """Sizes of the batched environment."""
    rows: tuple[int, ...] = (256, 4096, 16384)
    """Minibatch sizes of losses and augmentation."""
    output: Path | None = Path(__file__).parent / "results" / "speed.json"
    """Where the figures go."""


def markdown(results: dict) -> str:
    """All tables, for people; the JSON file has the same figures for programs."""
    text = "Made by `python benchmarks/speed.py`.\n"
    for name in (name for name in TABLES if name in results):
        made = results["made"][name]
        versions = ", ".join(f"{package} {version}" for package, version in made["versions"].items())
        keys = list(results[name][0])
        lines = [keys, ["---:"] * len(keys), *([cell(row[k]) for k in keys] for row in results[name])]
        text += f"\n## {name}\n\n{made['processor']}; {versions}.\n\n"
        text += "".join(f"| {' | '.join(line)} |\n" for line in lines)
    return text


# --- environments


def measure_envs(arguments: Arguments) -> list[dict]:
    """Env steps per second, resets included, against raw physics and against TorchRL's processes."""
    print(f"\nenvironment steps per second, {arguments.threads} physics threads")
    rows = []
    for task in arguments.tasks:
        parallel = parallel_env_rate(task, arguments.rounds)
        for n in arguments.num_envs:
            env = tasks.make_env(task, num_envs=n, num_threads=arguments.threads, seed=0)
            steps = steps_of_a_round(env)
            variants = {"raw": raw_physics(env, steps, arguments.threads), "env": stepping(env, steps)}
            for run in variants.values():  # until robots stand: in the air there is little to solve
                for _ in range(math.ceil(arguments.settle / steps)):
                    run()
            seconds = interleave(variants, arguments.rounds)
            rate = {name: n * steps / median(values) for name, values in seconds.items()}
            row = {
                "task": task,
                "num_envs": n,
                "raw_per_second": rate["raw"],
                "env_per_second": rate["env"],
                "env_over_raw": ratio(seconds, "raw", "env"),
                "parallel_per_second": parallel,
                "env_over_parallel": rate["env"] / parallel,
            }
            rows.append(row)
            show(rows)
    return rows


def steps_of_a_round(env: EnvBase, seconds: float = 0.4) -> int:
    """As many steps as take long enough that switching variants does not show."""
    run = stepping(env, 8)
    run()
    start = time.perf_counter()
    run()
    return max(8, round(8 * seconds / (time.perf_counter() - start)))


def stepping(env: EnvBase, steps: int) -> Callable[[], None]:
    """Steps with small random actions, and automatic resets, as a collector makes them."""
    state = env.reset()
    actions = small_actions(env, steps)

    def run() -> None:
        nonlocal state
        for action in actions:
            _, state = env.step_and_maybe_reset(state.set("action", action))

    return run


def raw_physics(env: EnvBase, steps: int, threads: int) -> Callable[[], None]:
    """The same model from the same starts under the same controls, with nothing around it."""
    env.reset()
    simulation = Batch(env.task.model, env.batch_size[0], threads)
    start = env.state
    fields = {name: getattr(start, name) for name in ("qpos", "qvel", "mocap_pos", "mocap_quat")}
    views = {name: simulation.bind(name) for name, value in fields.items() if value is not None}
    ctrl = simulation.bind("ctrl")
    controls = [env.task.control(a, start).double().numpy() for a in small_actions(env, steps)]

    for name, view in views.items():
        view[:] = fields[name].numpy()

    def run() -> None:
        for control in controls:
            ctrl[:] = control
            simulation.step(nstep=env.task.substeps)

    return run


def small_actions(env: EnvBase, steps: int) -> torch.Tensor:
    """Actions under which robots keep standing.

    Those that fall are reset by the environment, but not by raw physics, which then has more contacts to
    solve: the two would not simulate the same.
    """
    return 0.2 * torch.rand(steps, *env.action_spec.shape) - 0.1


def dm_control_face(task: str) -> EnvBase:
    return DMControlWrapper(tasks.load(task))


def parallel_env_rate(task: str, rounds: int, steps: int = 100) -> float:
    """Steps per second of two processes, each with the dm_control face of the task."""
    env = ParallelEnv(2, functools.partial(dm_control_face, task), mp_start_method="spawn")
    try:
        env.reset()
        run = stepping(env, steps)
        return 2 * steps / median(interleave({"parallel": run}, min(rounds, 7))["parallel"])
    finally:
        env.close()


# --- losses


def measure_losses(arguments: Arguments) -> list[dict]:
    """One update (loss, backward, Adam) against ClipPPOLoss on as many rows, and against bare torch."""
    print("\nmilliseconds per update of a 3 x 128 actor and critic, 48 observations, 12 actions")
    groups = {1: PointGroup.trivial(), 2: PointGroup.reflection("y"), 4: PointGroup.klein_four()}
    table = []
    for rows in arguments.rows:
        for n, group in groups.items():
            symmetry = quadruped(group)
            batch = random_batch(rows)
            augmented = SymmetryAugment(symmetry)(batch)
            for elements in ("all", "random"):
                data = augmented if elements == "all" else batch  # as many rows for the others
                variants = {
                    "symmetric": update(batch, SymmetricClipPPOLoss, symmetry=symmetry, elements=elements),
                    "clip_ppo": update(data, ClipPPOLoss),
                    "bare": bare_update(data),
                }
                rounds = arguments.rounds if rows * n < 20000 else max(3, arguments.rounds // 3)
                seconds = interleave(variants, rounds)
                row = {
                    "rows": rows,
                    "order": n,
                    "elements": elements,
                    **{f"{name}_ms": 1e3 * median(values) for name, values in seconds.items()},
                    "over_clip_ppo": ratio(seconds, "symmetric", "clip_ppo"),
                    "over_bare": ratio(seconds, "symmetric", "bare"),
                }
                table.append(row)
                show(table)
    return table


def quadruped(group: PointGroup) -> Symmetry:
    """Four vectors and three frames of twelve joints, mirrored as ANYmal's are."""
    legs = {"reflect-x": "FH", "reflect-y": "LR"}
    flipped = {"reflect-x": ("HFE", "KFE"), "reflect-y": ("HAA",)}
    names = [f"{leg}_{joint}" for leg in ("LF", "RF", "LH", "RH") for joint in ("HAA", "HFE", "KFE")]
    maps = {}
    for element in {"reflect-x", "reflect-y"} & set(group.names):
        swap = str.maketrans(legs[element], legs[element][::-1])
        maps[element] = {
            name: ("-" if name.endswith(flipped[element]) else "") + name[:2].translate(swap) + name[2:]
            for name in names
        }
    joints = signed_permutation(group, names, maps)
    observation = polar(group) + axial(group) + polar(group) + polar(group) + joints * 3
    return Symmetry(group, {"observation": observation, "action": joints})


def random_batch(rows: int) -> TensorDict:
    torch.manual_seed(0)
    return TensorDict(
        observation=torch.randn(rows, OBSERVATION),
        action=torch.randn(rows, ACTION),
        action_log_prob=-17 - torch.rand(rows),
        advantage=torch.randn(rows, 1),
        value_target=torch.randn(rows, 1),
        batch_size=[rows],
    )


def networks() -> tuple[nn.Sequential, nn.Sequential]:
    torch.manual_seed(0)
    sizes = {"num_cells": [128, 128, 128], "activation_class": nn.ELU}
    return MLP(OBSERVATION, ACTION, **sizes), MLP(OBSERVATION, 1, **sizes)


def update(batch: TensorDict, loss_class: type[ClipPPOLoss], **kwargs) -> Callable[[], None]:
    policy, value = networks()
    head = nn.Sequential(policy, AddStateIndependentNormalScale(ACTION))
    actor = ProbabilisticActor(
        TensorDictModule(head, in_keys=["observation"], out_keys=["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )
    critic = ValueOperator(value, in_keys=["observation"])
    loss = loss_class(actor, critic, **LOSS, **kwargs)
    optimizer = torch.optim.Adam([*actor.parameters(), *critic.parameters()], lr=1e-4)

    def run() -> None:
        out = loss(batch)
        optimizer.zero_grad()
        (out["loss_objective"] + out["loss_critic"] + out["loss_entropy"]).backward()
        optimizer.step()

    return run


def bare_update(batch: TensorDict) -> Callable[[], None]:
    """The arithmetic of ClipPPOLoss and nothing else."""
    policy, value = networks()
    log_std = nn.Parameter(torch.zeros(ACTION))
    optimizer = torch.optim.Adam([*policy.parameters(), *value.parameters(), log_std], lr=1e-4)
    observation, action, log_prob_old, advantage, target = (
        batch[key] for key in ("observation", "action", "action_log_prob", "advantage", "value_target")
    )
    advantage = advantage.squeeze(-1)
    low, high = np.log1p(-LOSS["clip_epsilon"]), np.log1p(LOSS["clip_epsilon"])
    log_two_pi = ACTION * np.log(2 * np.pi)

    def run() -> None:
        z = (action - policy(observation)) / log_std.exp()
        log_prob = -0.5 * (z.square().sum(-1) + log_two_pi) - log_std.sum()
        log_ratio = log_prob - log_prob_old
        gain = torch.minimum(log_ratio.exp() * advantage, log_ratio.clamp(low, high).exp() * advantage)
        entropy = log_std.sum() + 0.5 * (ACTION + log_two_pi)
        loss_critic = (value(observation) - target).square().mean()
        optimizer.zero_grad()
        (loss_critic - gain.mean() - LOSS["entropy_coeff"] * entropy).backward()
        optimizer.step()

    return run


# --- augmentation


def measure_augmentation(arguments: Arguments) -> list[dict]:
    """SymmetryAugment with four elements, against copying as many bytes."""
    print("\nmilliseconds per augmented batch, N = 4, 48 observations, 12 actions")
    symmetry = quadruped(PointGroup.klein_four())
    table = []
    for rows in arguments.rows:
        batch = random_batch(rows)
        for elements in ("all", "random"):
            augment = SymmetryAugment(symmetry, elements=elements)
            result = augment(batch)
            variants = {"augment": lambda: augment(batch), "copy": result.clone}  # noqa: B023
            seconds = interleave(variants, 3 * arguments.rounds)
            row = {
                "rows": rows,
                "elements": elements,
                **{f"{name}_ms": 1e3 * median(values) for name, values in seconds.items()},
                "over_copy": ratio(seconds, "augment", "copy"),
            }
            table.append(row)
            show(table)
    return table


# --- tables of other files


def measure_rows(arguments: Arguments, measure: Callable) -> list[dict]:
    """A table of iterations.py, audits.py or equivariant.py."""
    print(f"\n{measure.__doc__}")
    table = []
    for row in measure(arguments.tasks, arguments.rounds):
        table.append(row)
        show(table)
    return table


TABLES: dict[str, Callable[[Arguments], list[dict]]] = {
    "env": measure_envs,
    "loss": measure_losses,
    "augment": measure_augmentation,
    "audit": functools.partial(measure_rows, measure=measure_audits),
    "networks": functools.partial(measure_rows, measure=measure_equivariant),
    "networks_compiled": functools.partial(measure_rows, measure=measure_compiled),
    "iteration": functools.partial(measure_rows, measure=measure_iterations),
    "options": functools.partial(measure_rows, measure=measure_options),
}


COMPILING = ("networks_compiled", "options")


def main(arguments: Arguments) -> None:
    torch.set_num_threads(1)
    results = {
        name: measure(arguments)
        for name, measure in TABLES.items()
        if name == arguments.only or (arguments.only is None and name not in COMPILING)
    }
    made = {
        "processor": processor(),
        "physics_threads": arguments.threads,
        "versions": {
            "python": platform.python_version(),
            **{module.__name__: module.__version__ for module in (torch, torchrl, tensordict, mujoco)},
            "rsl_rl": version("rsl-rl-lib") if INSTALLED else "not installed",
        },
    }
    if arguments.output is not None:
        kept = json.loads(arguments.output.read_text()) if arguments.output.exists() else {}
        results = kept | results | {"made": kept.get("made", {}) | dict.fromkeys(results, made)}
        arguments.output.parent.mkdir(parents=True, exist_ok=True)
        arguments.output.write_text(json.dumps(results, indent=2) + "\n")
        arguments.output.with_suffix(".md").write_text(markdown(results))
        print(f"\nwritten to {arguments.output} and {arguments.output.with_suffix('.md')}")


def processor() -> str:
    """Model name of the processor, as far as the system tells."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":")[1].strip() for line in lines if line.startswith("model name")]
    return f"{len(names)} x {names[0]}" if names else platform.processor()


if __name__ == "__main__":
    main(tyro.cli(Arguments))
