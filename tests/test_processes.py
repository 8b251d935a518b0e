"""Environments, tasks and symmetries in other processes: forked, spawned, pickled, copied."""

import copy
import gc
import os
import pickle
import signal
import threading
import time
import weakref

import mujoco
import numpy as np
import pytest
import torch
import torch.multiprocessing
from torchrl.collectors import MultiSyncCollector

import tasks
from tasks import base, rendering
from tasks.environment import BatchedEnv
from tasks.simulation import Simulation
from tests.task_helpers import SETTINGS, actions, all_tasks, assert_same, make, play, stagger
from torchrl_sym import PointGroup
from torchrl_sym.mujoco import audit, derive, verify

SLIDER = """
<mujoco><worldbody><body><joint name="slide" type="slide" axis="1 0 0"/><geom size=".1"/></body></worldbody>
<sensor><jointpos joint="slide"/></sensor></mujoco>
"""
ways = pytest.mark.parametrize("copied", [lambda x: pickle.loads(pickle.dumps(x)), copy.deepcopy],
                               ids=["pickle", "deepcopy"])  # fmt: skip


def in_a_forked_child(function):
    """What ``function`` returns or raises there, as text; empty if it hangs."""
    receive, send = os.pipe()
    pid = os.fork()
    if pid == 0:
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(20)
        try:
            result = str(function())
        except Exception as error:
            result = f"{type(error).__name__}: {error}"
        os.write(send, result.encode())
        os._exit(0)
    os.close(send)
    with os.fdopen(receive) as pipe:
        result = pipe.read()
    os.waitpid(pid, 0)
    return result


# --- forked children


@pytest.mark.parametrize(
    "use",
    [
        lambda env: env.rollout(2),
        lambda env: env.step(env.rand_action(env.reset())),
        lambda env: env.simulation.step(torch.zeros(3, 1)),
        lambda env: env.simulation.refresh(),
        lambda env: env.simulation.data(0),
    ],
    ids=["rollout", "step", "physics", "refresh", "data"],
)
def test_physics_threads_do_not_exist_in_a_forked_child(use):
    env = tasks.make_env("cartpole", num_envs=3, num_threads=2, seed=0)
    env.reset()
    env.simulation.expand("body_mass")
    result = in_a_forked_child(lambda: use(env))
    assert result.startswith("RuntimeError: expected physics in the process that made it")
    assert "make the environment in the process that uses it" in result
    env.rollout(2)  # the parent goes on


def observation(env, steps=3):
    return play(env, env.reset(), actions(env, steps))["next", "observation"]


@pytest.mark.parametrize(
    ("num_threads", "child"),
    [
        (1, lambda env: env),
        (2, copy.deepcopy),
        (2, lambda env: tasks.make_env("cartpole", num_envs=3, num_threads=2, seed=0)),
    ],
    ids=["one thread", "a copy", "a new one"],
)
def test_what_works_in_a_forked_child(num_threads, child):
    env = tasks.make_env("cartpole", num_envs=3, num_threads=num_threads, seed=0)
    result = in_a_forked_child(lambda: observation(child(env)).tolist())
    assert result == str(observation(env).tolist())


def test_the_state_can_be_read_in_a_forked_child():
    env = tasks.make_env("cartpole", num_envs=3, num_threads=2, seed=0)
    env.rollout(2)
    saved = env.save_state()["simulation"]["rows"].tolist()
    assert in_a_forked_child(lambda: env.save_state()["simulation"]["rows"].tolist()) == str(saved)


@pytest.mark.parametrize("keep", [lambda env: env, lambda env: env.simulation.qpos], ids=["all", "a view"])
def test_a_forked_child_can_drop_what_has_threads(keep):
    kept = [keep(tasks.make_env("cartpole", num_envs=3, num_threads=2))]
    gc.collect()

    def drop():
        kept.clear()
        return gc.collect() >= 0

    assert in_a_forked_child(drop) == "True"


