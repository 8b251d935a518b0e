"""Writes docs/tasks.md from the code: what every task is, its rewards, arguments and observation.

    python benchmarks/tasks_page.py              the page
    python benchmarks/tasks_page.py --pictures   and the pictures, the start states of all goals

Nothing is typed twice: prose comes from docstrings, formulas from the source of `reward_terms`, weights
from the constants of the task's file, the observation from `Task.layout()`.
"""

import ast
import inspect
import os
import re
import sys
import textwrap
from dataclasses import dataclass
from pathlib import Path

if sys.platform == "linux" and not os.environ.get("DISPLAY"):
    os.environ.setdefault("MUJOCO_GL", "egl")  # read when mujoco is imported

import torch
import tyro

import tasks
from comparison.files import write_whole
from tasks.base import Task, create

DOCS = Path(__file__).parents[1] / "docs"
HEADER = """# Tasks

Made from the code by `python benchmarks/tasks_page.py`; with `--pictures` it also draws the start states
of all goals. (`python examples/watch.py TASK --checkpoint FOLDER --out TASK.png` draws key frames of a
policy.) Build a task by `tasks.make_env(name, num_envs=..., **arguments)`, or as a dm_control environment
by `tasks.load(name, **arguments)`; scripts take `--task-kwargs NAME VALUE ...`.

Every task has one goal per element of its symmetry group. The canonical goal is the first; the start of
every other is its image, so that all are equally hard. *Observation*: the column *transforms* says how the
group acts on a block; `env.symmetry` is that table as tensors. *Reward*: formulas are the code's own, with
`state` after the step and `state.variables` from before it; the return is the sum over the steps of an
episode. Terms whose part is *task* say how well the task is done, the others how. Constants in capitals are
explained where they are defined, at the top of the task's file.
"""


@dataclass
class Arguments:
    """Write the page about all tasks."""

    out: Path = DOCS / "tasks.md"
    """Where the page goes; pictures lie beside it."""
    pictures: bool = False
    """Draw the pictures too."""


def prose(docstring: str | None) -> str:
    """The text of a docstring before its sections, with roles and double backquotes as Markdown."""
    text = inspect.cleandoc(docstring or "")
    text = re.split(r"\n(?:Args|Returns|Raises|Example|Attributes):\n", text)[0].strip()
    return markdown(text)


def markdown(text: str) -> str:
    text = re.sub(r":\w+:`~?(?:[\w.]*\.)?(\w+)`", r"`\1`", text)
    return text.replace("``", "`")


def sentence(method) -> str:
    """What a method does, on one line."""
    return " ".join(prose(method.__doc__).split())


def table(head: list[str], rows: list[list[str]]) -> str:
    escaped = [[cell.replace("|", "\\|") for cell in row] for row in rows]
    return "\n".join(f"| {' | '.join(row)} |" for row in [head, ["---"] * len(head), *escaped])


def count(number: int, noun: str) -> str:
    return f"{number} {noun}{'s' * (number != 1)}"


def overridden(task: Task, name: str) -> bool:
    return getattr(type(task), name) is not getattr(Task, name)


def observation(task: Task) -> str:
    rows, first = [], 0
    for entry in task.layout():
        end = first + entry.representation.dim
        rows.append(
            [
                f"{first}:{end}",
                entry.name,
                entry.unit,
                entry.frame,
                f"{entry.scale / entry.divisor:.4g}",
                entry.kind,
            ]
        )
        first = end
    return table(["slice", "what", "unit", "frame", "scale", "transforms"], rows)


def weights(task: Task) -> dict[str, float]:
    """All constants of the task's file that are called WEIGHTS, or ..._WEIGHTS, together."""
    constants = vars(sys.modules[type(task).__module__])
    return {
        term: weight
        for name, value in constants.items()
        if name.endswith("WEIGHTS") and isinstance(value, dict)
        for term, weight in value.items()
    }


@dataclass
class Source:
    """What the source of `reward_terms` says.

    Attributes:
        terms: formula of every term.
        definitions: the local variables that the formulas use, as code.
        rule: how weights enter, if all of them do so in one expression.
    """

    terms: dict[str, str]
    definitions: list[str]
    rule: str | None = None


def read_source(cls: type, method: str = "reward_terms") -> Source:
    """Read a method that builds a dictionary of terms, and those that it takes terms from by ``**``."""
    source = Source({}, [])
    for node in ast.walk(ast.parse(textwrap.dedent(inspect.getsource(getattr(cls, method))))):
        pairs: list[tuple] = []
        if isinstance(node, ast.Dict):
            pairs = list(zip(node.keys, node.values, strict=True))
        elif isinstance(node, ast.DictComp):
            source.rule = ast.unparse(node.value)
        elif isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Subscript):
            pairs = [(node.targets[0].slice, node.value)]
        elif isinstance(node, ast.Assign) and not isinstance(node.value, ast.Dict | ast.DictComp):
            source.definitions.append(ast.unparse(node))
        for key, value in pairs:
            if isinstance(key, ast.Constant):
                source.terms[str(key.value)] = ast.unparse(value)
            elif key is None and isinstance(value, ast.Call) and isinstance(value.func, ast.Attribute):
                other = read_source(cls, value.func.attr)
                source.terms |= other.terms
                source.definitions += [f"# {value.func.attr}", *other.definitions]
    return source


