"""Tasks and environments on another device: nothing is asked of it, nothing is left on the host.

On an accelerator `.item()`, `bool(tensor)`, `nonzero()` and an index that is a mask stop the host until
everything before them is done. The device "meta" stands for it: its tensors have a shape and no numbers, so
that each of these fails. What meta forgives is refused by a mode that sees every operation: a tensor that
is made on the CPU, and one that is carried over in every step.
"""

import pytest
import torch
from tensordict import TensorDict
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from tasks import base
from tasks.anymal_climb import PHASES, AnymalClimb
from tasks.cartpole import CartPole
from tasks.curriculum import Averages
from tasks.draws import put
from tasks.environment import BatchedEnv
from tasks.state import State
from tests.task_helpers import actions, all_tasks, make
from tests.test_host_waits import WAITS

META = torch.device("meta")
SETTINGS = [
    ("cartpole", {}),
    ("anymal_push", {"friction": (0.5, 1.2), "added_mass": (-2.0, 4.0)}),
    ("anymal_push", {"curriculum": False}),
    ("anymal_climb", {}),
    ("trifinger_repose", {"yaw": 1.0, "friction": (0.5, 1.5), "cube_mass": (0.06, 0.1)}),
    ("trifinger_repose", {"difficulty": 2}),
    ("trifinger_repose", {"difficulty": 4, "curriculum": False}),
]
all_settings = pytest.mark.parametrize(("name", "kwargs"), SETTINGS, ids=str)


class MetaGenerator(torch.Generator):
    """A generator that says that it draws on the device."""

    @property
    def device(self):
        return META


