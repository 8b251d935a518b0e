"""What one GPU makes of the tasks and the recipe: one command, under eight minutes, a folder of numbers.

    python benchmarks/gpu.py                   # on a machine with a card: the extras [gpu,train]
    python benchmarks/gpu.py --device cpu      # tiny, where there is none: whether it works

Parity with MuJoCo's C library, operations for which the host waits, steps per second beside mujoco_warp
alone, an optimiser step beside rsl_rl's (where it is installed), and three trainings: Push with copies,
Push with an equivariant network, CartPole as the comparison trains it. Whoever has a card runs it and
commits the folder; `gpu.md` in it says what the targets are and whether they are met.
"""

from __future__ import annotations

import dataclasses
import json
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import torch
import tyro
from tensordict import TensorDictBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

import tasks
from comparison.files import write_whole
from comparison.markdown import markdown
from comparison.methods import Method
from comparison.provenance import origin
from measuring import cell
from peer import INSTALLED, Peer
from tasks.environment import BatchedEnv
from tasks.settings import SETTINGS
from tasks.warp_fields import mjw, wp
from tasks.warp_simulation import WarpSimulation
from torchrl_sym.recipes import PPOConfig, train
from torchrl_sym.recipes.learner import Learner
from torchrl_sym.recipes.networks import make_networks
from torchrl_sym.recipes.recording import host_waits

HERE = Path(__file__).parent
HIDDEN = (256, 128, 64)  # of the optimiser step that is compared
HORIZON, MINIBATCHES = 24, 4


@dataclass
class Arguments:
    """Measure, train, and write a folder of results."""

    device: str = "cuda"
    """Where; on `cpu`, everything is tiny."""
    out: Path = HERE / "results" / "gpu"
    """Where numbers, curves and the table go."""
    only: tuple[str, ...] = ()
    """Names of parts: parity, waits, rates, updates, trainings."""
    tasks: tuple[str, ...] = ()
    """Whose physics is compared and timed; all on a card, CartPole elsewhere."""
    seconds: float = 75.0
    """Of each training."""


@dataclass
class Scale:
    """How large everything is: on a card, and where there is none."""

    tasks: tuple[str, ...] = tasks.ALL_TASKS
    worlds: tuple[int, ...] = (1024, 4096, 16384)
    training: int = 4096
    steps: int = 100
    rounds: int = 20
    seconds: float = 75.0

    @classmethod
    def of(cls, arguments: Arguments) -> Scale:
        if torch.device(arguments.device).type == "cuda":
            return cls(arguments.tasks or tasks.ALL_TASKS, seconds=arguments.seconds)
        return cls(arguments.tasks or ("cartpole",), (4,), 4, 3, 1, min(arguments.seconds, 2.0))


@dataclass
class Bench:
    """What all parts need."""

    device: str
    scale: Scale
    out: Path
    curves: list[dict[str, Any]] = field(default_factory=list)

    @property
    def card(self) -> bool:
        """Whether there is one."""
        return torch.device(self.device).type == "cuda"

    def env(self, task: str, num_envs: int, **kwargs: Any) -> BatchedEnv:
        """An environment whose physics is mujoco_warp's, on the device."""
        return tasks.make_env(task, num_envs=num_envs, seed=0, device=self.device, engine="warp", **kwargs)

    def wait(self) -> None:
        """Until the device has done everything."""
        if self.card:
            torch.cuda.synchronize()

    def clock(self, work: Callable[[], object], rounds: int, warmup: int = 3) -> float:
        """Median seconds of a piece of work, the device's part included."""
        for _ in range(warmup):
            work()
        taken = []
        for _ in range(rounds):
            self.wait()
            start = time.perf_counter()
            work()
            self.wait()
            taken.append(time.perf_counter() - start)
        return median(taken)


def parity(bench: Bench) -> Iterator[dict[str, Any]]:
    """Largest relative difference of a control step's state from MuJoCo's C library."""
    for task in bench.scale.tasks:
        n = min(64, bench.scale.worlds[0])
        ours, reference = bench.env(task, n), tasks.make_env(task, num_envs=n, num_threads=0, seed=0)
        start = reference.task.sample_initial_state(n, torch.Generator().manual_seed(0))
        first, other = ours.reset_to(start), reference.reset_to(start)
        action = torch.rand(n, ours.task.action_size, generator=torch.Generator().manual_seed(1)) * 2 - 1
        ours.step(first.set("action", action.to(ours.device)))
        reference.step(other.set("action", action))
        row: dict[str, Any] = {"task": task, "worlds": n}
        for name in ("qpos", "qvel"):
            a, b = (getattr(env.simulation, name).cpu().double() for env in (ours, reference))
            row[name] = float(((a - b).abs() / b.abs().clamp(min=1.0)).amax())
        yield row