def reward(task: Task) -> str:
    start = task.sample_goal_state(1, torch.Generator().manual_seed(0))
    names = task.reward_terms(start, torch.zeros(1, task.action_size))
    source, factors = read_source(type(task)), weights(task)
    rows = [
        [
            name,
            "task" if name in task.task_terms else "",
            f"{factors[name]:g}" if name in factors else "",
            f"`{source.terms.get(name, '')}`",
        ]
        for name in names
    ]
    text = sentence(type(task).reward_terms)
    if source.rule and factors:
        text += f" A term with a weight enters as `{source.rule}`, the others as they are."
    text += f"\n\n{table(['term', 'part', 'weight', 'formula'], rows)}"
    used = [line for line in source.definitions if not line.startswith(("weights =", "terms ="))]
    return text + ("\n\n```python\n" + "\n".join(used) + "\n```" if used else "")


def arguments(task: Task) -> str:
    """Keyword arguments with defaults and meaning, those handed on to base classes included."""
    rows: dict[str, list[str]] = {}
    for ancestor in type(task).__mro__:
        if "__init__" not in vars(ancestor):
            continue
        parameters = inspect.signature(ancestor).parameters.values()
        meaning = documented(ancestor)
        for p in parameters:
            if p.kind is not p.VAR_KEYWORD:
                rows.setdefault(p.name, [f"`{p.name}`", f"`{p.default!r}`", meaning.get(p.name, "")])
        if all(p.kind is not p.VAR_KEYWORD for p in parameters):
            break
    return table(["argument", "default", "meaning"], list(rows.values()))


def documented(cls: type) -> dict[str, str]:
    """The Args section of a class."""
    section = re.search(
        r"^Args:\n(.*?)(?=^\S|\Z)", inspect.cleandoc(cls.__doc__ or ""), re.DOTALL | re.MULTILINE
    )
    found = re.findall(
        r"^    (\w+): (.*?)(?=^    \S|\Z)", section[1] if section else "", re.DOTALL | re.MULTILINE
    )
    return {name: markdown(" ".join(text.split())) for name, text in found}


def describe(task: Task) -> str:
    cls, group = type(task), task.symmetry.group
    file = cls.__module__.replace(".", "/") + ".py"
    title, _, rest = prose(sys.modules[cls.__module__].__doc__).partition("\n\n")
    name, _, what = " ".join(title.split()).partition(": ")
    ends = sentence(cls.terminated) if overridden(task, "terminated") else "Never before the time is over."
    goals = ", ".join(f"{g}: *{goal}*" for g, goal in zip(group.names, task.goal_names, strict=True))
    facts = [
        f"**Group and goals.** {goals}.",
        f"**Episode.** {task.episode_seconds:g} s, {task.max_steps} control steps of "
        f"{task.control_timestep:g} s in {count(task.substeps, 'step')} of physics each.",
        f"**Action.** {count(task.action_size, 'number')} in [-1, 1]. {sentence(cls.control)}",
        f"**Start of the canonical goal.** {sentence(cls.sample_goal_state)}",
        f"**Termination.** {ends}",
    ]
    if overridden(task, "success"):
        facts.append(f"**Success.** {sentence(cls.success)}")
    if overridden(task, "sample_initial_state"):
        facts.append(f"**Training starts.** {sentence(cls.sample_initial_state)}")
    if overridden(task, "restart"):
        facts.append(f"**Between episodes.** {sentence(cls.restart)}")
    if overridden(task, "randomize"):
        facts.append(f"**Randomisation.** {sentence(cls.randomize)}")
    parts = [
        f"## {name}",
        f"`{task.name}`, in [{file}](../{file})",
        f"![Start states of all goals](tasks_{task.name}.png)",
        f"{what[:1].upper()}{what[1:]}",
        rest.split("\n\n")[0],
        prose(cls.__doc__),
        *facts,
        f"**Reward.** {reward(task)}",
        f"**Observation.** {count(task.observation_size, 'number')}.\n\n{observation(task)}",
        f"**Arguments.**\n\n{arguments(task)}",
    ]
    return "\n\n".join(part for part in parts if part)


def draw(task: Task, path: Path) -> None:
    """The start states of all goals, paired."""
    from tasks.rendering import render, save, sheet

    start = task.sample_goal_state(1, torch.Generator().manual_seed(0))
    states = [task.transform_state(start, g) for g in range(task.symmetry.group.order)]
    images = [rows[0] for rows in render(task, states, width=400, height=300)]
    columns = 2 if len(images) == 4 else len(images)
    split = [slice(i, i + columns) for i in range(0, len(images), columns)]
    save(path, [sheet([images[part] for part in split], [task.goal_names[part] for part in split])])


def main(settings: Arguments) -> None:
    described = [create(name) for name in tasks.ALL_TASKS]
    write_whole(settings.out, "\n\n".join([HEADER.strip(), *map(describe, described)]) + "\n")
    for task in described if settings.pictures else ():
        draw(task, settings.out.with_name(f"tasks_{task.name}.png"))
    print(f"{len(described)} tasks: {settings.out}")


if __name__ == "__main__":
    main(tyro.cli(Arguments))