class OnDevice(TorchDispatchMode):
    """Refuses what waits for the device, and tensors of the host, numbers apart, made or carried over."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name, out = func.name().split(".")[0], func(*args, **(kwargs or {}))
        if name in WAITS:
            raise AssertionError(f"{name} waits for the host")
        for x in tree_leaves((args, kwargs, out)):
            if isinstance(x, torch.Tensor) and x.device != META:
                raise AssertionError(f"{name} on the host, shape {tuple(x.shape)}")
        return out


class MetaSimulation:
    """What an engine on a device offers, with no numbers in it."""

    seconds = 0.0

    def __init__(self, task, num_envs):
        model, f32 = task.model, {"device": META, "dtype": torch.float32}
        self.qpos, self.qvel = (
            torch.zeros(num_envs, model.nq, **f32),
            torch.zeros(num_envs, model.nv, **f32),
        )
        self.mocap_pos = torch.zeros(num_envs, model.nmocap, 3, **f32)
        self.mocap_quat = torch.zeros(num_envs, model.nmocap, 4, **f32)
        self.time = torch.zeros(num_envs, device=META, dtype=torch.float64)
        self.ctrl = torch.zeros(num_envs, model.nu, **f32)
        self.fields = {
            name: torch.zeros(num_envs, *getattr(model, name).shape, **f32)
            for name in ("body_mass", "body_inertia", "geom_friction")
        }

    def step(self, ctrl, substeps, ids):
        assert ids is None or (ids.dtype, ids.shape) == (torch.bool, self.time.shape)
        self.ctrl.copy_(ctrl)
        self.time += substeps
        return True

    def diverged(self):
        return self.time > 3.0

    def write(self, ids, qpos, qvel, mocap_pos, mocap_quat, time):
        assert ids.dtype == torch.bool
        put(self.qpos, ids, qpos), put(self.qvel, ids, qvel), put(self.time, ids, time)
        for own, value in ((self.mocap_pos, mocap_pos), (self.mocap_quat, mocap_quat)):
            if value is not None:
                put(own, ids, value)

    def expand(self, name):
        return self.fields[name]

    def refresh(self, ids):
        assert ids.dtype == torch.bool


class MetaEnv(BatchedEnv):
    """An environment whose physics is put on a device afterwards: specs need numbers."""

    def __init__(self, task, num_envs=6):
        super().__init__(task, num_envs, num_threads=1, seed=0)
        self.simulation, self._generator = MetaSimulation(task, num_envs), MetaGenerator()
        self._asks, self._place = False, META
        variables = self._state.variables.items()
        self._state = self._state_with({name: x.float().to(META) for name, x in variables})
        self._over = self._over.to(META)
        self._device = META


def masked(env, **entries):
    return TensorDict(entries, batch_size=env.batch_size, device=META)


def played(env):
    """A start, a step of all rows, a step of some, and a reset of some; as TorchRL calls them."""
    n = env.batch_size[0]
    action = torch.zeros(n, env.task.action_size, device=META)
    mask = torch.zeros(n, 1, dtype=torch.bool, device=META)
    outs = [env._reset(), env._step(masked(env, action=action))]
    outs += [env._step(masked(env, action=action, _step=mask)), env._reset(masked(env, _reset=mask))]
    return outs


@all_settings
def test_steps_and_resets_stay_on_the_device(name, kwargs):
    env = MetaEnv(base.create(name, **kwargs))
    played(env)  # constants are copied there on first use
    with OnDevice():
        outs = played(env)
    for out in outs:
        for key, value in out.items():
            assert value.device == META, key
    assert outs[1]["observation"].dtype == outs[1]["reward"].dtype == torch.float32
    assert all(x.dtype == torch.float32 for x in env.state.variables.values())


@all_settings
def test_every_function_of_a_task_stays_on_the_device(name, kwargs):
    task, n = base.create(name, **kwargs), 4

    def everything():
        draw = MetaGenerator()
        state = task.sample_initial_state(n, draw)
        goals = task.sample_goal_states(2, draw)
        action = torch.zeros(n, task.action_size, device=META)
        outs = [goals.qpos, task.observe(state), task.reward(state, action), task.control(action, state)]
        outs += [*task.reward_terms(state, action).values(), *task.update(state, action).values()]
        outs += [task.terminated(state), task.success(state), *task.behaviour(state).values()]
        outs += [task.restart(state, draw, torch.ones(n, dtype=torch.bool, device=META)).qpos]
        outs += [task.transform_state(state, g).qpos for g in range(task.symmetry.group.order)]
        return outs

    everything()
    with OnDevice():
        outs = everything()
    assert all(x.device == META for x in outs if x is not None)


class Asks(CartPole):
    def terminated(self, state):
        return torch.full_like(state.time, bool(state.qpos.max() > 1))


class Counts(CartPole):
    def terminated(self, state):
        return state.time > len((state.time > 1).nonzero())


class Chooses(CartPole):
    def reward(self, state, action):
        reward = super().reward(state, action)
        reward[state.time > 1] = 2 * reward[state.time > 1]
        return reward


class Makes(CartPole):
    def reward(self, state, action):
        return super().reward(state, action) + torch.zeros(()).sum()


class Carries(CartPole):
    factor = torch.ones(())

    def reward(self, state, action):
        return super().reward(state, action) * self.factor.to(state.qpos.device)


class Numbers(CartPole):
    def restart(self, finished, generator, rows=None):
        return self.sample_initial_state(int(rows.sum()), generator)


class OnHost(CartPole):
    def sample_goal_state(self, n, generator):
        return State(qpos=torch.zeros(n, 2), qvel=torch.zeros(n, 2))


@pytest.mark.parametrize("task", [Asks, Counts, Chooses, Makes, Carries, Numbers, OnHost])
def test_a_task_that_waits_or_stays_on_the_host_is_caught(task):
    env = MetaEnv(task())
    with pytest.raises((AssertionError, RuntimeError, NotImplementedError)):
        played(env)
        with OnDevice():
            played(env)


# --- masks in place of row numbers give the same on the CPU


@pytest.mark.parametrize("kind", ["numbers", "mask"])
def test_rows_are_written_by_number_or_by_mask(kind):
    own, values = torch.zeros(4, 2), torch.arange(8.0).view(4, 2)
    ids = torch.tensor([1, 3])
    mask = torch.zeros(4, dtype=torch.bool).index_fill(0, ids, True)
    if kind == "numbers":
        put(own[:, 1], ids, values[ids, 0].double())
    else:
        put(own[:, 1], mask, values[:, 0].double())
    assert own.tolist() == [[0, 0], [0, 2], [0, 0], [0, 6]]


def test_averages_by_mask_are_those_of_the_rows():
    random = torch.Generator().manual_seed(0)
    by_rows, by_mask = Averages("success", "distance"), Averages("success", "distance")
    for count in (0, 3, 0, 16, 1):
        mask = torch.randperm(16, generator=random) < count
        distance, success = torch.rand(2, 16, generator=random)
        success = success < 0.5
        by_rows.update(success=success[mask], distance=distance[mask])
        by_mask.update_where(mask, success=success, distance=distance)
        assert by_mask.numbers() == pytest.approx(by_rows.numbers(), nan_ok=True, rel=1e-12)
    later = Averages("success", "distance")
    later.load(by_mask.numbers())  # as a checkpoint continues
    later.update_where(mask, success=success, distance=distance)
    by_mask.update_where(mask, success=success, distance=distance)
    assert later.numbers() == by_mask.numbers()


@all_tasks
def test_a_restart_by_mask_judges_its_rows_alone(name):
    """Levels and averages of the rows of the mask are those of a restart of these rows."""
    kwargs = {} if name == "cartpole" else {"curriculum": True}
    by_rows, by_mask = base.create(name, **kwargs), base.create(name, **kwargs)
    finished = by_rows.sample_initial_state(64, torch.Generator().manual_seed(0))
    finished.time[:] = by_rows.episode_seconds * (torch.arange(64) % 3 != 0)
    if name != "cartpole":
        finished.variables["level"][:] = 2.0
        body = {"anymal_push": 19, "anymal_climb": 0, "trifinger_repose": 9}[name]
        target = finished.mocap_pos[:, -1]
        finished.qpos[::2, body : body + 2] = target[::2, :2]
        finished.qpos[:, 2] = torch.where(torch.arange(64) % 5 == 0, target[:, 2], finished.qpos[:, 2])
    rows = torch.arange(64) % 4 < 2
    some = by_rows.restart(finished.rows(rows), torch.Generator().manual_seed(1))
    all_ = by_mask.restart(finished, torch.Generator().manual_seed(1), rows)
    assert len(all_) == 64 and by_mask.metrics() == pytest.approx(by_rows.metrics(), nan_ok=True)
    if name != "cartpole":
        assert torch.equal(all_.variables["level"][rows], some.variables["level"])
        assert len(some.variables["level"].unique()) > 1 and by_rows.metrics()["success"] > 0


def test_phases_follow_each_other_by_arithmetic():
    task = AnymalClimb()
    start = task.sample_initial_state(4, torch.Generator().manual_seed(0))
    nobody = torch.zeros(4, dtype=torch.bool)
    for success, phase in ((0.69, "A"), (0.71, "B"), (0.9, "C"), (0.9, "C")):
        values = torch.tensor([success, 6.0, 0.1], dtype=torch.float64)
        task.curriculum.averages.values = dict(zip(("success", "level", "distance"), values, strict=True))
        task.restart(start, torch.Generator(), nobody)
        assert task.phase == phase and task.phase in PHASES
    assert isinstance(task._phase, torch.Tensor) and task.state_dict()["phase"] == "C"


@all_tasks
def test_single_precision_states_give_the_same_to_rounding(name):
    task = base.create(name)
    env = make(name)
    env.reset()
    for action in 0.2 * actions(env, 5):
        env.step(TensorDict(action=action, batch_size=env.batch_size))
    state = env.state
    single = State(
        *(x.float() for x in (state.qpos, state.qvel, state.mocap_pos, state.mocap_quat)),
        time=state.time,
        variables={name: x.float() for name, x in state.variables.items()},
    )
    action = 0.3 * actions(env, 1)[0]
    torch.testing.assert_close(task.observe(single), task.observe(state), rtol=1e-4, atol=1e-4)
    for term, value in task.reward_terms(state, action).items():
        torch.testing.assert_close(
            task.reward_terms(single, action)[term].double(), value.double(), rtol=1e-3, atol=1e-4, msg=term
        )