def waits(bench: Bench) -> Iterator[dict[str, Any]]:
    """Operations for which the host waits, as torch's sync debug mode reports them; CUDA alone has it."""
    if not bench.card:
        return
    env = bench.env(bench.scale.tasks[-1], bench.scale.worlds[0])
    td = env.rand_action(env.reset())
    ended = env.step(td)["next"]
    yield {"what": "env.step", "waits": _count(partial(env.step, td))}
    yield {"what": "reset of the rows that are done", "waits": _count(partial(env.maybe_reset, ended))}
    for method in ("aug", "equivariant"):
        learner, rows = _learner(bench, method)
        learner.fit(rows)
        found = _count(partial(learner.fit, rows))
        yield {"what": f"all updates of an iteration, {method}", "waits": found}


def rates(bench: Bench) -> Iterator[dict[str, Any]]:
    """Physics steps per second of mujoco_warp alone, and of env.step with uniform actions."""
    for task in bench.scale.tasks:
        for worlds in bench.scale.worlds:
            env = bench.env(task, worlds)
            substeps, td = env.task.substeps, env.reset()
            alone = bench.clock(_alone(env), bench.scale.steps)
            td["action"] = env.rand_action(td)["action"]
            step = bench.clock(partial(env.step_and_maybe_reset, td), bench.scale.steps)
            yield {
                "task": task,
                "worlds": worlds,
                "mujoco_warp": worlds * substeps / alone,
                "env_step": worlds * substeps / step,
                "control_steps": worlds / step,
                "share": alone / step,
            }


def _alone(env: BatchedEnv) -> Callable[[], object]:
    """A control step of the same physics, with nothing of ours: a graph of mujoco_warp's kernels."""
    engine = env.simulation
    assert isinstance(engine, WarpSimulation)
    place = wp.get_device(str(engine.device))
    with wp.ScopedDevice(place):
        physics, room = mjw.put_model(engine.model), {"nconmax": engine.nconmax, "njmax": engine.njmax}
        data = mjw.put_data(engine.model, engine.data(0), nworld=engine.num_envs, **room)
        physics.opt.warn_overflow = 0
        mjw.step(physics, data)
        wp.synchronize_device(place)
        with wp.ScopedCapture(place) as capture:
            for _ in range(env.task.substeps):
                mjw.step(physics, data)
    return partial(wp.capture_launch, capture.graph)


def updates(bench: Bench) -> Iterator[dict[str, Any]]:
    """Milliseconds of an optimiser step on 24,576 rows of Push: plain, with copies, with a network."""
    options: dict[str, dict[str, Any]] = {"ours": {}}
    if bench.card:  # elsewhere, compiling takes longer than all the rest
        options |= {"compiled": {"compile": True}, "bfloat16": {"compile": True, "autocast": "bfloat16"}}
    for method in ("ppo", "aug", "equivariant"):
        for who, changes in options.items():
            torch._dynamo.reset()  # or it counts the learners before this one as recompilations
            learner, rows = _learner(bench, method, **changes)
            seconds = bench.clock(partial(learner.fit, rows), bench.scale.rounds)
            yield {"method": method, "who": who, "step_ms": 1e3 * seconds / MINIBATCHES}
        if INSTALLED and method != "equivariant":
            config = dataclasses.replace(_config(bench, method), hidden=HIDDEN, epochs=1)
            peer = Peer(config, _push(bench, config.num_envs))
            peer.collect()
            seconds = bench.clock(peer.learn, bench.scale.rounds)
            yield {"method": method, "who": "rsl_rl", "step_ms": 1e3 * seconds / MINIBATCHES}


def trainings(bench: Bench) -> Iterator[dict[str, Any]]:
    """Push for a while, with copies and with an equivariant network; CartPole's run of the comparison."""
    for method in ("aug", "equivariant"):
        config = dataclasses.replace(_config(bench, method), iterations=10**6, compile=bench.card)
        yield _train(bench, "anymal_push", method, config, bench.scale.seconds)
    setting = Method.parse("aug").configure(SETTINGS["cartpole"], seed=0)
    changes = {"device": bench.device, "compile": bench.card}
    yield _train(
        bench, "cartpole", "aug", dataclasses.replace(setting.config, **changes), 4 * bench.scale.seconds
    )


def _train(bench: Bench, task: str, method: str, config: PPOConfig, limit: float) -> dict[str, Any]:
    """Train to the end or a limit, s, without the first iteration, in which everything is compiled."""
    torch._dynamo.reset()
    kwargs = SETTINGS[task].task
    engine = "warp" if task in bench.scale.tasks else "mujoco"
    make_env = partial(tasks.make_env, task, device=bench.device, engine=engine, **kwargs)
    training = train(config, make_env, make_env(num_envs=1, seed=0).symmetry)
    first = dict(next(training))
    latest, begun = first, time.perf_counter()
    while time.perf_counter() - begun < limit:
        metrics = next(training, None)
        if metrics is None:
            break
        latest = dict(metrics)
        bench.curves.append(
            {"task": task, "method": method, "clock": time.perf_counter() - begun, **latest}
        )
    taken = time.perf_counter() - begun
    training.close()
    return {
        "task": task,
        "method": method,
        "first_iteration_s": first["seconds"],
        "seconds": taken,
        "frames": latest["frames"],
        "frames_per_second": (latest["frames"] - first["frames"]) / taken,
        "return": latest["return"],
        "success": latest.get("success"),
        "level": latest.get("level"),
    }


