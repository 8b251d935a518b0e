"""What the tests of the tasks share: short environments, fixed actions, the equivariance error."""

import pytest
import torch
from tensordict import TensorDict

import tasks
from tasks.cartpole import CartPole
from tasks.environment import BatchedEnv

all_tasks = pytest.mark.parametrize("name", tasks.ALL_TASKS)

# Keyword arguments under which a task's physics, starts or reward differ.
SETTINGS = {
    "cartpole": ({},),
    "anymal_push": (
        {"curriculum": False},
        {"friction": (0.5, 1.2), "added_mass": (-2.0, 4.0), "physics_timestep": 0.01},
    ),
    "anymal_climb": ({"phase": "A"}, {"phase": "C", "curriculum": False, "height": 0.3}),
    "trifinger_repose": ({"difficulty": 2}, {"difficulty": 4}, {"yaw": 1.0}),
}
all_settings = pytest.mark.parametrize(
    ("name", "kwargs"), [(name, kwargs) for name in tasks.ALL_TASKS for kwargs in SETTINGS[name]]
)


def make(name, num_envs=4, seed=0, **kwargs):
    return tasks.make_env(name, num_envs=num_envs, num_threads=1, seed=seed, **kwargs)


def actions(env, steps, seed=0, scale=1.0):
    shape = (steps, *env.action_spec.shape)
    return (torch.rand(shape, generator=torch.Generator().manual_seed(seed)) * 2 - 1) * scale


def play(env, tensordict, actions):
    """Fixed actions with automatic resets: the (observation, reward, next observation, done)."""
    rows = []
    for action in actions:
        out, tensordict = env.step_and_maybe_reset(tensordict.set("action", action))
        rows.append(out.select("observation", "next"))
    return torch.stack(rows)


def assert_same(a, b):
    assert a.batch_size == b.batch_size
    for key in a.keys(True, True):
        assert torch.equal(a[key], b[key]), key


def stagger(env):
    """Put the rows at different times of their episodes, so that they end one after the other."""
    start = env.task.sample_initial_state(len(env.state), torch.Generator().manual_seed(3))
    limit = env.task.episode_seconds
    start.time[:] = torch.linspace(0, 0.98 * limit, len(start), dtype=torch.float64)
    start.time.div_(env.task.control_timestep).round_().mul_(env.task.control_timestep)
    return env.reset_to(start)


def starting_at(task, states, num_envs=16):
    """An environment whose episodes start in one of these states or in one of their images."""

    def draw(n, generator):
        ids = torch.randint(len(states), (n,), generator=generator)
        element = torch.randint(task.symmetry.group.order, (n,), generator=generator)
        return task.transform_state(states.rows(ids), element)

    task.sample_initial_state = draw
    task.restart = lambda finished, generator: draw(len(finished), generator)
    return BatchedEnv(task, num_envs, num_threads=1, seed=0)


def reached(task, start, steps, scale=0.0):
    """The states after some steps of random actions, of the rows that are still in their episode."""
    env = BatchedEnv(task, len(start), num_threads=1, seed=0)
    env.reset_to(start)
    alive = torch.ones(len(start), dtype=torch.bool)
    for action in actions(env, steps, scale=scale):
        alive &= ~env.step(TensorDict(action=action, batch_size=env.batch_size))["next", "done"][:, 0]
    return env.state.rows(alive)


def equivariance_error(task, symmetry, g, steps=100, n=16):
    """Largest violation of T(L s, K a) = L T(s, a), of observation, reward and end, over a run.

    One environment runs from s, one from L_g s with mirrored actions; both start at the same draws.
    """
    start = task.sample_initial_state(n, torch.Generator().manual_seed(0))
    original, mirrored = (BatchedEnv(task, n, num_threads=1, seed=0) for _ in range(2))
    a, b = original.reset_to(start), mirrored.reset_to(task.transform_state(start, g))

    def difference(x, y):
        return float((x - y).abs().max()) if x.numel() else 0.0

    L, K = symmetry["observation"], symmetry["action"]
    errors = [difference(L(a["observation"], g), b["observation"])]
    for action in actions(original, steps, scale=1.3):
        a = original.step(TensorDict(action=action, batch_size=[n]))["next"]
        b = mirrored.step(TensorDict(action=K(action, g), batch_size=[n]))["next"]
        state, image = task.transform_state(original.state, g), mirrored.state
        errors += [
            difference(state.qpos, image.qpos),
            difference(state.qvel, image.qvel),
            difference(L(a["observation"], g), b["observation"]),
            difference(a["reward"], b["reward"]),
            difference(a["done"].float(), b["done"].float()),
        ]
        errors += [difference(state.variables[k], image.variables[k]) for k in state.variables]
    return max(errors)


class Falling(CartPole):
    """Ends with reward 7 where the pole comes close to hanging; 1 for every other step."""

    def reward(self, state, action):
        return torch.where(self.terminated(state), 7.0, 1.0)

    def terminated(self, state):
        return self.observe(state)[:, 1].abs() > 0.75
