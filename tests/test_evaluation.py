"""Evaluation over equivalent goals: returns, variation, isolation from training."""

import pytest
import torch
from tensordict.nn import TensorDictModule
from torchrl.envs.utils import ExplorationType
from torchrl.modules import IndependentNormal, ProbabilisticActor

from tasks.base import Task, create
from tasks.cartpole import CartPole
from tasks.draws import uniform
from tasks.environment import BatchedEnv
from tasks.evaluation import Evaluation, evaluate
from tests.task_helpers import Falling, all_tasks, make

# Rewards of a step are summed in float64 but pass through the environment as float32.
CLOSE = {"rtol": 1e-5, "atol": 1e-6}


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


class Measured(Falling):
    """Success where the pole is on the right; terms, one of which sees a variable from before the step."""

    task_terms = ("upright", "smooth")

    def variables(self):
        return {"last_action": self.robot.actuators}

    def sample_goal_state(self, n, generator):
        state = super().sample_goal_state(n, generator)
        state.variables["last_action"] = torch.zeros(n, 1, dtype=torch.float64)
        return state

    def update(self, state, action):
        return {"last_action": action.double()}

    def reward_terms(self, state, action):
        change = action.double() - state.variables["last_action"]
        return {
            "upright": self.observe(state)[:, 1].abs().double(),
            "smooth": -change.square().sum(-1),
            "alive": torch.full((len(state),), 0.5, dtype=torch.float64),
        }

    reward = Task.reward

    def success(self, state):
        return state.qpos[:, 1] > 0


def noisy(scale=1.0):
    return ProbabilisticActor(
        TensorDictModule(
            lambda x: (torch.zeros_like(x[..., :1]), torch.full_like(x[..., :1], scale)),
            ["observation"], ["loc", "scale"],
        ),
        in_keys=["loc", "scale"], distribution_class=IndependentNormal,
    )  # fmt: skip


def test_terms_add_up_to_the_return():
    env = BatchedEnv(Measured(episode_seconds=1.0), 1, num_threads=1)
    result = evaluate(env, noisy(), 20, num_threads=1, exploration=ExplorationType.RANDOM)
    assert list(result.terms) == ["upright", "smooth", "alive"]
    assert (result.terms["smooth"] < -1.0).all()  # the action did change
    torch.testing.assert_close(sum(result.terms.values()), result.returns.mean(dim=1), **CLOSE)
    expected = (result.returns.mean(dim=1) - result.terms["alive"]).tolist()
    assert list(result.task_means.values()) == pytest.approx(expected, rel=1e-5)


def test_success_is_judged_at_the_end_of_the_first_episode():
    env = BatchedEnv(Measured(episode_seconds=1.0), 1, num_threads=1)
    result = evaluate(env, noisy(), 20, num_threads=1)
    assert result.successes.shape == (2, 20) and result.successes.dtype == torch.bool
    # A pole left alone falls on the side where it starts, and its episode ends before it hangs.
    assert result.goal_successes == {"right": 1.0, "left": 0.0}
    assert result.success == 0.5


def test_a_simulation_that_diverged_has_failed_and_earns_nothing_more():
    def policy(tensordict):
        action = torch.zeros(tensordict.shape[0], 1)
        if len(calls) == 3:
            action[1] = torch.nan
        calls.append(1)
        return tensordict.set("action", action)

    class Always(Measured):
        def success(self, state):
            return torch.ones(len(state), dtype=torch.bool)

    calls = []
    env = BatchedEnv(Always(episode_seconds=1.0), 1, num_threads=1)
    result = evaluate(env, policy, 3, num_threads=1)
    assert result.successes.tolist() == [[True, False, True], [True, True, True]]
    torch.testing.assert_close(sum(result.terms.values()), result.returns.mean(dim=1), **CLOSE)
    assert result.returns[0, 1] < 0.5 * result.returns[0, 0]


def test_a_task_without_a_notion_of_success():
    result = evaluate("cartpole", noisy(), 2, num_threads=1)
    assert result.successes is None and result.success is None
    assert result.goal_successes == {}
    assert result.task_means == pytest.approx(result.goal_means)
    assert Evaluation(("a",), torch.ones(1, 1)).task_means == {}


def test_sampled_actions_follow_the_seed_and_leave_the_random_numbers_alone():
    def returns(seed, scale=1.0, exploration=ExplorationType.RANDOM):
        return evaluate(env, noisy(scale), 4, seed, num_threads=1, exploration=exploration).returns

    env = make("cartpole", episode_seconds=0.2)
    rng = torch.get_rng_state()
    first = returns(0)
    assert torch.equal(torch.get_rng_state(), rng)
    torch.rand(3)
    assert torch.equal(returns(0), first)
    assert not torch.equal(returns(1), first)
    # The noise of the actions is not paired; without it, mirrored starts earn the same.
    assert not torch.equal(first[0], first[1])
    still = returns(0, exploration=ExplorationType.DETERMINISTIC)
    assert torch.equal(still[0], still[1])


@all_tasks
def test_terms_of_every_task_add_up_to_its_return(name):
    env = make(name, num_envs=1, episode_seconds=0.2)
    still = torch.zeros(env.task.action_size)
    policy = TensorDictModule(lambda x: still.expand(len(x), -1), ["observation"], ["action"])
    result = evaluate(env, policy, 2, num_threads=1)
    assert result.returns.shape == (len(env.task.goal_names), 2)
    torch.testing.assert_close(sum(result.terms.values()), result.returns.mean(dim=1), **CLOSE)
    assert set(result.behaviour) == ({"turning"} if name.startswith("anymal") else set())
    assert set(result.task_means) == set(env.task.goal_names)


