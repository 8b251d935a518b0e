"""The PPO recipe: what it reports, that it learns from symmetric copies, and that nothing is lost."""

import dataclasses
import functools
import time
from pathlib import Path

import pytest
import torch
from torchrl.envs import GymEnv, SerialEnv

import tasks
from tests.launch import Script
from torchrl_sym import MirrorLoss, PointGroup, Symmetry
from torchrl_sym.recipes import PPOConfig, RunFolder, load_actor, read_metrics, train
from torchrl_sym.recipes.metrics import Episodes, symmetry_metrics
from torchrl_sym.recipes.networks import make_networks
from torchrl_sym.recipes.table import TIMING
from torchrl_sym.representations import pseudoscalar, scalar

TINY = PPOConfig(iterations=4, num_envs=8, horizon=16, epochs=2, minibatches=2)
MAKE_ENV = functools.partial(tasks.make_env, "cartpole", num_threads=1)


@pytest.fixture(scope="module")
def symmetry() -> Symmetry:
    return MAKE_ENV(num_envs=1, seed=0).symmetry


def deterministic(rows: list[dict[str, float]]) -> list[dict[str, str]]:
    """Rows without the columns that tell the time; as text, so that nan equals nan."""
    return [{key: str(value) for key, value in row.items() if key not in TIMING} for row in rows]


@pytest.mark.parametrize("augmentation", ["none", "all", "random", "naive"])
@pytest.mark.parametrize("mirror_coeff", [0.0, 0.5])
def test_every_method_trains_and_reports(symmetry, augmentation, mirror_coeff):
    config = dataclasses.replace(TINY, augmentation=augmentation, mirror_coeff=mirror_coeff)
    rows = list(train(config, MAKE_ENV, symmetry))
    assert [row["iteration"] for row in rows] == [1, 2, 3, 4]
    assert [row["frames"] for row in rows] == [128, 256, 384, 512]
    for key in ("kl", "mirror_loss", "log_prob", "log_prob_copies", "loss_critic", "entropy"):
        assert all(torch.tensor(row[key]).isfinite() for row in rows), key
    before = [0.0, *(row["seconds"] for row in rows)]
    for row, start in zip(rows, before, strict=False):
        assert 0 < row["physics_seconds"] < row["collect_seconds"] < row["seconds"] - start + 0.5


def test_methods_differ(symmetry):
    last = {}
    for augmentation in ("none", "all", "random", "naive"):
        config = dataclasses.replace(TINY, augmentation=augmentation)
        last[augmentation] = list(train(config, MAKE_ENV, symmetry))[-1]["mirror_loss"]
    assert len(set(last.values())) == 4


def test_same_seed_same_run_other_seed_other_run(symmetry):
    first = deterministic(list(train(TINY, MAKE_ENV, symmetry)))
    assert first == deterministic(list(train(TINY, MAKE_ENV, symmetry)))
    other = dataclasses.replace(TINY, seed=1)
    assert first != deterministic(list(train(other, MAKE_ENV, symmetry)))


def test_mirror_loss_falls_when_it_is_trained(symmetry):
    config = dataclasses.replace(TINY, iterations=20, augmentation="none", weight_scale=2.0)
    without = list(train(config, MAKE_ENV, symmetry))[-1]["mirror_loss"]
    with_loss = list(train(dataclasses.replace(config, mirror_coeff=10.0), MAKE_ENV, symmetry))
    assert with_loss[-1]["mirror_loss"] < 0.1 * min(without, with_loss[0]["mirror_loss"])


def test_interrupted_run_continues_exactly(symmetry, tmp_path):
    whole = list(train(TINY, MAKE_ENV, symmetry, folder=tmp_path / "whole"))
    for rows, _ in zip(train(TINY, MAKE_ENV, symmetry, folder=tmp_path / "cut"), range(2), strict=False):
        assert rows["iteration"] <= 3
    rest = list(train(TINY, MAKE_ENV, symmetry, folder=tmp_path / "cut"))
    assert 0 < len(rest) < len(whole)
    stored = read_metrics(tmp_path / "cut" / "metrics.csv")
    assert deterministic(stored) == deterministic(whole)
    assert_same_parts(tmp_path / "whole", tmp_path / "cut")


def test_a_field_added_later_counts_as_its_default():
    stored = dataclasses.asdict(TINY)
    del stored["adapt_every"]
    assert TINY.differences(stored) == {}
    changed = dataclasses.replace(TINY, adapt_every="iteration")
    assert changed.differences(stored) == {"adapt_every": ("minibatch", "iteration")}


def test_learning_rate_adapted_once_per_iteration(symmetry):
    config = dataclasses.replace(TINY, desired_kl=1e-9, learning_rate=1e-3)
    slow = [
        row["learning_rate"]
        for row in train(dataclasses.replace(config, adapt_every="iteration"), MAKE_ENV, symmetry)
    ]
    assert slow == pytest.approx([1e-3 / 1.5**k for k in (1, 2, 3, 4)])
    fast = [row["learning_rate"] for row in train(config, MAKE_ENV, symmetry)]
    assert fast[0] < slow[0] / 1.5


