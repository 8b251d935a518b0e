"""Which symmetries public MuJoCo models have: audits them all and writes docs/models.md.

python benchmarks/models.py
"""

import importlib
import warnings
from pathlib import Path

import gymnasium
import mujoco
from dm_control import suite

from torchrl_sym import PointGroup
from torchrl_sym.mujoco import AuditReport, audit

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
every term agrees to 1e-8, so that the simulator commutes with the element. *approximate*: the largest
residual and where it is. *no*: the first thing that has no counterpart. Planar models (cart-pole, cheetah,
walker, ...) do not move along y, so that reflect-y changes nothing in most of them; in the walker it
exchanges the legs.
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


def cell(report: AuditReport) -> str:
    if report.exact:
        return "exact"
    if report.reason is not None:
        return f"no: {report.reason.split(' under')[0].split(';')[0]}"
    worst = report.worst
    return f"approximate: {worst.residual:.2g}, {worst.term} of {worst.name}"


def main() -> None:
    warnings.simplefilter("ignore")
    lines = [["model", *GROUPS], ["---"] * (len(GROUPS) + 1)]
    for name, model in models().items():
        lines.append([name, *(cell(audit(model, group)) for group in GROUPS.values())])
        print(" | ".join(lines[-1]))
    table = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    path = Path(__file__).parents[1] / "docs" / "models.md"
    path.write_text(
        f"{HEADER}\nMuJoCo {mujoco.__version__}, gymnasium {gymnasium.__version__}.\n\n{table}\n"
    )


if __name__ == "__main__":
    main()