def test_a_pool_outlives_a_forked_child():
    """Nothing refers to it, so that no order in which a process tears itself down destroys it."""
    kept = [tasks.make_env("cartpole", num_envs=3, num_threads=2)]
    pool = weakref.ref(kept[0].simulation._batch._b)

    def drop():
        kept.clear()
        gc.collect()
        return pool() and gc.get_referrers(pool())

    assert in_a_forked_child(drop) == "[]"
    drop()
    assert pool() is None, "in its own process nothing keeps it"


def test_a_step_of_another_thread_is_noticed():
    """Its lock stays locked in the child, even where one physics thread does all the work."""
    simulation = Simulation(mujoco.MjModel.from_xml_string(SLIDER), 64, num_threads=1)
    thread = threading.Thread(target=simulation.step, args=(torch.zeros(64, 0), 6000))
    thread.start()
    time.sleep(0.05)
    result = in_a_forked_child(lambda: simulation.step(torch.zeros(64, 0)))
    assert thread.is_alive(), "expected the fork in the middle of the step"
    thread.join()
    assert result.startswith("RuntimeError: expected physics in the process")
    assert in_a_forked_child(lambda: simulation.step(torch.zeros(64, 0))) == "False"


def test_the_dm_control_face_goes_on_in_a_forked_child():
    env = tasks.load("cartpole", random=0)
    env.reset()
    result = in_a_forked_child(lambda: env.step([0.5]).reward)
    assert result == str(env.step([0.5]).reward)


def test_rendering_in_a_forked_child_of_a_renderer_is_refused(monkeypatch):
    task = base.create("cartpole")
    monkeypatch.setattr(rendering.mj, "Renderer", lambda *args: 1 / 0)
    with pytest.raises(RuntimeError, match="expected OpenGL"):
        rendering.render(task, [])
    result = in_a_forked_child(lambda: rendering.render(task, []))
    assert result.startswith("RuntimeError: expected rendering in the process that rendered first")


# --- copies


@ways
@all_tasks
def test_a_copied_environment_continues_exactly(name, copied):
    env = make(name, num_envs=5, episode_seconds=0.5, **SETTINGS[name][-1])
    sequence = actions(env, 60)
    last = play(env, stagger(env), sequence[:20])[-1]["next"]
    last = last.select("observation", "done", "terminated", "truncated")
    twin = copied(env)
    assert twin.simulation.model is twin.task.model
    assert type(twin.simulation.num_threads) is int
    expected = play(env, last.clone(), sequence[20:])
    assert expected["next", "done"].any()
    assert_same(play(twin, last.clone(), sequence[20:]), expected)
    assert_same(twin.reset(), env.reset())
    assert twin.metrics().keys() == env.metrics().keys()


@ways
def test_a_copy_keeps_count_and_flags(copied):
    env = make("cartpole", num_envs=3)
    with pytest.raises(RuntimeError, match=r"call reset\(\) first"):
        copied(env).step(env.rand_action())
    assert_same(copied(env).reset(), env.reset())
    env.step(env.reset().set("action", torch.tensor([[0.0], [torch.nan], [0.0]])))
    twin = copied(env)
    assert twin.num_diverged == 1
    assert twin.simulation.diverged().tolist() == [False, True, False]
    saved = env.save_state()
    for each in (env, twin):
        each.restore_state(saved)
    assert_same(copied(env).reset(), twin.reset())
    staggered = make("cartpole", num_envs=3)
    staggered.stagger()
    assert_same(copied(staggered).reset(), staggered.reset())
    assert len(set(staggered.state.time.tolist())) == 3


@ways
@all_tasks
def test_a_copied_dm_control_environment_continues_exactly(name, copied):
    env = tasks.load(name, random=0, episode_seconds=0.5, **SETTINGS[name][-1])
    env.reset()
    sequence = np.random.RandomState(0).uniform(-1, 1, (60, *env.action_spec().shape))
    for action in sequence[:10]:
        env.step(action)
    twin = copied(env)
    steps = [(env.step(action), twin.step(action)) for action in sequence[10:]]
    assert any(step.last() for step, _ in steps)
    for step, other in steps:
        assert (step.step_type, step.reward, step.discount) == (
            other.step_type, other.reward, other.discount
        )  # fmt: skip
        np.testing.assert_array_equal(step.observation["observation"], other.observation["observation"])


