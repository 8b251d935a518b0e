"""The recipe's updates: when the rate is adapted, how the deviation is bounded, what is not finite."""

import dataclasses
import functools
import math

import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

import tasks
from tasks.environment import BatchedEnv
from torchrl_sym.recipes import PPOConfig, train
from torchrl_sym.recipes.learner import Learner, estimate_values
from torchrl_sym.recipes.networks import gaussian, make_networks

TINY = PPOConfig(iterations=3, num_envs=8, horizon=16, epochs=2, minibatches=2)
MAKE_ENV = functools.partial(tasks.make_env, "cartpole", num_threads=1)
SYMMETRY = MAKE_ENV(num_envs=1, seed=0).symmetry


def make_learner(config):
    torch.manual_seed(0)
    env = MAKE_ENV(num_envs=config.num_envs, seed=0)
    actor, critic = make_networks(config, env, SYMMETRY)
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):  # of means, no gradient is left
        data = env.rollout(config.horizon, actor)
    return Learner(config, actor, critic, SYMMETRY), data


def test_the_rate_is_adapted_before_the_step_it_is_meant_for(monkeypatch):
    learner, data = make_learner(dataclasses.replace(TINY, desired_kl=1e-6, learning_rate=1e-2))
    events = []
    step, adapt = learner.optimizer.step, learner.schedule.step
    rate = learner.optimizer.param_groups[0]
    monkeypatch.setattr(learner.optimizer, "step", lambda: (events.append(float(rate["lr"])), step()))
    monkeypatch.setattr(learner.schedule, "step", lambda kl: (events.append(float(kl)), adapt(kl)))
    learner.learn(data)
    kl, rates = events[::2], events[1::2]
    expected = [1e-2]  # nothing has changed yet, so the first minibatch leaves the rate about as it is
    for each in kl:
        factor = 1 / 1.5 if each > 2e-6 else 1.5 if 0 < each < 5e-7 else 1.0
        expected.append(min(expected[-1] * factor, TINY.max_learning_rate))
    assert rates == pytest.approx(expected[1:])  # one step late, it would be expected[:-1]
    assert rates[1] < rates[0] and kl[1] > 2e-6


@pytest.mark.parametrize(("start", "bound"), [(0.5, 0.1), (0.01, 0.05)])
def test_a_deviation_beyond_its_bound_is_put_on_it_and_learned_from_there(start, bound):
    config = dataclasses.replace(TINY, min_std=0.05, max_std=0.1, initial_std=0.1, entropy_coeff=0.0)
    learner, _ = make_learner(config)
    policy = learner.policy
    policy.log_std.data.fill_(math.log(start))
    policy.begin(config, 1)
    assert float(policy.log_std.detach().exp()) == pytest.approx(bound)
    inwards = math.copysign(1.0, start - bound)  # descent along this gradient leaves the bound
    before = float(policy.log_std.detach())
    policy.log_std.grad = torch.full_like(policy.log_std, inwards)
    learner.optimizer.step()
    policy.keep_in_bounds()
    assert (before - float(policy.log_std.detach())) * inwards > 0
    # Against the bound, it stays there however long it is pushed, and comes back at once.
    for direction in [-inwards] * 20:
        policy.log_std.grad = torch.full_like(policy.log_std, direction)
        learner.optimizer.step()
        policy.keep_in_bounds()
    assert float(policy.log_std.detach().exp()) == pytest.approx(bound)


def test_the_loss_reaches_a_deviation_at_its_bound():
    config = dataclasses.replace(TINY, max_std=0.5, initial_std=0.5, entropy_coeff=0.5)
    learner, data = make_learner(config)
    learner.learn(data)  # the entropy bonus pushes it against the bound
    assert float(learner.policy.log_std.detach().exp()) == pytest.approx(0.5)
    assert float(learner.policy.log_std.grad.abs().max()) > 0


def test_a_scheduled_deviation_is_the_same_for_all_methods():
    config = dataclasses.replace(TINY, std_schedule=(0.4, 0.1))
    for augmentation in ("none", "all", "random", "naive"):
        each = dataclasses.replace(config, augmentation=augmentation)
        rows = list(train(each, MAKE_ENV, SYMMETRY))
        assert [row["std"] for row in rows] == pytest.approx([0.4, 0.2, 0.1]), augmentation


