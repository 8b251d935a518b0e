"""Imports the packages before pytest collects their doctests.

In its import mode "importlib", pytest executes a module that nobody has imported yet and sets it as an
attribute of its package: of `torchrl_sym.mujoco`, where `derive` is a function, the module of that name.
"""

import contextlib
import importlib

for package in ("torchrl_sym", "torchrl_sym.mujoco", "tasks"):
    with contextlib.suppress(ImportError):  # the core is tested without the others
        importlib.import_module(package)
