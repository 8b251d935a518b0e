"""Pictures and films of states, without a display: record a rollout, render it, put goals side by side.

A task is evaluated on equivalent goals, and symmetry is easiest to judge by eye: start every goal from
the mirrored state and watch them next to each other. Paths from above: `tasks.paths`.

MuJoCo chooses its OpenGL when it is imported: on a machine without a display, set the environment
variable ``MUJOCO_GL`` to ``egl`` (or ``osmesa``) before Python starts, as examples/watch.py does.
"""

from __future__ import annotations

import copy
import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from torchrl_sym.extras import require

require("tasks.rendering", "tasks", {"PIL": ""})

import mujoco
import numpy as np
import torch
from PIL import Image, ImageDraw, ImageFont
from tensordict import TensorDictBase
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from tasks.base import Task
from tasks.environment import BatchedEnv
from tasks.processes import refuse_forked_rendering
from tasks.state import State
from torchrl_sym import checks

mj: Any = mujoco  # its compiled modules have no type stubs


def record(
    env: BatchedEnv,
    policy: Callable[[TensorDictBase], TensorDictBase],
    start: State,
    *,
    steps: int | None = None,
    exploration: ExplorationType = ExplorationType.DETERMINISTIC,  # pyright: ignore[reportArgumentType]
) -> list[State]:
    """All states of a rollout from given starts.

    Nothing is reset: a robot that has fallen stays on the ground while the other rows go on.

    Args:
        env: as many simulations as ``start`` has rows.
        policy: writes ``"action"`` from ``"observation"``. Runs without gradients.
        start: first state of every row.
        steps: control steps; None for one episode.
        exploration: ``ExplorationType.RANDOM`` samples the actions, from torch's global generator.

    Returns:
        ``steps + 1`` states, ``start`` first.

    Raises:
        TypeError: an argument of another type.
        ValueError: a start of another number of rows, or steps that are none.

    Example:
        >>> import tasks, torch
        >>> env = tasks.make_env("cartpole", num_envs=2, num_threads=1)
        >>> start = env.task.sample_goal_state(2, torch.Generator().manual_seed(0))
        >>> len(record(env, env.rand_action, start, steps=5))
        6
    """
    checks.instance("env", env, BatchedEnv, "tasks.make_env makes one")
    checks.function("policy", policy)
    count = env.task.max_steps if steps is None else checks.whole("steps", steps, 0)
    tensordict: TensorDictBase = env.reset_to(checks.instance("start", start, State))
    states = [env.state]
    with torch.no_grad(), set_exploration_type(exploration):
        for _ in range(count):
            tensordict = step_mdp(env.step(policy(tensordict)))
            states.append(env.state)
    return states


def render(
    task: Task,
    states: Sequence[State],
    *,
    camera: str | None = None,
    width: int = 320,
    height: int = 240,
) -> list[np.ndarray]:
    """Images of states, headless.

    Args:
        task: whose model is drawn.
        states: n rows each, such as :func:`record` returns.
        camera: its name; None for ``"overview"``, or the model's first camera, or a free one.
        width: of one image, pixels; at most ``offwidth`` of the model.
        height: of one image, pixels; at most ``offheight`` of the model.

    Returns:
        For each state ``(n, height, width, 3)`` uint8.

    Raises:
        RuntimeError: no OpenGL, or a forked child of a process that has rendered.
        KeyError: no such camera.
        ValueError: larger than the model's frame buffer, or states of another task.
        TypeError: an argument of another type.

    Example:
        >>> from tasks.base import create
        >>> task = create("cartpole")
        >>> start = task.sample_goal_state(2, None)
        >>> render(task, [start], width=64, height=48)[0].shape
        (2, 48, 64, 3)
    """
    model = copy.copy(checks.instance("task", task, Task).model)
    states = states_of(task, states)
    width = checks.whole("width (within the model's framebuffer)", width, 1, model.vis.global_.offwidth)
    height = checks.whole("height (within the model's framebuffer)", height, 1, model.vis.global_.offheight)
    model.vis.map.shadowclip = 1.5  # see _aim_lights
    names = [model.camera(i).name for i in range(model.ncam)]
    if camera is None:
        camera = "overview" if "overview" in names or not names else names[0]
    else:
        checks.one_of("camera", camera, names, KeyError)
    data = mj.MjData(model)
    renderer = _renderer(model, height, width)
    try:
        images = []
        for state in states:
            rows = np.empty((len(state), height, width, 3), dtype=np.uint8)
            for row in range(len(state)):
                _pose(model, data, state, row)
                renderer.update_scene(data, camera if names else -1)
                _aim_lights(model, renderer.scene)
                rows[row] = renderer.render()
            images.append(rows)
    finally:
        renderer.close()
    return images


def states_of(task: Task, states: Sequence[State]) -> list[State]:
    """The states; ValueError unless all are of this task."""
    found = [checks.instance("states", s, State) for s in checks.sequence("states", states, "states")]
    size = task.model.nq
    if any(state.qpos.shape[1] != size for state in found):
        raise ValueError(f"states: expected those of {task.name!r}, with positions (n, {size}), got others")
    return found


def _renderer(model: Any, height: int, width: int) -> Any:
    refuse_forked_rendering()
    try:
        return mj.Renderer(model, height, width)
    except ValueError:
        raise
    except Exception as error:  # every OpenGL backend has exceptions of its own
        raise RuntimeError(
            f"expected OpenGL for off-screen rendering, got {type(error).__name__} with MUJOCO_GL="
            f"{os.environ.get('MUJOCO_GL', '')!r}; set MUJOCO_GL=egl (or osmesa) before Python starts"
        ) from error