@ways
@all_tasks
def test_a_copied_task_means_the_same(name, copied):
    task = base.create(name, **SETTINGS[name][-1])
    twin = copied(task)
    assert twin.model.nq == task.model.nq and twin.goal_names == task.goal_names
    assert str(twin.robot) == str(task.robot)
    states = [each.sample_goal_states(3, torch.Generator().manual_seed(0)) for each in (task, twin)]
    for g in range(task.symmetry.group.order):
        a, b = (
            each.observe(each.transform_state(s, g)) for each, s in zip((task, twin), states, strict=True)
        )
        assert torch.equal(a, b)
    a, b = (BatchedEnv(each, 3, num_threads=1, seed=0) for each in (task, twin))
    assert torch.equal(observation(a), observation(b))


@ways
def test_an_edited_model_is_copied_as_it_is(copied):
    task = base.create("anymal_push", payload=3.0, weak_leg="LF")
    twin = copied(task)
    assert twin.model.body("payload").mass == 3.0
    np.testing.assert_array_equal(twin.model.actuator_forcerange, task.model.actuator_forcerange)


@ways
def test_symmetries_and_reports_are_copied(copied):
    group = PointGroup.reflection("x")
    model = mujoco.MjModel.from_xml_string(SLIDER)
    robot = derive(model, group)
    twin = copied(robot)
    assert twin.group == group and str(twin) == str(robot)
    assert torch.equal(twin.sensordata.matrices, robot.sensordata.matrices)
    assert torch.equal(copied(twin).sensordata.matrices, robot.sensordata.matrices)  # now it is cached
    assert twin.map_qpos(torch.ones(1, 1), "reflect-x").tolist() == [[-1.0]]
    env = make("cartpole")
    symmetry = copied(env.symmetry)
    out = env.reset()
    assert_same(symmetry(out, "reflect-x"), env.symmetry(out, "reflect-x"))
    assert str(copied(audit(model, group))) == str(audit(model, group))
    report = verify(env, env.symmetry, steps=1)
    assert str(copied(report)) == str(report)


# --- spawned processes


def continued(envs, suite, robot):
    rollouts = [observation(env, 20).numpy() for env in envs]
    return [*rollouts, np.array([suite.step([0.3]).reward for _ in range(20)]), str(robot)]


def spawned(connection, *things):
    torch.set_num_threads(1)
    connection.send(continued(*things))


def test_a_spawned_process_continues_and_shares_nothing():
    """multiprocessing moves tensors to shared memory, where two episodes would meet."""
    envs = [tasks.make_env(name, num_envs=3, num_threads=2, seed=0) for name in tasks.ALL_TASKS]
    for env in envs:
        env.rollout(3)
    suite = tasks.load("cartpole", random=0)
    suite.reset()
    things = (envs, suite, envs[0].task.robot)
    context = torch.multiprocessing.get_context("spawn")
    receive, send = context.Pipe(duplex=False)
    process = context.Process(target=spawned, args=(send, *things))
    process.start()
    send.close()
    theirs = receive.recv()
    process.join()
    for mine, other in zip(continued(*things), theirs, strict=True):
        np.testing.assert_array_equal(mine, other)


def test_an_environment_is_handed_to_a_collector_in_another_process():
    env = tasks.make_env("anymal_climb", num_envs=3, num_threads=2, seed=0)
    collector = MultiSyncCollector([env], None, frames_per_batch=12, total_frames=12)
    try:
        (batch,) = [batch.clone() for batch in collector]
    finally:
        collector.shutdown()
    assert batch.batch_size == (1, 3, 4)
    assert batch["next", "observation"].isfinite().all()
