"""Smoke test of an installed wheel; `make build` runs it once for every extra alone, in clean environments.

    python -I smoke_wheel.py core|mujoco|tasks|train

It needs nothing but the wheel and what the extra brings (no pytest), and fails loudly. Parts of the library
that need more have to name the extra that brings it.
"""

import importlib
import importlib.metadata
import pkgutil
import subprocess
import sys
import tempfile
from pathlib import Path

DM_CONTROL = sys.version_info < (3, 13)  # it needs labmaze, which has no wheel for later ones
# The parts that an environment with one extra lacks something for, and the extra that has it.
OF_MUJOCO = dict.fromkeys(
    ["torchrl_sym.mujoco", "torchrl_sym.bridges.frames", "torchrl_sym.bridges.mjlab"], "mujoco"
)
OF_GPU = {"tasks.warp_fields": "gpu", "tasks.warp_simulation": "gpu"}
LACKS = {
    "core": OF_MUJOCO | {"torchrl_sym.recipes": "train", "tasks": "tasks"},
    "mujoco": {"torchrl_sym.recipes": "train", "tasks.paths": "tasks", "tasks.rendering": "tasks"},
    "tasks": OF_GPU if DM_CONTROL else OF_GPU | {"torchrl_sym.recipes": "train"},  # dm_control brings tqdm
    "train": OF_MUJOCO | {"tasks": "tasks"},
}
ROBOT = """<mujoco><worldbody>
  <geom type="plane" size="5 5 .1"/>
  <body name="base" pos="0 0 .3"><freejoint/><geom type="box" size=".2 .1 .05"/>
    <body pos="0 .1 0"><joint name="left" axis="1 0 0"/><geom type="capsule" size=".02 .1"/></body>
    <body pos="0 -.1 0"><joint name="right" axis="1 0 0"/><geom type="capsule" size=".02 .1"/></body>
  </body>
</worldbody></mujoco>"""


def check(condition: object, message: str) -> None:
    """Like `assert`, also under `python -O`."""
    if not condition:
        raise SystemExit(f"smoke test of the wheel FAILED: {message}")


def check_contents() -> None:
    folder = Path(str(importlib.import_module("torchrl_sym").__file__)).parent
    check("site-packages" in folder.parts, f"torchrl_sym comes from {folder}, not from an environment")
    tasks = folder.parent / "tasks"
    for package in (folder, tasks):
        check((package / "py.typed").is_file(), f"py.typed is missing in {package.name}")
    check(any(tasks.glob("assets/**/*.xml")), "tasks/assets holds no model (*.xml)")

    version = importlib.metadata.version("torchrl_sym")
    ours = importlib.import_module("torchrl_sym").__version__
    check(ours == version, f"torchrl_sym.__version__ is {ours!r}, the metadata say {version!r}")
    files = importlib.metadata.files("torchrl_sym") or []
    top_level = {file.parts[0] for file in files if not file.parts[0].endswith(".dist-info")}
    check(
        top_level == {"torchrl_sym", "tasks"},
        f"the wheel installs {sorted(top_level)}, expected only torchrl_sym and tasks",
    )


def check_parts(extra: str) -> None:
    """Import every module that the extra is for; the parts of other extras name theirs instead."""
    lacks = LACKS[extra]
    for part, other in lacks.items():
        try:
            importlib.import_module(part)
        except ImportError as error:
            hint = f"torchrl_sym[{other}]"
            check(hint in str(error) and "\n" not in str(error), f"{part} does not name {hint}: {error!r}")
        else:
            check(False, f"{part} can be imported with the extra {extra!r} alone")
    impossible = set(lacks) | ({"tasks.suite"} if not DM_CONTROL else set())
    for name in ("torchrl_sym", "tasks")[: 1 + (extra == "tasks")]:
        root = importlib.import_module(name)
        for module in pkgutil.walk_packages(root.__path__, f"{name}.", onerror=lambda name: None):
            within = any(f"{module.name}.".startswith(f"{part}.") for part in impossible)
            if not within and not module.name.endswith(".__main__"):
                importlib.import_module(module.name)