def _pose(model: Any, data: Any, state: State, row: int) -> None:
    mj.mj_resetData(model, data)  # mocap bodies that the state leaves out are where the model has them
    data.qpos[:], data.qvel[:] = state.qpos[row].numpy(), state.qvel[row].numpy()
    if state.mocap_pos is not None:
        data.mocap_pos[:] = state.mocap_pos[row].numpy()
    if state.mocap_quat is not None:
        data.mocap_quat[:] = state.mocap_quat[row].numpy()
    data.time = float(state.time[row])
    mj.mj_forward(model, data)


def _aim_lights(model: Any, scene: Any) -> None:
    """Move directional lights so that they shine through the middle of the scene.

    Their shadows cover only what is around that line; what is at the border is drawn speckled.
    """
    for light in scene.lights[: scene.nlight]:
        if light.type == mj.mjtLightType.mjLIGHT_DIRECTIONAL and not light.headlight:
            light.pos = model.stat.center - 2 * model.stat.extent * np.asarray(light.dir)


def sheet(rows: Sequence[Sequence[np.ndarray]], captions: Sequence[Sequence[str]]) -> np.ndarray:
    """Images of one size in rows and columns, each with its caption in the upper left corner.

    Args:
        rows: ``(height, width, 3)`` uint8 each; rows may have different lengths.
        captions: one for each image.

    Returns:
        One image, uint8; places without an image are white.

    Raises:
        ValueError: no images, of two sizes, or not a caption for each.
        TypeError: something other than images and captions.

    Example:
        >>> import numpy as np
        >>> image = np.zeros((20, 30, 3), dtype=np.uint8)
        >>> sheet([[image, image], [image]], [["right", "left"], [""]]).shape
        (40, 60, 3)
    """
    rows = [_images("rows", row) for row in checks.sequence("rows", rows, "rows of images")]
    captions = [checks.sequence("captions", row) for row in checks.sequence("captions", captions, "rows")]
    if not rows or len({image.shape for row in rows for image in row}) != 1:
        raise ValueError("rows: expected images of one size, at least one row")
    if [len(row) for row in rows] != [len(row) for row in captions]:
        raise ValueError("captions: expected one per image")
    height, width = rows[0][0].shape[:2]
    picture = Image.new("RGB", (width * max(map(len, rows)), height * len(rows)), "white")
    draw = ImageDraw.Draw(picture)
    font = ImageFont.load_default(max(10, height // 15))
    for i, (images, texts) in enumerate(zip(rows, captions, strict=True)):
        for j, (image, text) in enumerate(zip(images, texts, strict=True)):
            corner = (j * width, i * height)
            picture.paste(Image.fromarray(image), corner)
            place = (corner[0] + height // 30, corner[1] + height // 40)
            text = checks.instance("captions", text, str)
            draw.text(place, text, fill="#202020", font=font, stroke_width=2, stroke_fill="white")
    return np.asarray(picture)


def _images(name: str, images: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Images of one size; TypeError or ValueError otherwise."""
    found = checks.sequence(name, images, of="images")
    for image in found:
        checks.instance(name, image, np.ndarray)
        if image.ndim != 3 or image.shape[2] != 3 or image.dtype != np.uint8:
            raise ValueError(f"{name}: expected uint8 (height, width, 3), got {checks.shown(image)}")
    if len({image.shape for image in found}) != 1:
        raise ValueError(f"{name}: expected images of one size, at least one, got {len(found)}")
    return found


def save(path: str | os.PathLike, frames: Sequence[np.ndarray], fps: float = 25.0) -> None:
    """Write a picture or a film; the suffix decides.

    Args:
        path: ``.png`` (one frame), ``.gif``, or ``.mp4`` (``pip install imageio imageio-ffmpeg``).
        frames: ``(height, width, 3)`` uint8 each.
        fps: frames per second.

    Raises:
        ValueError: another suffix, no frames or not one for a png, or no frames per second.
        TypeError: something other than frames.
        ImportError: mp4 without imageio-ffmpeg.

    Example:
        >>> import numpy as np, tempfile
        >>> image = np.zeros((20, 30, 3), dtype=np.uint8)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save(f"{folder}/film.gif", [image, image])
    """
    path = Path(checks.instance("path", path, (str, os.PathLike)))
    if path.suffix not in (".png", ".gif", ".mp4"):
        raise ValueError(f"expected a file name that ends in .png, .gif or .mp4, got {path.name!r}")
    frames, fps = _images("frames", frames), checks.real("fps", fps, above=0.0)
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".png":
        if len(frames) != 1:
            raise ValueError(
                f"expected one frame for a png, got {len(frames)}; write a gif, or use sheet()"
            )
        # A palette of 256 colours is a third of the size, and simple scenes look the same.
        Image.fromarray(frames[0]).quantize(256).save(path, optimize=True)
    elif path.suffix == ".gif":
        images = [Image.fromarray(frame).quantize(128) for frame in frames]
        images[0].save(path, save_all=True, append_images=images[1:], duration=1000 / fps, loop=0)
    else:
        _save_mp4(path, frames, fps)


def _save_mp4(path: Path, frames: Sequence[np.ndarray], fps: float) -> None:
    require(f"writing {path.name}", "video", {"imageio": "", "imageio_ffmpeg": ""}, "or write a .gif")
    import imageio

    even = [frame[: len(frame) // 2 * 2, : frame.shape[1] // 2 * 2] for frame in frames]  # h264 wants it
    imageio.mimwrite(path, even, fps=fps, macro_block_size=2)  # type: ignore[arg-type]
