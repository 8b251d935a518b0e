"""Saving and resuming environments, and what later tasks need: variables, curriculum, randomisation."""

import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector

from tasks.cartpole import CartPole
from tasks.environment import BatchedEnv
from tasks.state import concatenate
from tests.task_helpers import (
    actions,
    all_tasks,
    assert_same,
    equivariance_error,
    make,
    play,
    stagger,
)
from torchrl_sym.representations import invariant


@all_tasks
def test_saved_run_continues_exactly(name, tmp_path):
    """2k steps equal k steps, save to disk, a new environment, restore, k steps."""
    k = 40
    env = make(name, num_envs=5, episode_seconds=0.5)
    sequence = actions(env, 2 * k)
    whole = play(env, stagger(env), sequence)
    assert whole["next", "done"][:k].any() and whole["next", "done"][k:].any()

    env = make(name, num_envs=5, episode_seconds=0.5)
    first = play(env, stagger(env), sequence[:k])
    torch.save(env.save_state(), tmp_path / "state.pt")
    other = make(name, num_envs=5, episode_seconds=0.5, seed=99)
    play(other, other.reset(), sequence[:3])
    other.restore_state(torch.load(tmp_path / "state.pt", weights_only=True))
    second = play(other, other.reset(), sequence[k:])
    assert_same(torch.cat([first, second]), whole)
    assert not torch.equal(other.reset()["observation"], other.reset()["observation"])


@all_tasks
def test_save_in_the_middle_of_a_step_with_ended_episodes(name):
    """rollout() does not reset after its last step: the ended rows begin anew after restoring."""
    env = make(name, num_envs=5, episode_seconds=0.1)
    steps = env.task.max_steps
    rollout = env.rollout(2 * steps, break_when_any_done=False, policy=_zero_policy(env))
    env = make(name, num_envs=5, episode_seconds=0.1)
    env.rollout(steps, break_when_any_done=False, policy=_zero_policy(env))
    other = make(name, num_envs=5, episode_seconds=0.1, seed=99)
    other.restore_state(env.save_state())
    second = other.rollout(steps, break_when_any_done=False, policy=_zero_policy(env))
    assert torch.equal(second["observation"], rollout["observation"][:, steps:])


def _zero_policy(env):
    return TensorDictModule(
        lambda x: torch.zeros(*x.shape[:-1], env.task.action_size), ["observation"], ["action"]
    )


def _linear_policy(env):
    torch.manual_seed(0)
    return TensorDictModule(
        torch.nn.Linear(env.task.observation_size, env.task.action_size), ["observation"], ["action"]
    )


@all_tasks
@pytest.mark.parametrize("seconds", [0.5, 0.6], ids=["mid-episode", "at the end of an episode"])
def test_collector_on_a_restored_environment_continues(name, seconds):
    def collector(env):
        return Collector(
            env,
            _linear_policy(env),
            frames_per_batch=5 * 30,
            total_frames=5 * 60,
            trust_policy=True,
            auto_register_policy_transforms=False,
        )

    def content(batch):
        return batch.select("observation", "action", "next")

    env = make(name, num_envs=5, episode_seconds=seconds)
    whole = [content(batch.clone()) for batch in collector(env)]

    env = make(name, num_envs=5, episode_seconds=seconds)
    iterator = iter(collector(env))
    assert_same(content(next(iterator).clone()), whole[0])
    other = make(name, num_envs=5, episode_seconds=seconds, seed=99)
    other.restore_state(env.save_state())
    assert_same(content(next(iter(collector(other))).clone()), whole[1])


@all_tasks
def test_restoring_the_wrong_number_of_simulations_fails(name):
    with pytest.raises(ValueError, match=r"saved .* of shape \(3,.*got \(4,"):
        make(name, num_envs=3).restore_state(make(name, num_envs=4).save_state())
    with pytest.raises(ValueError, match=r"expected a state of 3 rows.*got 2"):
        env = make(name, num_envs=3)
        env.reset_to(env.task.sample_goal_state(2, None))