def test_learned_again_after_a_schedule():
    learner, data = make_learner(dataclasses.replace(TINY, std_schedule=(0.3, 0.3)))
    policy = gaussian(learner.actor)
    policy.begin(dataclasses.replace(TINY, std_schedule=(0.3, 0.3)), 1)
    learner.learn(data)
    assert float(policy.log_std.detach().exp()) == pytest.approx(0.3)
    policy.begin(TINY, 1)
    learner.learn(data)
    assert float(policy.log_std.detach().exp()) != pytest.approx(0.3, abs=1e-6)


class Lost(BatchedEnv):
    """A CartPole whose observation or reward is NaN in its fifth step."""

    where = "observation"

    def _step(self, tensordict):
        out = super()._step(tensordict)
        self.steps = getattr(self, "steps", 0) + 1
        if self.steps == 5:
            out[self.where][2] = math.nan
        return out


@pytest.mark.parametrize(
    ("where", "named"),
    [
        ("observation", r"'observation' of 1 of 128 samples"),
        ("reward", r"\('next', 'reward'\) of 1 of 128"),
    ],
)
def test_what_is_not_finite_is_named_before_it_is_learned_from(where, named, monkeypatch, tmp_path):
    monkeypatch.setattr(Lost, "where", where)

    def make_env(*, num_envs, seed):
        return Lost(MAKE_ENV(num_envs=1).task, num_envs, num_threads=1, seed=seed)

    with pytest.raises(FloatingPointError, match=named):
        train(TINY, make_env, SYMMETRY, folder=tmp_path).run()
    train(TINY, make_env, SYMMETRY, folder=tmp_path).close()  # the folder was given up


@pytest.mark.parametrize("value", [math.inf, math.nan])
def test_a_loss_that_is_not_finite_is_named(value, monkeypatch):
    learner, data = make_learner(TINY)
    loss = learner.losses[0]

    def spoilt(minibatch):
        out = loss(minibatch)
        out["loss_critic"] = out["loss_critic"] * 0 + value  # its gradient is finite, or zero
        return out

    learner.losses[0] = spoilt
    before = [parameter.detach().clone() for parameter in learner.parameters]
    with pytest.raises(FloatingPointError, match=f"'loss_critic': {value}"):
        learner.learn(data)
    assert all(map(torch.equal, before, learner.parameters))


def test_nothing_foreign_is_printed(capfd):
    train(TINY, MAKE_ENV, SYMMETRY).run()
    assert "torchrl" not in "".join(capfd.readouterr())


@pytest.mark.parametrize("steers", [True, False])
def test_a_kl_that_is_not_finite_ends_a_run_only_if_the_rate_follows_it(steers, monkeypatch):
    learner, data = make_learner(dataclasses.replace(TINY, desired_kl=0.01 if steers else None))
    loss = learner.losses[0]

    def spoilt(minibatch):
        out = loss(minibatch)
        out["mean_ratio"] = out["mean_ratio"] + math.inf
        return out

    learner.losses[0] = spoilt
    if steers:
        with pytest.raises(FloatingPointError, match="'kl': inf"):
            learner.learn(data)
    else:
        assert learner.learn(data)["kl"] == math.inf


def test_learning_is_what_torchrl_parts_would_do():
    """The whole update against TorchRL's own estimator and loss, minibatch by minibatch."""
    config = dataclasses.replace(TINY, augmentation="none", desired_kl=None)
    learner, data = make_learner(config)
    other, _ = make_learner(config)
    data = broken_episodes(data)

    torch.manual_seed(1)
    metrics = learner.learn(data.clone())

    torch.manual_seed(1)
    actor, critic = other.actor, other.critic
    GAE(gamma=config.gamma, lmbda=config.lmbda, value_network=critic, average_gae=True)(data)
    loss = ClipPPOLoss(
        actor,
        critic,
        clip_epsilon=config.clip_epsilon,
        clip_value=config.clip_value,
        entropy_coeff=config.entropy_coeff,
        critic_coeff=config.critic_coeff,
        loss_critic_type="l2",
    )
    rows, reports = data.detach().reshape(-1), []
    optimizer = torch.optim.Adam(other.parameters, lr=config.learning_rate)
    for _ in range(config.epochs):
        for index in torch.randperm(len(rows)).chunk(config.minibatches):
            out = loss(rows[index])
            optimizer.zero_grad()
            (out["loss_objective"] + out["loss_critic"] + out["loss_entropy"]).backward()
            torch.nn.utils.clip_grad_norm_(other.parameters, config.max_grad_norm)
            optimizer.step()
            other.policy.keep_in_bounds()
            reports.append(out.detach())
    for mine, theirs in zip(learner.parameters, other.parameters, strict=True):
        torch.testing.assert_close(mine, theirs, rtol=1e-4, atol=1e-6)
    for name in ("loss_objective", "loss_critic", "loss_entropy", "kl_approx", "ESS", "explained_variance"):
        expected = float(torch.stack([report[name] for report in reports]).mean())
        assert metrics[name] == pytest.approx(expected, rel=1e-4, abs=1e-6), name


