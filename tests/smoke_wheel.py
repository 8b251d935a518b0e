"""Smoke test of an installed wheel; `make build` runs it in a clean environment elsewhere.

It needs nothing but the wheel and its run-time dependencies (no pytest), and fails loudly.
"""

import importlib.metadata
import sys
from pathlib import Path


def check(condition: object, message: str) -> None:
    """Like `assert`, also under `python -O`."""
    if not condition:
        raise SystemExit(f"smoke test of the wheel FAILED: {message}")


def check_contents() -> None:
    import tasks
    import torchrl_sym

    for package in (torchrl_sym, tasks):
        folder = Path(str(package.__file__)).parent
        check(
            folder.is_relative_to(sys.prefix),
            f"{package.__name__} comes from {folder}, not from the environment {sys.prefix}",
        )
        check((folder / "py.typed").is_file(), f"py.typed is missing in {package.__name__}")
    assets = Path(str(tasks.__file__)).parent / "assets"
    check(any(assets.glob("**/*.xml")), "tasks/assets holds no model (*.xml)")

    version = importlib.metadata.version("torchrl_sym")
    check(
        torchrl_sym.__version__ == version,
        f"torchrl_sym.__version__ is {torchrl_sym.__version__!r}, the metadata say {version!r}",
    )
    files = importlib.metadata.files("torchrl_sym") or []
    top_level = {file.parts[0] for file in files if not file.parts[0].endswith(".dist-info")}
    check(
        top_level == {"torchrl_sym", "tasks"},
        f"the wheel installs {sorted(top_level)}, expected only torchrl_sym and tasks",
    )


def check_behaviour() -> None:
    import torch

    from tasks import make_env
    from torchrl_sym import SymmetricClipPPOLoss

    check(isinstance(SymmetricClipPPOLoss, type), "SymmetricClipPPOLoss is not a class")
    env = make_env("cartpole", num_envs=2)
    rollout = env.rollout(3)
    check(rollout.shape == (2, 3), f"3 steps of 2 environments have shape {tuple(rollout.shape)}")
    reward = rollout["next", "reward"]
    check(torch.isfinite(reward).all(), f"rewards are not finite: {reward}")
    env.close()


if __name__ == "__main__":
    check_contents()
    check_behaviour()
    print("smoke test of the wheel passed:", sys.prefix)