def test_a_run_starts_from_another_one(symmetry, tmp_path):
    first, second = tmp_path / "first", tmp_path / "second"
    list(train(TINY, MAKE_ENV, symmetry, folder=first))
    frozen = dataclasses.replace(
        TINY, iterations=2, entropy_coeff=0.1, desired_kl=None, max_grad_norm=1e-12
    )
    rows = list(train(frozen, MAKE_ENV, symmetry, folder=second, start_from=first))
    assert [row["iteration"] for row in rows] == [1, 2]
    old, new = (RunFolder(folder).load() for folder in (first, second))
    drift = [(new["parts"]["actor"][k] - x).abs().max() for k, x in old["parts"]["actor"].items()]
    fresh = dict(make_networks(TINY, MAKE_ENV(num_envs=1), symmetry)[0].state_dict())
    reset = [(fresh[k] - x).abs().max() for k, x in old["parts"]["actor"].items()]
    assert max(drift) < 0.1 * max(reset)
    # Interrupted, it goes on from its own checkpoint.
    longer = dataclasses.replace(frozen, iterations=3)
    assert len(list(train(longer, MAKE_ENV, symmetry, folder=second, start_from=first))) == 1
    with pytest.raises(FileNotFoundError, match=r"to start from, found \[\]"):
        list(train(TINY, MAKE_ENV, symmetry, start_from=tmp_path / "nothing"))


def test_episodes_go_on_where_a_run_starts_from_another_one(symmetry, tmp_path):
    first, second = tmp_path / "first", tmp_path / "second"
    whole = dataclasses.replace(TINY, horizon=410, iterations=1, epochs=1)  # an episode has 200 steps
    list(train(whole, MAKE_ENV, symmetry, folder=first))
    short = dataclasses.replace(whole, horizon=4)
    (row,) = train(short, MAKE_ENV, symmetry, folder=second, start_from=first)
    old, new = (RunFolder(folder).load()["episodes"] for folder in (first, second))
    assert old["whole"].all() and new["whole"].all()
    assert (new["running"] != 0).all() and (new["running"] - old["running"]).abs().max() < 4.0
    assert row["return"] == old["latest"], "no episode ended"


SCRIPT = """
import functools, sys, torch
torch.set_num_threads(1)
import tasks
from torchrl_sym.recipes import PPOConfig, train
make_env = functools.partial(tasks.make_env, "cartpole", num_threads=1)
config = PPOConfig(iterations=60, num_envs=8, horizon=8, epochs=1, minibatches=1, checkpoint_interval=7)
for _ in train(config, make_env, make_env(num_envs=1).symmetry, folder=sys.argv[1]):
    pass
"""


def test_run_killed_at_a_random_time_continues_exactly(tmp_path):
    def start(name: str) -> Script:
        return Script(SCRIPT, tmp_path / name)

    assert start("whole").wait().returncode == 0
    victim = start("killed")
    table = tmp_path / "killed" / "metrics.csv"
    while not table.exists() or len(table.read_text().splitlines()) < 10:
        assert victim.process.is_alive()
        time.sleep(0.001)
    time.sleep(0.2 * torch.rand(()).item())
    victim.kill()
    assert len(read_metrics(table)) < 60, "the run ended before it was killed"
    assert start("killed").wait().returncode == 0
    whole, killed = (read_metrics(tmp_path / name / "metrics.csv") for name in ("whole", "killed"))
    assert deterministic(killed) == deterministic(whole)
    assert_same_parts(tmp_path / "whole", tmp_path / "killed")


def assert_same_parts(first: Path, second: Path) -> None:
    """Networks and optimizer of two runs agree to the last bit; both load with weights_only=True."""
    a, b = (torch.load(folder / "checkpoint.pt", weights_only=True) for folder in (first, second))
    assert a["iteration"] == b["iteration"]
    for part in ("actor", "critic"):
        for name, value in a["parts"][part].items():
            assert torch.equal(value, b["parts"][part][name]), f"{part}.{name}"
    assert str(a["parts"]["optimizer"]) == str(b["parts"]["optimizer"])


def test_finished_run_is_not_repeated(symmetry, tmp_path):
    list(train(TINY, MAKE_ENV, symmetry, folder=tmp_path))
    assert list(train(TINY, MAKE_ENV, symmetry, folder=tmp_path)) == []
    longer = dataclasses.replace(TINY, iterations=6)
    assert [row["iteration"] for row in train(longer, MAKE_ENV, symmetry, folder=tmp_path)] == [5, 6]


def test_other_configuration_in_the_folder_is_refused(symmetry, tmp_path):
    list(train(TINY, MAKE_ENV, symmetry, folder=tmp_path))
    with pytest.raises(ValueError, match=r"another configuration.*gamma.*0\.98.*0\.9"):
        list(train(dataclasses.replace(TINY, gamma=0.9), MAKE_ENV, symmetry, folder=tmp_path))