class Memory(CartPole):
    """CartPole with a last action, a target, a curriculum level per row and a random pole mass."""

    def __init__(self):
        super().__init__(episode_seconds=0.1)
        self.seen = 0

    def sample_goal_state(self, n, generator):
        state = super().sample_goal_state(n, generator)
        state.variables = {"last_action": torch.zeros(n, 1), "level": torch.zeros(n, 1)}
        return state

    def variables(self):
        return {"last_action": self.robot.actuators, "level": invariant(self.robot.group, 1)}

    def restart(self, finished, generator):
        start = super().restart(finished, generator)
        start.variables["level"] = finished.variables["level"] + 1
        self.seen += len(finished)
        return start

    def randomize(self, simulation, ids, generator):
        mass = simulation.expand("body_mass")
        mass[ids, 2] = 0.1 + 0.1 * torch.rand(len(ids), generator=generator, dtype=torch.float64)
        simulation.refresh(ids)

    def update(self, state, action):
        return {"last_action": action}

    def reward(self, state, action):
        return -(action - state.variables["last_action"]).abs().squeeze(-1).double()

    def state_dict(self):
        return {"seen": self.seen}

    def load_state_dict(self, saved):
        self.seen = saved["seen"]


def test_variables_are_updated_after_the_reward_and_kept_per_row():
    env = BatchedEnv(Memory(), 3, num_threads=1, seed=0)
    sequence = actions(env, 7)
    batch = play(env, env.reset(), sequence)
    last = torch.cat([torch.zeros(1, 3, 1), sequence[:4], torch.zeros(1, 3, 1), sequence[5:6]])
    torch.testing.assert_close(batch["next", "reward"], -(sequence - last).abs())
    assert env.state.variables["level"].tolist() == [[1.0]] * 3
    assert env.task.seen == 3


def test_variables_randomisation_and_curriculum_are_saved():
    def env(seed):
        return BatchedEnv(Memory(), 3, num_threads=1, seed=seed)

    sequence = actions(env(0), 30)
    first = env(0)
    whole = play(first, first.reset(), sequence)
    assert len(first.simulation.expand("body_mass")[:, 2].unique()) == 3
    first = env(0)
    play(first, first.reset(), sequence[:13])
    second = env(1)
    second.restore_state(first.save_state())
    assert second.task.seen == first.task.seen == 6
    assert_same(play(second, second.reset(), sequence[13:]), whole[13:])


def test_variables_take_part_in_the_symmetry_check():
    task = Memory()
    task.randomize = lambda *args: None
    assert equivariance_error(task, task.symmetry, "reflect-x", steps=4) == 0.0


class Feedback(CartPole):
    """Drives the cart by a shared quantity, which changes with every step and every reset."""

    def control(self, action, state):
        return 3.0 * torch.sin(state.shared("angle", lambda: state.qpos[:, 1:] * 1.0))


class PlainFeedback(CartPole):
    def control(self, action, state):
        return 3.0 * torch.sin(state.qpos[:, 1:])


def test_shared_quantities_are_never_stale():
    batches = []
    for cls in (Feedback, PlainFeedback):
        env = BatchedEnv(cls(episode_seconds=0.5), 5, num_threads=1, seed=0)
        sequence = actions(env, 40)
        first = play(env, stagger(env), sequence)
        other = BatchedEnv(cls(episode_seconds=0.5), 5, num_threads=1)
        play(other, other.reset(), sequence[:3])
        other.restore_state(env.save_state())
        last = first[-1]["next"].select("observation", "done", "terminated", "truncated")
        batches.append(torch.cat([first, play(other, last, sequence)]))
    assert_same(*batches)


def test_states_are_joined_and_cut_with_their_variables():
    task = Memory()
    a, b = (task.sample_goal_state(n, None) for n in (2, 3))
    joined = concatenate([a, b])
    assert len(joined) == 5
    assert torch.equal(joined.rows(slice(2, 5)).qpos, b.qpos)
    assert joined.variables["last_action"].shape == (5, 1)
    part = joined.rows(torch.tensor([4]))
    part.qpos[:] = 0
    assert joined.qpos[4, 1] > 1, "rows() must copy"