def use_core() -> None:
    """A loss of PPO on a batch of our own."""
    import torch
    from tensordict import TensorDict
    from tensordict.nn import NormalParamExtractor, ProbabilisticTensorDictSequential, TensorDictModule
    from torchrl.modules import MLP, ProbabilisticActor, TanhNormal, ValueOperator

    from torchrl_sym import MirrorLoss, PointGroup, SymmetricClipPPOLoss, Symmetry
    from torchrl_sym.representations import planar
    from torchrl_sym.testing import assert_representation

    group = PointGroup.klein_four()
    assert_representation(planar(group))
    symmetry = Symmetry(group, {"observation": planar(group) * 2, "action": planar(group)})
    network = torch.nn.Sequential(MLP(4, 4), NormalParamExtractor())
    module = TensorDictModule(network, in_keys=["observation"], out_keys=["loc", "scale"])
    actor: ProbabilisticTensorDictSequential = ProbabilisticActor(
        module, in_keys=["loc", "scale"], distribution_class=TanhNormal, return_log_prob=True
    )
    critic = ValueOperator(MLP(4, 1), in_keys=["observation"])
    batch = TensorDict({"observation": torch.randn(3, 5, 4)}, [3, 5], names=[None, "time"])
    batch["next"] = TensorDict(
        {
            "observation": torch.randn(3, 5, 4),
            "reward": torch.randn(3, 5, 1),
            "done": torch.zeros(3, 5, 1, dtype=torch.bool),
            "terminated": torch.zeros(3, 5, 1, dtype=torch.bool),
        },
        [3, 5],
    )
    with torch.no_grad():
        actor(batch)
    loss = SymmetricClipPPOLoss(actor, critic, symmetry=symmetry)
    loss.make_value_estimator(gamma=0.98, lmbda=0.95)
    losses = [loss(batch)["loss_objective"], MirrorLoss(actor, symmetry=symmetry)(batch)["loss_mirror"]]
    check(all(torch.isfinite(x) for x in losses), f"losses are not finite: {losses}")


def use_mujoco() -> None:
    """A robot's joints, and how symmetric it is."""
    import mujoco

    from torchrl_sym import PointGroup
    from torchrl_sym.mujoco import audit, derive

    model = mujoco.MjModel.from_xml_string(ROBOT)
    table = derive(model, PointGroup.reflection("y")).table("joint", "reflect-y")
    check(table["left"] == "-right", f"the image of left is {table['left']}, not -right")
    report = audit(model, PointGroup.reflection("y"))
    check(report.exact, f"the robot is not exactly symmetric: {report}")


def use_tasks() -> None:
    """A rollout of each of the two faces of a task."""
    import torch

    import tasks

    env = tasks.make_env("cartpole", num_envs=2)
    rollout = env.rollout(3)
    check(rollout.shape == (2, 3), f"3 steps of 2 environments have shape {tuple(rollout.shape)}")
    reward = rollout["next", "reward"]
    check(torch.isfinite(reward).all(), f"rewards are not finite: {reward}")
    env.close()
    if DM_CONTROL:
        check(tasks.load("cartpole").reset().first(), "tasks.load gives no first time step")


def use_train() -> None:
    """The networks of a run."""
    from torchrl_sym.recipes import PPOConfig, make_actor, make_critic

    config = PPOConfig()
    for network in (make_actor(config, ["observation"], 3, 1), make_critic(config, ["observation"], 3)):
        check(list(network.parameters()), f"{network} has no parameters")


def use_command() -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "robot.xml"
        path.write_text(ROBOT)
        command = [sys.executable, "-I", "-m", "torchrl_sym.mujoco", str(path)]
        ran = subprocess.run(command, capture_output=True, text=True)
    check(ran.returncode == 0 and "-right" in ran.stdout, f"the command failed: {ran.stdout}{ran.stderr}")


USE = {"core": use_core, "mujoco": use_mujoco, "tasks": use_tasks, "train": use_train}

if __name__ == "__main__":
    (chosen,) = sys.argv[1:]
    check_contents()
    check_parts(chosen)
    USE[chosen]()
    if chosen == "mujoco":
        use_command()
    print(f"smoke test of the wheel, {chosen}: passed")