def broken_episodes(data):
    """The batch as if episodes had ended in it, with true last observations of their own."""
    data = data.clone()
    for row, step, flag in ((1, 5, "truncated"), (2, 0, "terminated"), (3, -1, "truncated")):
        data["next", "done"][row, step] = data["next", flag][row, step] = True
        data["next", "observation"][row, step] += 3.0
    return data


def test_values_of_next_states_take_one_pass():
    learner, data = make_learner(TINY)
    data = broken_episodes(data)
    expected = data.clone()
    GAE(gamma=0.9, lmbda=0.9, value_network=learner.critic)(expected)
    rows = []
    hook = learner.critic.module.register_forward_pre_hook(lambda _, inputs: rows.append(inputs[0]))
    with torch.no_grad():
        estimate_values(learner.critic, data)
    hook.remove()
    for key in ("state_value", ("next", "state_value")):
        torch.testing.assert_close(data[key], expected[key].detach())
    passed = sum(x.shape[:-1].numel() for x in rows)
    assert passed == data.numel() + len(data) + 2  # two episodes ended before the last step


@pytest.mark.parametrize("augmentation", ["none", "all"])
def test_bfloat16_products_change_updates_a_little(augmentation):
    config = dataclasses.replace(TINY, augmentation=augmentation, epochs=1, minibatches=1, desired_kl=None)
    changes = []
    for autocast in (None, "bfloat16"):
        learner, data = make_learner(dataclasses.replace(config, autocast=autocast))
        learner.learn(data)
        changes.append(torch.cat([p.grad.flatten() for p in learner.parameters]))
        assert all(p.dtype == torch.float32 for p in learner.parameters)
    exact, rough = changes
    error = float((exact - rough).norm() / exact.norm())
    assert 1e-5 < error < 0.1


def test_compiled_losses_have_the_same_gradients(monkeypatch):
    # the graph without the C++ of it, which another test compiles and which takes half a minute
    monkeypatch.setattr(torch, "compile", functools.partial(torch.compile, backend="aot_eager"))
    config = dataclasses.replace(TINY, epochs=1, minibatches=1)
    gradients = []
    for compile_ in (False, True):
        learner, data = make_learner(dataclasses.replace(config, compile=compile_))
        learner.learn(data)
        gradients.append([parameter.grad for parameter in learner.parameters])
    for plain, compiled in zip(*gradients, strict=True):
        torch.testing.assert_close(plain, compiled, rtol=1e-4, atol=1e-6)


def test_without_a_compiler_training_goes_on_with_a_warning(monkeypatch):
    def broken(function):
        def fail(*args):
            raise RuntimeError("no working C++ compiler found")

        return fail

    monkeypatch.setattr(torch, "compile", broken)
    with pytest.warns(RuntimeWarning, match="no working C.. compiler found.; install a C.. compiler"):
        learner, data = make_learner(dataclasses.replace(TINY, compile=True))
    assert math.isfinite(learner.learn(data)["kl"])


def test_compilation_may_change_when_a_run_is_continued_and_precision_not():
    stored = dataclasses.asdict(TINY)
    assert dataclasses.replace(TINY, compile=True).differences(stored) == {}
    rough = dataclasses.replace(TINY, autocast="bfloat16")
    assert rough.differences(stored) == {"autocast": (None, "bfloat16")}
    with pytest.raises(ValueError, match=r"autocast: expected one of \['bfloat16'\], got 'float16'"):
        dataclasses.replace(TINY, autocast="float16")
    with pytest.raises(TypeError, match="compile: expected True or False, got 'yes'"):
        dataclasses.replace(TINY, compile="yes")
