"""Off-screen rendering, and the packages, before pytest collects anything.

In its import mode "importlib", pytest executes a module that nobody has imported yet and sets it as an
attribute of its package: of `torchrl_sym.mujoco`, where `derive` is a function, the module of that name.
"""

import contextlib
import ctypes.util
import importlib
import importlib.util
import os
import sys

# MuJoCo and dm_control read MUJOCO_GL when they are imported, and dm_control refuses a value that cannot
# work, so EGL is only asked for where it exists.
if sys.platform == "linux" and ctypes.util.find_library("EGL"):
    os.environ.setdefault("MUJOCO_GL", "egl")

# The second engine belongs to the extra "gpu". Its kernels run for moments here, and compile for long.
if importlib.util.find_spec("mujoco_warp") is None:
    collect_ignore = ["tasks/warp_fields.py", "tasks/warp_simulation.py", "tests/warp_models.py"]
with contextlib.suppress(ImportError):
    warp = importlib.import_module("warp")
    warp.config.optimization_level, warp.config.enable_backward = 0, False

for package in ("torchrl_sym", "torchrl_sym.mujoco", "tasks"):
    with contextlib.suppress(ImportError):  # the core is tested without the others
        importlib.import_module(package)
