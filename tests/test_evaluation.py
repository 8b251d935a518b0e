"""Evaluation over equivalent goals: returns, variation, isolation from training."""

import pytest
import torch
from tensordict.nn import TensorDictModule

from tasks.environment import BatchedEnv
from tasks.evaluation import Evaluation, evaluate
from tests.task_helpers import Falling, make


def test_evaluate_needs_a_task():
    with pytest.raises(TypeError, match="expected a BatchedEnv or a task name, got int"):
        evaluate(3, lambda td: td)


def test_evaluation_of_an_equivariant_policy_has_no_variation():
    def odd(observation):
        return torch.tanh(observation @ torch.tensor([[0.5], [-2.0], [-1.0]]))

    policy = TensorDictModule(odd, ["observation"], ["action"])
    result = evaluate("cartpole", policy, episodes=20, num_threads=1)
    assert result.returns.shape == (2, 20)
    assert torch.equal(result.returns[0], result.returns[1])
    assert result.variation == 0.0
    assert result.returns[0].std() > 0


def test_evaluation_of_a_one_sided_policy_shows_its_side():
    policy = TensorDictModule(lambda x: torch.ones_like(x[..., :1]), ["observation"], ["action"])
    result = evaluate("cartpole", policy, episodes=20, seed=1, num_threads=1)
    means = result.goal_means
    assert set(means) == {"right", "left"}
    assert result.variation == pytest.approx(abs(means["right"] - means["left"]))
    assert result.variation > 0.01
    assert result.mean == pytest.approx(sum(means.values()) / 2)
    again = evaluate("cartpole", policy, episodes=20, seed=1, num_threads=2)
    assert torch.equal(again.returns, result.returns)
    assert not torch.equal(evaluate("cartpole", policy, 20, seed=2).returns, result.returns)


def test_evaluation_by_hand():
    """A pole that stays upright for an episode of n steps earns exactly what the rewards add up to."""
    policy = TensorDictModule(lambda x: torch.zeros_like(x[..., :1]), ["observation"], ["action"])
    env = make("cartpole", num_envs=6, episode_seconds=1.0)
    result = evaluate(env, policy, episodes=6, seed=5, num_threads=1)
    start = env.task.sample_goal_state(6, torch.Generator().manual_seed(5))
    rollout = env.rollout(50, policy, tensordict=env.reset_to(start), auto_reset=False)
    expected = rollout["next", "reward"].double().sum(dim=(1, 2))
    torch.testing.assert_close(result.returns[0], expected)


def test_evaluation_stops_where_the_first_episode_ends():
    policy = TensorDictModule(lambda x: torch.zeros_like(x[..., :1]), ["observation"], ["action"])
    env = BatchedEnv(Falling(), 1, num_threads=1)
    returns = evaluate(env, policy, episodes=30, num_threads=1).returns
    start = env.task.sample_goal_state(30, torch.Generator().manual_seed(0))
    env = BatchedEnv(env.task, 30, num_threads=1)
    rollout = env.rollout(200, policy, tensordict=env.reset_to(start), auto_reset=False,
                          break_when_any_done=False)  # fmt: skip
    first_end = rollout["next", "done"].squeeze(-1).int().argmax(dim=1)
    assert len(first_end.unique()) > 1
    torch.testing.assert_close(returns[0], first_end.double() + 7)


def test_evaluation_leaves_the_environment_and_the_random_numbers_alone():
    env = make("cartpole")
    env.rollout(3)
    saved, rng = env.save_state(), torch.get_rng_state()
    policy = TensorDictModule(lambda x: torch.zeros_like(x[..., :1]), ["observation"], ["action"])
    evaluate(env, policy, episodes=2, num_threads=1)
    assert torch.equal(env.save_state()["simulation"]["rows"], saved["simulation"]["rows"])
    assert torch.equal(env.save_state()["generator"], saved["generator"])
    assert torch.equal(torch.get_rng_state(), rng)


def test_variation_is_the_largest_difference_between_goals():
    result = Evaluation(("a", "b", "c"), torch.tensor([[1.0, 3.0], [0.0, 0.0], [5.0, 6.0]]))
    assert result.variation == 5.5
    assert result.mean == 2.5
    assert result.goal_means == {"a": 2.0, "b": 0.0, "c": 5.5}