def test_load_actor_is_the_trained_actor(symmetry, tmp_path):
    list(train(TINY, MAKE_ENV, symmetry, folder=tmp_path))
    env = MAKE_ENV(num_envs=3, seed=5)
    actor = load_actor(tmp_path, env, symmetry)
    stored = torch.load(tmp_path / "checkpoint.pt", weights_only=True)["parts"]["actor"]
    assert all(torch.equal(value, stored[name]) for name, value in actor.state_dict().items())
    assert actor(env.reset())["action"].shape == (3, 1)
    with pytest.raises(FileNotFoundError, match="train there first"):
        load_actor(tmp_path / "nowhere", env, symmetry)


def test_tensorboard_logger(symmetry, tmp_path):
    pytest.importorskip("tensorboard")
    list(train(TINY, MAKE_ENV, symmetry, folder=tmp_path, logger="tensorboard"))
    assert list(tmp_path.rglob("events.out.tfevents.*"))
    with pytest.raises(ValueError, match="expected logger 'csv', 'tensorboard' or 'wandb'"):
        list(train(TINY, MAKE_ENV, symmetry, logger="paper"))


@pytest.mark.parametrize("count", [1, 2])
def test_other_environments_train_too(count):
    pytest.importorskip("gymnasium")
    group = PointGroup.reflection("y")
    same, sign = scalar(group), pseudoscalar(group)
    pendulum = Symmetry(group, {"observation": same + sign * 2, "action": sign})

    def make_env(*, num_envs: int, seed: int):
        env = GymEnv("Pendulum-v1") if num_envs == 1 else SerialEnv(num_envs, lambda: GymEnv("Pendulum-v1"))
        env.set_seed(seed)
        return env

    config = dataclasses.replace(TINY, num_envs=count, horizon=64)
    rows = list(train(config, make_env, pendulum))
    assert rows[-1]["frames"] == 4 * 64 * count


def test_symmetry_that_does_not_fit_is_refused():
    group = PointGroup.reflection("x")
    sign = pseudoscalar(group)
    with pytest.raises(ValueError, match=r"expected event dimensions \(2,\)"):
        list(train(TINY, MAKE_ENV, Symmetry(group, {"observation": sign * 2, "action": sign})))
    with pytest.raises(KeyError, match="observation"):
        list(train(TINY, MAKE_ENV, Symmetry(group, {"state": sign * 3, "action": sign})))


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("augmentation", "both"),
        ("iterations", 0),
        ("minibatches", 3),
        ("gamma", 1.5),
        ("learning_rate", float("nan")),
        ("mirror_coeff", -1.0),
    ],
)
def test_bad_configuration_is_named(field, value):
    with pytest.raises(ValueError, match=f"^{field}: expected"):
        dataclasses.replace(TINY, **{field: value})


def test_symmetry_metrics_of_an_equivariant_policy(symmetry):
    env = MAKE_ENV(num_envs=8, seed=0)
    actor, _ = make_networks(dataclasses.replace(TINY, hidden=()), env, symmetry)
    with torch.no_grad():  # without hidden layers and bias the policy is linear, hence odd
        [parameter.zero_() for name, parameter in actor.named_parameters() if name.endswith("bias")]
        data = env.rollout(5, actor)
    metrics = symmetry_metrics(actor, symmetry, data)
    assert metrics["mirror_loss"] < 1e-12
    assert metrics["log_prob"] == pytest.approx(metrics["log_prob_copies"], abs=1e-6)


def test_symmetry_metrics_are_the_mirror_loss_and_the_copies_probabilities(symmetry):
    env = MAKE_ENV(num_envs=8, seed=0)
    actor, _ = make_networks(TINY, env, symmetry)
    with torch.no_grad():
        data = env.rollout(5, actor)
        expected = float(MirrorLoss(actor, symmetry=symmetry)(data)["loss_mirror"])
        mirrored = symmetry(data.select("observation", "action"), "reflect-x")
        copies = actor.get_dist(mirrored.select("observation")).log_prob(mirrored["action"])
    metrics = symmetry_metrics(actor, symmetry, data)
    assert expected > 1e-4
    assert metrics["mirror_loss"] == pytest.approx(expected, rel=1e-5)
    assert metrics["log_prob"] == pytest.approx(float(data["action_log_prob"].mean()), rel=1e-5)
    assert metrics["log_prob_copies"] == pytest.approx(float(copies.mean()), rel=1e-5)


def test_episode_returns_cross_batches_and_leave_out_the_first():
    env = MAKE_ENV(num_envs=2, seed=0)
    episodes = Episodes(env)
    data = env.rollout(4, break_when_any_done=False)
    data["next", "reward"][:] = 1.0
    data["next", "done"][:] = False
    data["next", "done"][0, 1] = True
    assert torch.tensor(episodes.update(data)).isnan()  # row 0 ended its first episode, row 1 nothing
    assert episodes.update(data) == 4.0  # row 0 again: two steps of the last batch and two of this


def test_training_starts_at_all_phases(symmetry):
    made = []

    def make_env(**kwargs):
        made.append(MAKE_ENV(**kwargs))
        return made[-1]

    next(iter(train(dataclasses.replace(TINY, num_envs=64), make_env, symmetry)))
    assert made[0].state.time.unique().numel() > 32