def test_behaviour_adds_up_over_the_episode_goal_by_goal():
    class Spinning(Measured):
        def behaviour(self, state):
            return {"path": state.qvel[:, 1].abs() * self.control_timestep, "steps": torch.ones(len(state))}

    env = BatchedEnv(Spinning(episode_seconds=1.0), 1, num_threads=1)
    result = evaluate(env, noisy(), 3, num_threads=1)
    torch.testing.assert_close(result.behaviour["steps"], 2 * result.terms["alive"])
    assert set(result.goal_behaviours) == {"right", "left"}
    assert result.goal_behaviours["left"]["path"] == pytest.approx(float(result.behaviour["path"][1]))
    assert result.goal_behaviours["left"]["path"] > 0


class Heavier(CartPole):
    """The pole's mass is drawn for every episode."""

    def randomize(self, simulation, ids, generator):
        simulation.expand("body_mass")[ids, 2] = uniform((0.1, 0.3), len(ids), generator)
        simulation.refresh(ids)


def still(env):
    return TensorDictModule(
        lambda x: torch.zeros(len(x), env.task.action_size), ["observation"], ["action"]
    )  # fmt: skip


def test_randomised_physics_is_drawn_and_is_the_same_for_all_goals():
    env = BatchedEnv(Heavier(), 1, num_threads=1)
    policy = TensorDictModule(lambda x: -0.5 * x[..., 2:], ["observation"], ["action"])
    drawn, nominal = (evaluate(each, policy, 20, num_threads=1).returns for each in (env, "cartpole"))
    assert torch.equal(drawn[0], drawn[1])
    assert (drawn[0] != nominal[0]).all()
    assert torch.equal(drawn, evaluate(env, policy, 20, num_threads=2).returns)
    assert env.simulation.save().keys() == {"rows"}, "the environment itself is not touched"


@pytest.mark.parametrize(
    ("name", "ranges"),
    [
        ("anymal_push", {"friction": (0.5, 1.2), "added_mass": (-2.0, 4.0)}),
        ("anymal_climb", {"friction": (0.5, 1.2), "added_mass": (-2.0, 4.0)}),
        ("trifinger_repose", {"friction": (0.5, 1.5), "cube_mass": (0.06, 0.1)}),
    ],
)
def test_ranges_of_the_tasks_are_evaluated(name, ranges):
    plain, random = (make(name, num_envs=1, episode_seconds=0.5, **kwargs) for kwargs in ({}, ranges))
    found = evaluate(random, still(random), 3, num_threads=1).returns
    assert found.std(dim=1).min() > 0
    torch.testing.assert_close(found, found[:1].expand_as(found), rtol=1e-4, atol=1e-4)
    assert not torch.equal(found, evaluate(plain, still(plain), 3, num_threads=1).returns)


def test_draws_of_a_model_that_is_not_symmetric_itself_are_paired():
    task = create("anymal_push", weak_leg="LF", friction=(0.5, 1.2), episode_seconds=0.1)
    env = BatchedEnv(task, 1, num_threads=1)
    assert torch.isfinite(evaluate(env, still(env), 2, num_threads=1).returns).all()


@pytest.mark.parametrize(
    ("field", "part", "complaint"),
    [
        ("geom_friction", "LF_knee", "got friction that 'reflect-x' changes"),
        ("body_mass", "LF_thigh", "got mass that 'reflect-x' changes"),
        ("dof_damping", "LF_HFE", "got damping that 'reflect-x' changes"),
        ("actuator_gainprm", "LF_HFE", "got actuator gain that 'reflect-x' changes"),
        ("qpos_spring", None, "to draw some of .* got .'qpos_spring'"),
    ],
)
def test_draws_that_have_other_images_are_refused(field, part, complaint):
    task = create("anymal_push", episode_seconds=0.1)
    kind = {"dof": "joint"}.get(field.split("_")[0], field.split("_")[0])
    number = getattr(task.model, kind)(part).id if part else 0
    number = int(task.model.jnt_dofadr[number]) if kind == "joint" else number

    def randomize(simulation, ids, generator):
        for row, factor in zip(ids, uniform((1.1, 1.2), len(ids), generator), strict=True):
            own = simulation.expand(field)[row, number]
            simulation.expand(field)[row, number] = own * factor + 0.1

    task.randomize = randomize
    env = BatchedEnv(task, 1, num_threads=1)
    with pytest.raises(ValueError, match=complaint):
        evaluate(env, still(env), 3, num_threads=1)


def test_draws_that_no_seed_repeats_are_refused():
    task = Heavier()
    task.randomize = lambda simulation, ids, generator: Heavier.randomize(task, simulation, ids, None)
    env = BatchedEnv(task, 1, num_threads=1)
    with pytest.raises(ValueError, match="to draw from its generator alone, got different body_mass"):
        evaluate(env, still(env), 3, num_threads=1)


@pytest.mark.parametrize(
    ("arguments", "error", "complaint"),
    [
        ({"episodes": 0}, ValueError, "expected episodes of at least 1, got 0"),
        ({"episodes": True}, ValueError, "expected episodes of at least 1, got True"),
        ({"episodes": 2.0}, TypeError, "expected episodes to be a whole number, got 2.0"),
        ({"seed": -1}, ValueError, "expected seed of at least 0"),
        ({"seed": None}, TypeError, "expected seed to be a whole number"),
        ({"num_threads": -1}, ValueError, "expected num_threads of at least 0"),
        ({"exploration": "random"}, TypeError, "expected a policy .* and an ExplorationType, .* 'random'"),
        ({"policy": None}, TypeError, "expected a policy to call with a tensordict"),
    ],
)
def test_arguments_of_evaluate_are_checked(arguments, error, complaint):
    with pytest.raises(error, match=complaint):
        evaluate("cartpole", **{"policy": noisy(), "episodes": 2} | arguments)
