"""Paths of everything that moves freely, from above: as they were, and mapped back onto one goal.

Where all goals start from the images of one state, a symmetric policy leaves a single path once they are
mapped back. No OpenGL is needed.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torchrl_sym.extras import require

require("tasks.paths", "tasks", {"matplotlib": ""})

import mujoco
import numpy as np
import torch
from matplotlib.figure import Figure

from tasks.base import Task
from tasks.rendering import states_of
from tasks.state import State
from torchrl_sym import checks

mj: Any = mujoco  # its compiled modules have no type stubs
COLORS = ("tab:blue", "tab:orange", "tab:green", "tab:red", "tab:purple", "tab:brown")


def overlay(task: Task, states: Sequence[State], elements: Sequence[int]) -> Figure:
    """Paths of everything that moves freely, from above: as they were, and mapped back onto one goal.

    On the right, the path of goal g is mapped by the inverse of g. Started from the images of one state,
    a symmetric policy leaves a single path there; a policy that turns its robot round first, or prefers
    some of its limbs, does not.

    Args:
        task: the task.
        states: a rollout of one row per goal, such as :func:`~tasks.rendering.record` returns.
        elements: group element of each row.

    Returns:
        The figure; arrows show headings, squares targets.

    Raises:
        ValueError: nothing in the model has a free joint, no states, or not an element for every row.
        KeyError: no such element.

    Example:
        >>> from tasks.base import create
        >>> task = create("anymal_push")
        >>> states = [task.transform_state(task.sample_goal_state(1, None), 1)] * 2
        >>> len(overlay(task, states, [1]).axes)
        2
    """
    figure = Figure(figsize=(10, 5), layout="constrained")
    panels = figure.subplots(1, 2)
    for axes, mapped in zip(panels, (False, True), strict=True):
        draw_paths(axes, task, states, elements, mapped_back=mapped)
        axes.set_title(f"mapped back onto {task.goal_names[0]}" if mapped else "as run")
    panels[0].set_ylabel("y [m]")
    figure.legend(
        *panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, frameon=False
    )
    return figure


def draw_paths(
    axes: Any,
    task: Task,
    states: Sequence[State],
    elements: Sequence[int],
    *,
    mapped_back: bool = False,
    headings: bool = True,
) -> None:
    """Paths of everything that moves freely, from above, in one panel; see :func:`overlay`.

    Args:
        axes: matplotlib's, to draw in.
        task: the task.
        states: a rollout, such as :func:`~tasks.rendering.record` returns.
        elements: group element of each of its rows; several rows may have the same.
        mapped_back: draw the path of goal g mapped by the inverse of g.
        headings: an arrow every half second.

    Raises:
        ValueError: as in :func:`overlay`.
        KeyError: no such element.
    """
    states = states_of(checks.instance("task", task, Task), states)
    model, group = task.model, task.symmetry.group
    elements = [group.index(g) for g in checks.sequence("elements", elements, "elements")]
    if {len(state) for state in states} != {len(elements)}:
        raise ValueError(f"elements: expected one per row of the states, got {len(elements)}")
    free = [j for j in range(model.njnt) if model.jnt_type[j] == mj.mjtJoint.mjJNT_FREE]
    if not free:
        raise ValueError(
            f"expected a task in which something moves freely, got {task.name!r}, whose joints are all "
            "attached; watch it as a film instead"
        )
    if mapped_back:
        back = group.inverse[torch.as_tensor(elements)]
        states = [task.transform_state(state, back) for state in states]
    for number, joint in enumerate(free):
        at, body = model.jnt_qposadr[joint], model.body(model.jnt_bodyid[joint]).name
        path = torch.stack([state.qpos[:, at : at + 7] for state in states]).numpy()
        labels = [f"{task.goal_names[g]}, {body}" for g in elements]
        stride = max(1, round(0.5 / task.control_timestep)) if headings else None
        _draw_bodies(axes, path, elements, labels, style=("-", "--", ":")[number % 3], stride=stride)
    last = states[-1].mocap_pos
    if last is not None:
        for row, g in enumerate(elements):
            axes.plot(*last[row, :, :2].numpy().T, "s", color=_color(g), markersize=9, alpha=0.4)
    # The group acts about the origin: a square around it is the same picture for all elements.
    reach = 1.05 * float(np.abs(axes.dataLim.get_points()).max())
    axes.set(xlabel="x [m]", aspect="equal", xlim=(-reach, reach), ylim=(-reach, reach))
    axes.locator_params(nbins=5)
    axes.grid(alpha=0.3)


def _draw_bodies(
    axes: Any,
    path: np.ndarray,
    elements: Sequence[int],
    labels: Sequence[str],
    style: str,
    stride: int | None,
) -> None:
    """Paths ``(steps, rows, 7)`` of one free body, with an arrow for its heading every ``stride`` steps."""
    for row, g in enumerate(elements):
        x, y = path[:, row, 0], path[:, row, 1]
        label = labels[row] if labels[row] not in labels[:row] else None
        axes.plot(x, y, style, color=_color(g), label=label)
        axes.plot(x[0], y[0], "o", color=_color(g), markersize=4)
        if stride is None:
            continue
        w, qx, qy, qz = path[::stride, row, 3:7].T
        ahead = 1 - 2 * (qy**2 + qz**2), 2 * (qx * qy + w * qz)
        axes.quiver(x[::stride], y[::stride], *ahead, color=_color(g), width=0.004, scale=18, alpha=0.7)


def _color(g: int) -> str:
    return COLORS[g % len(COLORS)]
