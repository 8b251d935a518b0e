"""Pictures of states: mirror images, recording, captions, files, paths from above."""

import os
import sys

import imageio_ffmpeg
import numpy as np
import pytest
import torch
from PIL import Image

from tasks import base, rendering
from tasks.environment import BatchedEnv
from tasks.paths import overlay
from tasks.rendering import record, render, save, sheet
from tests.task_helpers import all_tasks, make

IMAGE = np.full((24, 32, 3), 128, dtype=np.uint8)


def starts(task, n=1):
    return task.sample_goal_state(n, torch.Generator().manual_seed(0))


@all_tasks
def test_every_task_can_be_seen(name):
    task = base.create(name)
    canonical = starts(task)
    states = [canonical, task.transform_state(canonical, 1)]
    first, image = (rows[0] for rows in render(task, states, width=64, height=48))
    assert first.shape == (48, 64, 3) and first.dtype == np.uint8
    assert first.std() > 5
    assert (first != image).mean() > 0.005


def test_the_mirrored_cartpole_looks_mirrored():
    task = base.create("cartpole")
    state = starts(task)
    state.qpos[0] = torch.tensor([0.0, 1.0])
    ((image,), (mirrored,)) = render(task, [state, task.transform_state(state, 1)])
    orange = [np.argwhere(x[..., 0].astype(int) - x[..., 2] > 80).mean(axis=0) for x in (image, mirrored)]
    assert orange[0][1] > 170  # the pole is right of the middle
    assert orange[1] == pytest.approx([orange[0][0], 319 - orange[0][1]], abs=1.0)


def test_rendering_leaves_the_model_alone_and_follows_mocap_bodies():
    task = base.create("anymal_push")
    clip, state = task.model.vis.map.shadowclip, starts(task)
    moved = state.clone()
    moved.mocap_pos[:, 0, 0] += 1.0
    near, far = render(task, [state, moved], camera="overview", width=160, height=120)
    assert (near != far).any()
    assert task.model.vis.map.shadowclip == clip


def test_unknown_cameras_and_large_pictures():
    task = base.create("cartpole")
    with pytest.raises(KeyError, match=r"camera: expected one of \['side'\], got 'top'"):
        render(task, [], camera="top")
    with pytest.raises(ValueError, match="framebuffer"):
        render(task, [], width=4000)


def test_without_opengl_the_error_says_what_to_set(monkeypatch):
    def fail(*arguments):
        raise OSError("no display")

    monkeypatch.setattr(rendering.mj, "Renderer", fail)
    monkeypatch.setitem(os.environ, "MUJOCO_GL", "glfw")
    with pytest.raises(RuntimeError, match="OSError with MUJOCO_GL='glfw'; set MUJOCO_GL=egl"):
        render(base.create("cartpole"), [])


def test_record_keeps_every_state_and_resets_nothing():
    env = make("cartpole", num_envs=2, episode_seconds=0.1)
    start = starts(env.task, 2)
    states = record(env, env.rand_action, start, steps=8)
    assert torch.equal(states[0].qpos, start.qpos)
    assert [round(float(s.time[1]), 6) for s in states] == [round(0.02 * i, 6) for i in range(9)]
    assert len(record(env, env.rand_action, start)) == 6
    assert not torch.equal(states[1].qvel, states[2].qvel)  # copies, not the simulation's memory


def test_sheet_puts_images_and_captions_in_place():
    dark = np.zeros_like(IMAGE)
    picture = sheet([[IMAGE, dark], [dark]], [["", ""], [""]])
    assert picture.shape == (48, 64, 3)
    assert (picture[:24, :32] == 128).all() and (picture[:24, 32:] == 0).all()
    assert (picture[24:, 32:] == 255).all()
    captioned = sheet([[dark]], [["left"]])
    assert captioned[:16].any() and not captioned[20:].any()


def test_save(tmp_path, monkeypatch):
    frames = [IMAGE, np.zeros_like(IMAGE), IMAGE]
    save(tmp_path / "new" / "film.gif", frames, fps=10)
    film = Image.open(tmp_path / "new" / "film.gif")
    assert (film.n_frames, film.info["duration"]) == (3, 100)
    save(tmp_path / "picture.png", [IMAGE])
    assert (np.asarray(Image.open(tmp_path / "picture.png").convert("RGB")) == IMAGE).all()
    with pytest.raises(ValueError, match="expected one frame for a png, got 3"):
        save(tmp_path / "picture.png", frames)
    with pytest.raises(
        ValueError, match=r"expected a file name that ends in .png, .gif or .mp4, got 'a.avi'"
    ):
        save(tmp_path / "a.avi", frames)
    save(tmp_path / "film.mp4", frames, fps=10)
    read = imageio_ffmpeg.read_frames(str(tmp_path / "film.mp4"))
    about = next(read)
    assert (about["size"], about["fps"], len(list(read))) == ((32, 24), 10.0, 3)
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(ImportError, match=r"film.mp4 needs imageio_ffmpeg.*\[video\]'; or write a .gif"):
        save(tmp_path / "film.mp4", frames)


def test_paths_of_mirrored_rollouts_coincide_when_mapped_back():
    task = base.create("anymal_push")
    env = BatchedEnv(task, 4, num_threads=1, seed=0)
    canonical, elements = starts(task), torch.arange(4)
    start = task.transform_state(canonical.rows(torch.zeros(4, dtype=torch.int64)), elements)
    action = task.symmetry["action"](torch.full((4, 12), 0.1), elements)
    states = record(env, lambda td: td.set("action", action), start, steps=10)
    run, back = overlay(task, states, elements.tolist()).axes
    paths = [
        [line.get_xydata() for line in axes.lines if len(line.get_xydata()) == 11] for axes in (run, back)
    ]
    assert len(paths[0]) == len(paths[1]) == 8  # base and cube of four goals
    assert np.abs(paths[0][4] - paths[0][5]).max() > 0.5
    for first in (0, 4):
        for other in range(1, 4):
            assert np.abs(paths[1][first] - paths[1][first + other]).max() < 1e-9


def test_no_paths_where_nothing_moves_freely():
    task = base.create("cartpole")
    with pytest.raises(ValueError, match="something moves freely, got 'cartpole'"):
        overlay(task, [starts(task)], [0])
