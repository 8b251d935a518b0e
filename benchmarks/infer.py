"""infer on public environments: what is found, whether it verifies, and how long it takes.

Writes docs/infer.md. Environments of packages that are not installed (gymnasium-robotics) are left out, and
said so. Run by `python benchmarks/infer.py`, or with parts of names to run some of them.
"""

import sys
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

import tasks
from torchrl_sym import PointGroup, Symmetry
from torchrl_sym.mujoco import InferenceError, Remembered, SymmetryError, infer, verify
from torchrl_sym.representations import planar, polar

PAGE = Path(__file__).resolve().parents[1] / "docs" / "infer.md"
GROUPS = {
    "reflect-x": PointGroup.reflection("x"),
    "reflect-y": PointGroup.reflection("y"),
    "klein_four": PointGroup.klein_four(),
    "rotation-3": PointGroup.rotation(3),
    "rotation-4": PointGroup.rotation(4),
    "dihedral-4": PointGroup.dihedral(4),
}


@dataclass
class Case:
    """An environment, and the group to try."""

    name: str
    make: Callable[[], Any]
    group: str
    remark: str = ""
    options: dict[str, Any] = field(default_factory=dict)


def gym(name: str, group: str, remark: str = "", **options: Any) -> Case:
    def make() -> Any:
        import gymnasium

        if "Maze" in name:
            import gymnasium_robotics

            gymnasium.register_envs(gymnasium_robotics)
        return gymnasium.make(name)

    return Case(f"gymnasium {name}", make, group, remark, options)


def suite(name: str, group: str, remark: str = "", **options: Any) -> Case:
    def make() -> Any:
        from dm_control import suite as dm_suite

        return dm_suite.load(*name.split(), task_kwargs={"random": 0})

    return Case(f"dm_control {name}", make, group, remark, options)


def composer(group: str) -> Case:
    def make() -> Any:
        from dm_control import composer as dm_composer
        from dm_control.locomotion.arenas import floors
        from dm_control.locomotion.tasks import go_to_target
        from dm_control.locomotion.walkers import ant

        task = go_to_target.GoToTarget(walker=ant.Ant(), arena=floors.Floor())
        return dm_composer.Environment(task, strip_singleton_obs_buffer_dim=True, random_state=0)

    def no_target(observation: dict[str, Any]) -> dict[str, Any]:
        return {key: x for key, x in observation.items() if not key.endswith("target")}

    return Case("locomotion ant", make, group, "without its target", {"observe": no_target})


def task(name: str, group: str) -> Case:
    return Case(f"tasks {name}", lambda: tasks.make_env(name, num_envs=16, num_threads=1, seed=0), group)


def geom_place(geom: str, group: str) -> Remembered:
    """A target that a dm_control task keeps as the place of a geom of the model."""

    def save(env: Any) -> dict[str, Any]:
        return {"target": np.array(env.physics.named.model.geom_pos[geom])}

    def load(env: Any, values: dict[str, Any]) -> None:
        env.physics.named.model.geom_pos[geom] = values["target"]

    return Remembered({"target": polar(GROUPS[group])}, save, load)


def goal(group: str) -> dict[str, Any]:
    return {"memory": {"goal": planar(GROUPS[group])}}


FORWARD = "its reward is for going forward"
CASES = [
    gym("Ant-v5", "reflect-y"),
    *(gym("Ant-v5", g, FORWARD) for g in ("klein_four", "rotation-4", "dihedral-4")),
    gym("Ant-v4", "reflect-y"),
    *(gym(f"Swimmer-v{v}", "reflect-y") for v in (4, 5)),
    *(gym(f"InvertedPendulum-v{v}", "reflect-x", "its pole leans by 1 mm") for v in (4, 5)),
    *(gym(f"InvertedDoublePendulum-v{v}", "reflect-x", "gravity is tilted by 1e-6 rad") for v in (4, 5)),
    gym("Humanoid-v5", "reflect-y", "its solver stops early", tolerance=0.05),
    gym("Reacher-v5", "reflect-y"),
    gym("Walker2d-v5", "reflect-y"),
    gym("HalfCheetah-v5", "reflect-y"),
    gym("Hopper-v5", "reflect-y"),
    gym("Pusher-v5", "reflect-y"),
    gym("PointMaze_Open-v3", "klein_four", "its goal is handed over", **goal("klein_four")),
    gym("PointMaze_UMaze-v3", "reflect-y", "its goal is handed over",
        **goal("reflect-y")),
    gym("AntMaze_Open-v5", "klein_four", "its goal is handed over", **goal("klein_four")),
    suite("acrobot swingup", "reflect-x"),
    suite("ball_in_cup catch", "reflect-x"),
    *(suite(f"cartpole {t}", "reflect-x") for t in ("balance", "swingup", "two_poles", "three_poles")),
    suite("cheetah run", "reflect-y"),
    suite("dog walk", "reflect-y"),
    suite("finger spin", "reflect-y"),
    suite("fish upright", "reflect-x"),
    suite("fish swim", "reflect-x"),
    suite("hopper hop", "reflect-y"),
    *(suite(f"humanoid {t}", "reflect-y", "starts in its ranges, which differ by side")
      for t in ("stand", "run_pure_state")),
    suite("humanoid_CMU stand", "reflect-y"),
    *(suite(f"lqr {t}", "reflect-y") for t in ("lqr_2_1", "lqr_6_2")),
    suite("manipulator bring_ball", "reflect-x"),
    suite("pendulum swingup", "reflect-x"),
    *(suite("point_mass easy", g) for g in ("klein_four", "rotation-4", "rotation-3")),
    suite("quadruped walk", "reflect-y"),
    suite("quadruped run", "reflect-y"),
    suite("reacher easy", "reflect-y", "its target is handed over",
          memory=geom_place("target", "reflect-y")),
    suite("stacker stack_2", "reflect-x"),
    suite("swimmer swimmer6", "reflect-y"),
    suite("walker walk", "reflect-y"),
    composer("reflect-y"),
    task("cartpole", "reflect-x"),
    task("anymal_climb", "klein_four"),
    task("anymal_push", "klein_four"),
    task("trifinger_repose", "rotation-3"),
]  # fmt: skip