def _config(bench: Bench, method: str) -> PPOConfig:
    setting = Method.parse(method).configure(SETTINGS["anymal_push"], seed=0)
    size = {"num_envs": bench.scale.training, "horizon": HORIZON, "minibatches": MINIBATCHES}
    return dataclasses.replace(setting.config, device=bench.device, **size)


def _push(bench: Bench, num_envs: int) -> BatchedEnv:
    """Push, on whatever engine is faster there: what is measured with it is not the physics."""
    engine = "warp" if bench.card else "mujoco"
    return tasks.make_env("anymal_push", num_envs=num_envs, seed=0, device=bench.device, engine=engine)


def _learner(bench: Bench, method: str, **options: Any) -> tuple[Learner, TensorDictBase]:
    """A learner, and rows of one batch of the task Push to learn from in one epoch."""
    config = dataclasses.replace(_config(bench, method), hidden=HIDDEN, epochs=1, **options)
    env = _push(bench, config.num_envs)
    symmetry = env.symmetry.to(bench.device)
    actor, critic = make_networks(config, env, symmetry)
    learner = Learner(config, actor, critic, symmetry)
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        data = env.rollout(config.horizon, actor, break_when_any_done=False)
    return learner, learner.estimate(data)


def _count(work: Callable[[], object]) -> int:
    """How often the host waits in a piece of work."""
    torch.cuda.synchronize()
    return len(host_waits(work)[1])


PARTS = {"parity": parity, "waits": waits, "rates": rates, "updates": updates, "trainings": trainings}


def main(arguments: Arguments) -> int:
    bench = Bench(arguments.device, Scale.of(arguments), arguments.out)
    card = torch.cuda.get_device_name() if bench.card else "no card"
    results: dict[str, Any] = {"card": card, "device": bench.device, **origin(), "tables": {}}
    for name in arguments.only or PARTS:
        begun = time.perf_counter()
        results["tables"][name] = rows = []
        print(f"\n{PARTS[name].__doc__}", flush=True)
        for row in PARTS[name](bench):
            rows.append(row)
            print("  ".join(f"{key} {cell(value)}" for key, value in row.items()), flush=True)
            results["seconds"] = results.get("seconds", {}) | {name: time.perf_counter() - begun}
            save(bench, results)  # what is there stays, whatever comes
    return 0


def save(bench: Bench, results: dict[str, Any]) -> None:
    """Numbers, curves, and both as a page."""
    bench.out.mkdir(parents=True, exist_ok=True)
    write_whole(bench.out / "gpu.json", json.dumps(results, indent=1) + "\n")
    keys = list(dict.fromkeys(key for row in bench.curves for key in row))
    lines = [",".join(keys), *(",".join(str(row.get(key, "")) for key in keys) for row in bench.curves)]
    write_whole(bench.out / "curves.csv", "\n".join(lines) + "\n")
    write_whole(bench.out / "gpu.md", page(results))


def targets(tables: dict[str, list[dict[str, Any]]]) -> Iterator[tuple[str, float, bool]]:
    """What was aimed at on one H100, what was measured, and whether that is enough."""
    for row in tables.get("parity", ()):
        found = max(row["qpos"], row["qvel"])
        yield f"a control step of {row['task']} within 1e-4 of MuJoCo's", found, found <= 1e-4
    for row in tables.get("waits", ()):
        yield f"the host waits for nothing: {row['what']}", row["waits"], row["waits"] == 0
    for row in tables.get("rates", ()):
        if row["worlds"] == 4096:
            name = f"env.step of {row['task']} at 4,096 worlds, 0.8 of mujoco_warp's rate"
            yield name, row["share"], row["share"] >= 0.8
    for row in tables.get("updates", ()):
        if (row["method"], row["who"]) == ("aug", "compiled"):
            yield "an optimiser step with copies in 2 ms", row["step_ms"], row["step_ms"] <= 2
    for row in tables.get("trainings", ()):
        if (row["task"], row["method"]) == ("anymal_push", "aug"):
            rate = row["frames_per_second"]
            yield "Push with copies, 250,000 steps per second", rate, rate >= 250_000
        if row["task"] == "cartpole":
            yield "CartPole's run in 15 s", row["seconds"], row["seconds"] < 15


def page(results: dict[str, Any]) -> str:
    """All tables as Markdown."""
    versions = ", ".join(f"{name} {version}" for name, version in results["versions"].items())
    text = f"Made by `python benchmarks/gpu.py` at {results['revision']} on {results['card']} "
    text += f"({results['machine']}; {versions}).\n"
    if results["device"] != "cpu":
        judged = [
            [name, cell(found), "met" if met else "**not met**"]
            for name, found, met in targets(results["tables"])
        ]
        text += f"\n## Targets\n\n{markdown(['target', 'measured', 'verdict'], judged)}"
    for name, rows in results["tables"].items():
        if rows:
            heads = list(rows[0])
            body = [[cell(row.get(head)) for head in heads] for row in rows]
            about = str(PARTS[name].__doc__)
            text += f"\n## {name}\n\n{about}\n\n{markdown(heads, body)}"
    return text


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Arguments)))
