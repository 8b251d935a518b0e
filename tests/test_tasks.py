"""Every registered task: contracts of the batched environment, and the mathematics of its symmetry."""

import functools
import pickle

import mujoco
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torchrl.collectors import Collector
from torchrl.envs import ParallelEnv, SerialEnv
from torchrl.envs.utils import check_env_specs

import tasks
from tasks import base
from tasks.cartpole import CartPole
from tasks.environment import BatchedEnv
from tasks.evaluation import Evaluation, evaluate
from tasks.state import State, concatenate
from torchrl_sym import Symmetry
from torchrl_sym.representations import invariant

# The largest error of a mirrored step against the step of the mirror. Exactly zero where the group
# only flips signs; contacts and rotations round.
TOLERANCE = {"cartpole": 0.0}

all_tasks = pytest.mark.parametrize("name", tasks.ALL_TASKS)
all_elements = pytest.mark.parametrize(
    ("name", "g"),
    [(name, g) for name in tasks.ALL_TASKS for g in range(base.create(name).symmetry.group.order)],
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


# -- the environment's contract ---------------------------------------------------------------------


@all_tasks
def test_specs(name):
    env = make(name, num_envs=3)
    check_env_specs(env, break_when_any_done="both", seed=0)
    assert env.batch_size == (3,)
    assert env.observation_spec["observation"].shape == (3, env.task.observation_size)
    assert env.action_spec.shape == (3, env.task.action_size)
    assert env.reward_spec.shape == (3, 1)
    assert env.observation_spec["observation"].dtype == env.reward_spec.dtype == torch.float32
    env.symmetry.check_specs(env)
    assert len(env.task.goal_names) == env.symmetry.group.order


@all_tasks
def test_seed_decides_everything_and_threads_nothing(name):
    def trajectory(seed, num_threads=1):
        env = tasks.make_env(name, num_envs=5, num_threads=num_threads, seed=seed, episode_seconds=0.2)
        return play(env, env.reset(), actions(env, 25))

    first = trajectory(1)
    assert_same(first, trajectory(1))
    assert_same(first, trajectory(1, num_threads=2))
    assert_same(first, trajectory(1, num_threads=3))
    other = trajectory(2)
    assert not torch.equal(first["observation"], other["observation"])
    env = make(name, num_envs=5, seed=7, episode_seconds=0.2)
    env.set_seed(1)
    assert_same(first, play(env, env.reset(), actions(env, 25)))


@all_tasks
def test_starts_differ_between_rows_and_resets(name):
    env = make(name, num_envs=8)
    first, second = (env.reset()["observation"] for _ in range(2))
    assert len(first.unique(dim=0)) == 8
    assert not (first == second).all(dim=-1).any()


@all_tasks
def test_unseeded_environments_follow_torchs_global_seed(name):
    def start(seed):
        torch.manual_seed(seed)
        return make(name, seed=None).reset()["observation"]

    assert torch.equal(start(0), start(0))
    assert not torch.equal(start(0), start(1))


@all_tasks
def test_partial_reset_touches_only_its_rows(name):
    env = make(name)
    tensordict = env.rollout(3)[:, -1]["next"].exclude("reward")
    before = env.simulation.save()["rows"]
    mask = torch.tensor([False, True, False, True])
    tensordict["_reset"] = mask[:, None]
    after = env.reset(tensordict)["observation"]
    rows = env.simulation.save()["rows"]
    assert torch.equal(rows[~mask], before[~mask])
    assert (rows[mask] != before[mask]).any(dim=-1).all()
    assert torch.equal(after, env.task.observe(env.state).float())
    assert env.state.time[mask].tolist() == [0.0, 0.0]
    assert (env.state.time[~mask] > 0).all()


@all_tasks
def test_time_limit_truncates_with_the_true_last_observation(name):
    env = make(name, num_envs=3, episode_seconds=0.2)
    steps = env.task.max_steps
    batch = play(env, env.reset(), 0.1 * actions(env, steps + 2))["next"]
    truncated = batch["truncated"].squeeze(-1)
    assert truncated[steps - 1].all()
    assert truncated.sum() == 3
    assert torch.equal(batch["done"], batch["terminated"] | batch["truncated"])
    # The same physics without a limit goes through the same state instead of a new start.
    free = make(name, num_envs=3)
    expected = play(free, free.reset(), 0.1 * actions(env, steps + 2))
    assert torch.equal(batch["observation"][:steps], expected["next", "observation"][:steps])
    new_start = play(env, env.reset(), 0.1 * actions(env, steps + 1))["observation"][steps]
    assert not torch.equal(new_start, expected["observation"][steps])


@all_tasks
def test_rows_that_end_at_different_times_are_reset_on_their_own(name):
    env = make(name, num_envs=6, episode_seconds=1.0)
    batch = play(env, stagger(env), 0.1 * actions(env, 60))
    ends = batch["next", "done"].squeeze(-1)
    assert (ends.sum(0) >= 1).all()
    assert ends.any(-1).sum() >= 5, "expected the rows to end in different steps"


@all_tasks
def test_outputs_do_not_alias_the_simulation(name):
    env = make(name)
    first = env.reset()
    step = env.step(first.clone().set("action", actions(env, 1)[0]))
    kept = [first.clone(), step.clone()]
    play(env, step["next"].select("observation", "done", "terminated"), actions(env, 5))
    env.reset()
    assert_same(first, kept[0])
    assert_same(step, kept[1])


@all_tasks
def test_rollout_until_all_are_done_freezes_finished_rows(name):
    env = make(name, num_envs=3, episode_seconds=0.5)
    rollout = env.rollout(
        100, tensordict=stagger(env), auto_reset=False, break_when_all_done=True,
        break_when_any_done=False,
    )  # fmt: skip
    assert rollout["next", "done"][:, -1].all()
    limit = env.task.episode_seconds
    assert (env.state.time <= limit + 1e-9).all(), "a finished row was stepped"


@all_tasks
@pytest.mark.parametrize("wrapper", [SerialEnv, ParallelEnv])
def test_under_serial_and_parallel_env(name, wrapper):
    create = functools.partial(tasks.make_env, name, num_envs=3, num_threads=1, seed=0)
    pickle.loads(pickle.dumps(create))
    env = wrapper(2, create)
    try:
        env.set_seed(0)
        rollout = env.rollout(4)
        assert rollout.batch_size == (2, 3, 4)
        assert rollout["next", "observation"].isfinite().all()
    finally:
        env.close()


@all_tasks
def test_extreme_states_and_actions_stay_finite(name):
    env = make(name, num_envs=6)
    env.reset()
    state = env.state
    state.qvel[:3] *= 1e3
    state.qvel[1] += 500.0
    state.qvel[2] -= 1e7
    env.reset_to(state)
    for action in actions(env, 30, scale=100.0):
        out = env.step(TensorDict(action=action, batch_size=env.batch_size))["next"]
        for key in ("observation", "reward"):
            assert out[key].isfinite().all(), key


# -- divergence -------------------------------------------------------------------------------------


def nan_action(env, action):
    action[1] = torch.nan


def huge_velocity(env, action):
    env.simulation.qvel[1, -1] = 1e7


def nan_position(env, action):
    env.simulation.qpos[1, -1] = torch.nan


@all_tasks
@pytest.mark.parametrize("poison", [nan_action, huge_velocity, nan_position])
def test_divergence_ends_one_episode_and_nothing_else(name, poison, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes its warnings to a log file where it runs
    env, healthy = make(name, num_envs=3), make(name, num_envs=3)
    sequence = 0.1 * actions(env, 5)
    poisoned = sequence.clone()
    start, expected = env.reset(), healthy.reset()
    poison(env, poisoned[0])
    out, after = env.step_and_maybe_reset(start.set("action", poisoned[0]))
    reference, expected = healthy.step_and_maybe_reset(expected.set("action", sequence[0]))
    assert env.num_diverged == 1
    assert out["next", "terminated"].squeeze(-1).tolist() == [False, True, False]
    assert out["next", "reward"][1] == 0
    assert after["observation"].isfinite().all()
    for key in ("observation", "reward"):
        assert out["next", key].isfinite().all()
    others = torch.tensor([0, 2])
    assert_same(out[others], reference[others])
    batch, reference = play(env, after, sequence[1:]), play(healthy, expected, sequence[1:])
    assert batch["next", "observation"].isfinite().all()
    assert_same(batch[:, others], reference[:, others])
    assert env.num_diverged == 1


class Falling(CartPole):
    """Ends with reward 7 where the pole comes close to hanging; 1 for every other step."""

    def reward(self, state, action):
        return torch.where(self.terminated(state), 7.0, 1.0)

    def terminated(self, state):
        return self.observe(state)[:, 1].abs() > 0.75


def test_a_diverged_row_earns_nothing():
    env = BatchedEnv(Falling(), 3, num_threads=1, seed=0)
    td = env.reset().set("action", torch.tensor([[0.0], [torch.nan], [0.0]]))
    assert env.step(td)["next", "reward"].squeeze(-1).tolist() == [1.0, 0.0, 1.0]


def test_termination_is_not_truncation():
    env = BatchedEnv(Falling(), 4, num_threads=1, seed=0)
    batch = play(env, env.reset(), torch.zeros(60, 4, 1))["next"]
    ended = batch["reward"] == 7
    assert ended.any()
    assert torch.equal(batch["terminated"], ended)
    assert torch.equal(batch["done"], ended)
    assert not batch["truncated"].any()


# -- saving -----------------------------------------------------------------------------------------


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
    with pytest.raises(ValueError, match=r"saved rows of shape \(3, .*got \(4, "):
        make(name, num_envs=3).restore_state(make(name, num_envs=4).save_state())
    with pytest.raises(ValueError, match=r"expected a state of 3 rows.*got 2"):
        env = make(name, num_envs=3)
        env.reset_to(env.task.sample_goal_state(2, None))


# -- symmetry ---------------------------------------------------------------------------------------


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


@all_elements
def test_step_observation_and_reward_commute_with_the_group(name, g):
    task = base.create(name)
    assert equivariance_error(task, task.symmetry, g) <= TOLERANCE[name]


@all_tasks
def test_the_group_acts_on_states(name):
    task = base.create(name)
    group = task.symmetry.group
    state = task.sample_initial_state(8, torch.Generator().manual_seed(0))
    for g in range(group.order):
        for h in range(group.order):
            product = task.transform_state(task.transform_state(state, h), g)
            direct = task.transform_state(state, int(group.table[g, h]))
            torch.testing.assert_close(product.qpos, direct.qpos, rtol=0, atol=1e-12)
            torch.testing.assert_close(product.qvel, direct.qvel, rtol=0, atol=1e-12)
        by_name = task.transform_state(state, group.names[g])
        by_row = task.transform_state(state, torch.full((8,), g))
        for image in (by_name, by_row):
            assert torch.equal(image.qpos, task.transform_state(state, g).qpos)
    assert torch.equal(task.transform_state(state, 0).qpos, state.qpos)


@all_tasks
def test_sampling_leaves_the_states_it_is_given_alone(name):
    task = base.create(name)
    state = task.sample_initial_state(4, torch.Generator().manual_seed(0))
    kept = state.clone()
    for g in range(task.symmetry.group.order):
        task.transform_state(state, g).qpos[:] = 9.0
    task.observe(state)
    task.reward(state, torch.zeros(4, task.action_size))
    assert torch.equal(state.qpos, kept.qpos) and torch.equal(state.qvel, kept.qvel)


class WrongVelocity(CartPole):
    """Mirrors the positions but forgets the velocities."""

    def transform_state(self, state, g):
        image = super().transform_state(state, g)
        return State(image.qpos, state.qvel.clone(), time=image.time)


class HalfOpenAngle(CartPole):
    """Rewards only a pole on the right: breaks the symmetry of the reward."""

    def reward(self, state, action):
        return super().reward(state, action) * (state.qpos[:, 1] > 0)


class OneSidedCart(CartPole):
    """A cart that is faster to the right: breaks the symmetry of the dynamics."""

    def control(self, action, state):
        control = super().control(action, state)
        return torch.where(control > 0, 1.001 * control, control)


@pytest.mark.parametrize("broken", [WrongVelocity, HalfOpenAngle, OneSidedCart])
def test_a_broken_symmetry_is_caught(broken):
    task = broken()
    assert equivariance_error(task, task.symmetry, "reflect-x") > 1e-4


@pytest.mark.parametrize("key", ["observation", "action"])
def test_a_wrong_representation_is_caught(key):
    task = CartPole()
    group = task.symmetry.group
    right = {k: task.symmetry[k] for k in ("observation", "action")}
    wrong = Symmetry(group, right | {key: invariant(group, right[key].dim)})
    assert equivariance_error(task, wrong, "reflect-x") > 1e-2


# -- CartPole in numbers ----------------------------------------------------------------------------


def cartpole_state(angle, velocity=(0.0, 0.0)):
    angle = torch.as_tensor(angle, dtype=torch.float64).reshape(-1)
    qpos = torch.stack([torch.zeros_like(angle), angle], dim=-1)
    return State(qpos, torch.tensor([velocity], dtype=torch.float64).expand(len(angle), 2))


def test_cartpole_has_the_papers_sizes_and_the_chosen_physics():
    task = CartPole()
    assert (task.observation_size, task.action_size) == (3, 1)
    assert task.symmetry.group.names == ("identity", "reflect-x")
    assert (task.substeps, task.max_steps) == (1, 200)
    option = task.model.opt
    assert option.timestep == 0.02
    assert option.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    assert option.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    assert option.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT
    assert task.model.body("cart").mass == 1.0
    assert task.model.body("pole").mass == pytest.approx(0.1)
    assert not task.model.jnt_limited.any()


def test_cartpole_observation_and_reward_by_hand():
    task = CartPole()
    state = cartpole_state([0.5, -3.0], velocity=(1.5, -4.0))
    expected = torch.tensor([[0.5, 0.5 / torch.pi, -0.4], [0.5, -3.0 / torch.pi, -0.4]])
    torch.testing.assert_close(task.observe(state).float(), expected)
    reward = task.reward(state, torch.zeros(2, 1))
    torch.testing.assert_close(reward.float(), torch.tensor([-0.01, -0.06]))


def test_cartpole_angle_is_wrapped_by_an_odd_function():
    task = CartPole()
    angle = torch.cat([torch.linspace(-40, 40, 4001), torch.arange(-9, 10) * torch.pi]).double()
    observed, mirrored = (task.observe(cartpole_state(s * angle))[:, 1] for s in (1, -1))
    assert torch.equal(observed, -mirrored)
    assert observed.abs().max() <= 1
    turns = (angle / torch.pi - observed) / 2
    torch.testing.assert_close(turns, turns.round(), rtol=0, atol=1e-7)
    assert task.observe(cartpole_state(3.5))[0, 1].item() == pytest.approx(3.5 / torch.pi - 2)


def test_cartpole_starts_flat_on_either_side_with_equal_chance():
    task = CartPole()
    n = 20_000
    start = task.sample_initial_state(n, torch.Generator().manual_seed(0))
    right = start.qpos[:, 1] > 0
    assert right.double().mean() == pytest.approx(0.5, abs=0.02)
    noise = torch.stack([start.qpos[:, 1].abs() - torch.pi / 2, *start.qvel.unbind(-1)])
    assert noise.abs().max() <= 0.1
    torch.testing.assert_close(noise.std(dim=1), torch.full((3,), 0.1 / 3**0.5).double(), rtol=0.02, atol=0)
    assert start.qpos[:, 0].abs().max() == 0
    canonical = task.sample_goal_state(100, None)
    assert (canonical.qpos[:, 1] > 1).all(), "the canonical goal is called right"


def test_cartpole_follows_the_clipped_desired_velocity():
    env = make("cartpole", num_envs=3)
    env.reset()
    for _ in range(25):
        out = env.step(TensorDict(action=torch.tensor([[0.5], [1.0], [7.0]]), batch_size=[3]))
    velocity = out["next", "observation"][:, 0] * 3
    assert velocity[0] == pytest.approx(1.5, abs=0.1)
    assert velocity[1] == pytest.approx(3.0, abs=0.1)
    state = env.task.control(torch.tensor([[7.0], [-9.0], [torch.nan]]), env.state)
    assert state[:2].squeeze(-1).tolist() == [3.0, -3.0]
    assert state[2].isnan()


# -- evaluation -------------------------------------------------------------------------------------


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


# -- names, registration, errors --------------------------------------------------------------------


def test_public_names():
    assert tasks.__all__ == ["ALL_TASKS", "load", "make_env"]
    assert "cartpole" in tasks.ALL_TASKS
    assert base.registered() == tasks.ALL_TASKS
    assert callable(tasks.load)
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        tasks.nothing  # noqa: B018


@pytest.mark.parametrize("function", [tasks.make_env, tasks.load])
def test_unknown_names_list_the_known_ones(function):
    with pytest.raises(KeyError, match=r"\['cartpole'.*'cartpol'.*did you mean 'cartpole'"):
        function("cartpol")
    with pytest.raises(TypeError, match=r"\['episode_seconds'\].*\['gravity'\]"):
        function("cartpole", gravity=3.0)
    with pytest.raises(ValueError, match="at least one control step"):
        function("cartpole", episode_seconds=0.001)


def test_a_name_is_registered_once():
    with pytest.raises(ValueError, match="'cartpole', which CartPole has"):
        base.register(CartPole)


def test_a_task_that_contradicts_itself_is_refused():
    class ThreeGoals(CartPole):
        goal_names = ("a", "b", "c")

    class FourNumbers(CartPole):
        observation_size = 4

    class OddTimestep(CartPole):
        control_timestep = 0.03

    with pytest.raises(ValueError, match=r"one goal name per group element.*\['a', 'b', 'c'\]"):
        BatchedEnv(ThreeGoals(), 2)
    with pytest.raises(ValueError, match="observation"):
        BatchedEnv(FourNumbers(), 2)
    with pytest.raises(ValueError, match=r"multiple of the model's timestep 0.02 s, got 0.03"):
        OddTimestep()


def test_evaluate_needs_a_task():
    with pytest.raises(TypeError, match="expected a BatchedEnv or a task name, got int"):
        evaluate(3, lambda td: td)


def test_missing_asset_lists_the_files():
    with pytest.raises(FileNotFoundError, match=r"'nothing.xml'.*cartpole.xml"):
        base.load_model("nothing.xml")


# -- what later tasks need: variables, curriculum, randomisation --------------------------------------


class Memory(CartPole):
    """CartPole with a last action, a target, a curriculum level per row and a random pole mass."""

    def __init__(self):
        super().__init__(episode_seconds=0.1)
        self.seen = 0

    def sample_goal_state(self, n, generator):
        state = super().sample_goal_state(n, generator)
        state.variables = {"last_action": torch.zeros(n, 1), "level": torch.zeros(n)}
        return state

    def transform_state(self, state, g):
        image = super().transform_state(state, g)
        action = self.symmetry["action"](state.variables["last_action"], g)
        image.variables = state.variables | {"last_action": action}
        return image

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
    assert env.state.variables["level"].tolist() == [1.0] * 3
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