@dataclass
class Row:
    """What came of a case."""

    case: Case
    seconds: float
    found: str = ""
    verdict: str = ""
    refusal: str = ""


def run(case: Case) -> Row:
    env = case.make()
    start = time.perf_counter()
    try:
        symmetry = infer(env, GROUPS[case.group], **case.options)
    except (InferenceError, SymmetryError) as error:
        first, *rest = str(error).split("\n")
        reason = rest[0].strip() if rest else first
        return Row(case, time.perf_counter() - start, refusal=reason)
    seconds = time.perf_counter() - start
    observed = {k: v for k, v in case.options.items() if k in ("memory", "observe")}
    report = verify(env, symmetry, states=8, steps=3, **observed)
    verdict = report.verdict if report.passed else f"{report.verdict} ({report.worst.where})"
    declared = getattr(env, "symmetry", None)
    if isinstance(declared, Symmetry):
        verdict += f"; {compared(symmetry, declared)}"
    return Row(case, seconds, described(symmetry), verdict)


def compared(symmetry: Symmetry, declared: Symmetry) -> str:
    """Whether it is what a person has declared, but for entries that never change."""
    moved = [
        i
        for key in list(declared.keys())
        for i in (symmetry[key].matrices - declared[key].matrices).abs().amax((0, 2)).nonzero()
    ]
    if not moved:
        return "equal to what is declared"
    return f"equal to what is declared but for {len(moved)} entries that never change"


def described(symmetry: Symmetry) -> str:
    parts = [symmetry[key] for key in list(symmetry.keys())]
    kind = "signs and places" if all(p.is_signed_permutation for p in parts) else "mixing"
    entries = sum(part.dim for part in parts) - symmetry["action"].dim
    return f"{entries} + {symmetry['action'].dim}, {kind}"


def page(rows: list[Row], missing: list[str]) -> str:
    found, refused = ([r for r in rows if bool(r.refusal) == flag] for flag in (False, True))
    passed = sum(row.verdict.startswith("symmetric") for row in found)
    lines = [
        "# How observations of public environments transform",
        "",
        "Made by `python benchmarks/infer.py`. Nothing was declared by hand, but for goals and targets",
        "that are drawn at a reset and kept outside MuJoCo (`memory=`). *entries*: of the observation and",
        "of the action. Seconds are those of `infer`, on two cores that were shared with other work.",
        "",
        f"{len(found)} found, {passed} of them verified whole; the others are no symmetric task, as "
        "`verify` says.",
        "",
        "| environment | group | entries | seconds | verify | |",
        "| --- | --- | --- | ---: | --- | --- |",
    ]
    for r in found:
        c = r.case
        lines.append(f"| {c.name} | {c.group} | {r.found} | {r.seconds:.1f} | {r.verdict} | {c.remark} |")
    lines += ["", "Refused, with the first reason:", "", "| environment | group | seconds | reason |",
              "| --- | --- | ---: | --- |"]  # fmt: skip
    for r in refused:
        lines.append(f"| {r.case.name} | {r.case.group} | {r.seconds:.1f} | {r.refusal} |")
    if missing:
        lines += ["", f"Not installed: {', '.join(missing)}."]
    return "\n".join(lines) + "\n"


def main() -> None:
    warnings.filterwarnings("ignore")
    torch.set_num_threads(1)
    wanted = sys.argv[1:]
    rows, missing = [], []
    for case in CASES:
        if wanted and not any(part in case.name for part in wanted):
            continue
        try:
            rows.append(run(case))
        except ImportError:
            missing.append(case.name)
            continue
        row = rows[-1]
        answer = f"refused: {row.refusal}" if row.refusal else f"{row.found}: {row.verdict}"
        print(f"{case.name} {case.group} {row.seconds:.1f} s {answer}", flush=True)
    if not wanted:
        PAGE.write_text(page(rows, missing))


if __name__ == "__main__":
    main()
