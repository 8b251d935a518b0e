"""Which symmetries public MuJoCo models have: audits them all and writes docs/models.md.

python benchmarks/models.py
"""

import copy
import importlib
import warnings
from pathlib import Path

import gymnasium
import mujoco
import numpy as np
import torch
from dm_control import suite

from torchrl_sym import PointGroup
from torchrl_sym.mujoco import AuditReport, audit, derive

SUITE = (
    *("cartpole", "acrobot", "pendulum", "reacher", "ball_in_cup"),
    *("humanoid", "cheetah", "walker", "hopper"),
)
BUILT = {"quadruped": "walk", "swimmer": "swimmer6"}  # their models are assembled when they are loaded
GROUPS = {
    "reflect-x": PointGroup.reflection("x"),
    "reflect-y": PointGroup.reflection("y"),
    "rot-180": PointGroup.rotation(2),
    "rot-120": PointGroup.rotation(3),
    "rot-90": PointGroup.rotation(4),
}
HEADER = """# Which symmetries public models have

Made by `python benchmarks/models.py`: `derive` and `audit` of each model at its reference pose. *exact*:
every term agrees to 1e-8; *step* is the largest velocity error of a mirrored step against the step of the
mirror, at 16 states reached by random controls, contact included (elliptic cones, Newton). *approximate*:
the largest residual and where it is. *no*: the first thing that has no counterpart. Planar models
(cart-pole, cheetah, walker, ...) do not move along y, so that reflect-y changes nothing in most of them; in
the walker it exchanges the legs.
"""


def models() -> dict[str, mujoco.MjModel]:
    assets = Path(gymnasium.__file__).parent / "envs/mujoco/assets"
    found = {"gymnasium Ant": mujoco.MjModel.from_xml_path(str(assets / "ant.xml"))}
    for name in SUITE:
        xml, files = importlib.import_module(f"dm_control.suite.{name}").get_model_and_assets()
        found[name] = mujoco.MjModel.from_xml_string(xml, files)
    for name, task in BUILT.items():
        found[name] = suite.load(name, task).physics.model.ptr
    return found


def step_residual(model: mujoco.MjModel, group: PointGroup, states: int = 16, warm_up: int = 60) -> float:
    """Largest velocity error of a mirrored step against the step of the mirror, over reached states.

    With elliptic cones and the Newton solver, whatever the model asks for: others break the symmetry.
    """
    model = copy.deepcopy(model)
    model.opt.cone, model.opt.solver = mujoco.mjtCone.mjCONE_ELLIPTIC, mujoco.mjtSolver.mjSOL_NEWTON
    robot, rng = derive(model, group), np.random.default_rng(0)
    data, image, worst = mujoco.MjData(model), mujoco.MjData(model), 0.0
    low, high = np.where(model.actuator_ctrllimited[:, None], model.actuator_ctrlrange, (-1.0, 1.0)).T
    for state in range(states):
        if state % 4 == 0:
            mujoco.mj_resetData(model, data)
        for _ in range(warm_up):
            data.ctrl[:] = rng.uniform(low, high)
            mujoco.mj_step(model, data)
        for g in range(1, group.order):
            image.qpos[:] = robot.map_qpos(torch.as_tensor(data.qpos), g)
            image.qvel[:] = robot.map_qvel(torch.as_tensor(data.qvel), g)
            image.ctrl[:] = robot.map_ctrl(torch.as_tensor(data.ctrl), g)
            image.act[:] = robot.map_act(torch.as_tensor(data.act), g)
            image.qacc_warmstart[:] = robot.map_qvel(torch.as_tensor(data.qacc_warmstart), g)
            original = copy.copy(data)
            mujoco.mj_step(model, original)
            mujoco.mj_step(model, image)
            expected = robot.map_qvel(torch.as_tensor(original.qvel), g).numpy()
            worst = max(worst, float(np.abs(expected - image.qvel).max()))
    return worst


def cell(model: mujoco.MjModel, group: PointGroup) -> str:
    report: AuditReport = audit(model, group)
    if report.exact:
        return f"exact, step {step_residual(model, group):.0e}"
    if report.reason is not None:
        return f"no: {report.reason.split(' under')[0].split(';')[0]}"
    worst = report.worst
    return f"approximate: {worst.residual:.2g}, {worst.term} of {worst.name}"


def main() -> None:
    warnings.simplefilter("ignore")
    lines = [["model", *GROUPS], ["---"] * (len(GROUPS) + 1)]
    for name, model in models().items():
        lines.append([name, *(cell(model, group) for group in GROUPS.values())])
        print(" | ".join(lines[-1]))
    table = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    path = Path(__file__).parents[1] / "docs" / "models.md"
    path.write_text(
        f"{HEADER}\nMuJoCo {mujoco.__version__}, gymnasium {gymnasium.__version__}.\n\n{table}\n"
    )


if __name__ == "__main__":
    main()
