"""What a task's name stands for: a task of ours, one of somebody else, either with arguments of its own.

`cartpole` is a task of `tasks`, `module:function` calls a function of one's own. `cartpole@motor_bias=0.5`
is a *variant*: the task with these arguments, in training and in evaluation. Its settings are those of the
task without them.
"""

import ast
import functools
import importlib
import sys
from collections.abc import Callable
from typing import Any

from torchrl.envs import EnvBase

import tasks
from tasks.settings import SETTINGS, Setting
from torchrl_sym.recipes import PPOConfig


def environment(task: str, threads: int = 1) -> Callable[..., EnvBase]:
    """What makes a task's environments: called with `num_envs`, `seed` and the task's own arguments.

    A module is looked for where Python finds others, then where the command was given. It is imported: let
    no name in that was read from a file of somebody else.

    Raises:
        ValueError: neither a task's name nor an importable `module:function`, or arguments of another form.
    """
    name, own = variant(task)
    if own:
        return functools.partial(environment(name, threads), **own)
    if task in tasks.ALL_TASKS:
        return functools.partial(tasks.make_env, task, num_threads=threads)
    module, _, name = task.partition(":")
    if "" not in sys.path:
        sys.path.append("")  # last: no file there takes the place of a library or of the benchmarks
    try:
        make_env = getattr(importlib.import_module(module), name)
        if not callable(make_env):
            raise ValueError(f"{name} is a {type(make_env).__name__}")
    except (ImportError, AttributeError, TypeError, ValueError) as error:
        raise ValueError(
            f"expected a task of {list(tasks.ALL_TASKS)}, or module:function that takes num_envs and seed "
            f"and returns an environment with a symmetry, got {task!r} ({error})"
        ) from error
    return make_env


def task_setting(task: str) -> Setting:
    """Settings of a task; of another one, what its module calls SETTING, or the recipe's defaults.

    Raises:
        ValueError: no such task, a SETTING that is none, or arguments that it does not take.
    """
    name, own = variant(task)
    if own:
        check_arguments(name, own)
        return task_setting(name)
    if task in SETTINGS:
        return SETTINGS[task]
    environment(task)
    module = importlib.import_module(task.partition(":")[0])
    setting = getattr(module, "SETTING", Setting(PPOConfig()))
    if not isinstance(setting, Setting):
        raise ValueError(
            f"expected SETTING of {module.__name__} ({module.__file__}) to be a tasks.settings.Setting, "
            f"got {type(setting).__name__}; wrap the configuration: Setting(PPOConfig(...))"
        )
    return setting


def variant(task: str) -> tuple[str, dict[str, Any]]:
    """A task's name and the arguments that come with it, none for the task as it is.

    Raises:
        ValueError: arguments of another form.

    Example:
        >>> variant("cartpole@motor_bias=0.5,wind=1.0")
        ('cartpole', {'motor_bias': 0.5, 'wind': 1.0})
    """
    name, mark, text = task.partition("@")
    return name, task_arguments(text) if mark else {}


def task_arguments(text: str) -> dict[str, Any]:
    """Arguments of a task as one would call it with, `KEY=VALUE` joined by commas; a word is text.

    Raises:
        ValueError: not of this form.

    Example:
        >>> task_arguments("payload=5.0,payload_position=(0.2,0.1,0.1),weak_leg=LF")
        {'payload': 5.0, 'payload_position': (0.2, 0.1, 0.1), 'weak_leg': 'LF'}
    """
    try:
        call = ast.parse(f"dict({text})", mode="eval").body
        if not isinstance(call, ast.Call) or call.args or not call.keywords:
            raise ValueError("no keyword arguments alone")
        found = {str(keyword.arg): _value(keyword.value) for keyword in call.keywords}
        if len(found) < len(call.keywords):
            raise ValueError("one of them twice")
        return found
    except (SyntaxError, ValueError) as error:
        raise ValueError(
            f"expected arguments of a task such as motor_bias=0.5,wind=1.0, got {text!r} ({error})"
        ) from error


def _value(node: ast.expr) -> Any:
    return node.id if isinstance(node, ast.Name) else ast.literal_eval(node)


def check_arguments(task: str, arguments: dict[str, Any]) -> None:
    """Refuse arguments that a task does not take, before hours of other runs.

    Raises:
        ValueError: says what the task says.
    """
    try:
        environment(task)(num_envs=1, seed=0, **arguments)
    except (TypeError, ValueError) as error:
        raise ValueError(f"expected arguments of {task}, got {arguments}: {error}") from error
