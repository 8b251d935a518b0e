"""SymmetricVecNorm: a VecNormV2 in every respect but its statistics, which every element leaves."""

import copy

import pytest
import torch
from tensordict import TensorDict
from torchrl.data import Composite, LazyTensorStorage, ReplayBuffer, Unbounded
from torchrl.envs import EnvBase, EnvCreator, ParallelEnv, TransformedEnv, VecNormV2

from torchrl_sym import PointGroup, SymmetricVecNorm, Symmetry
from torchrl_sym.representations import axial, polar, scalar

pytestmark = pytest.mark.filterwarnings("ignore:Support of .*VecNorm")

GROUP = PointGroup.dihedral(3)
BODY = polar(GROUP) + axial(GROUP) + scalar(GROUP)
VELOCITY = ("agent", "velocity")
SYMMETRY = Symmetry(GROUP, {"observation": BODY, VELOCITY: polar(GROUP), "action": polar(GROUP)})
TRIVIAL = PointGroup.trivial()


class Drift(EnvBase):
    """Observations that are neither centred nor symmetric; the same for every environment of a seed."""

    def __init__(self, batch_size=(), dtype=torch.float32, seed=0):
        super().__init__(batch_size=batch_size)
        self.observation_spec = Composite(
            observation=Unbounded((*batch_size, BODY.dim), dtype=dtype), shape=batch_size
        )
        self.action_spec = Unbounded((*batch_size, 3))
        self.reward_spec = Unbounded((*batch_size, 1))
        self.generator = torch.Generator().manual_seed(seed)

    def _observe(self):
        x = torch.randn(*self.batch_size, BODY.dim, generator=self.generator, dtype=torch.float64)
        x = x * torch.linspace(0.1, 3, BODY.dim) + torch.arange(BODY.dim)
        dtype = self.observation_spec["observation"].dtype
        return TensorDict(observation=x.to(dtype), batch_size=self.batch_size)

    def _reset(self, tensordict=None, **kwargs):
        return self._observe()

    def _step(self, tensordict):
        done = torch.zeros(*self.batch_size, 1, dtype=torch.bool)
        return self._observe().update({"reward": done + 5.0, "done": done})

    def _set_seed(self, seed):
        pass


def normalised(*args, symmetry=SYMMETRY, batch_size=(), **kwargs):
    norm = SymmetricVecNorm(*args, symmetry=symmetry, **kwargs)
    return TransformedEnv(Drift(batch_size), norm), norm


def raw(steps, batch_size=()):
    """What `normalised` has seen in a rollout of so many steps."""
    rollout = Drift(batch_size).rollout(steps)
    return torch.cat([rollout["observation"][..., :1, :], rollout["next", "observation"]], -2).double()


@pytest.mark.parametrize("batch", [(), (4,)])
def test_statistics_are_those_of_all_images(batch):
    env, norm = normalised(["observation"], batch_size=batch, decay=1.0, reduce_batch_dims=True)
    env.rollout(50)
    data = raw(50, batch).reshape(-1, BODY.dim)
    orbit = BODY.orbit(data).flatten(0, 1)
    torch.testing.assert_close(norm.loc["observation"].double(), orbit.mean(0), rtol=1e-5, atol=1e-5)
    variance = orbit.var(0, correction=0)
    mixed, turned = (variance[i : i + 2].mean().expand(2) for i in (0, 3))  # x and y of the two vectors
    expected = torch.cat([mixed, variance[2:3], turned, variance[5:]])
    torch.testing.assert_close(norm.scale["observation"].double(), expected.sqrt(), rtol=1e-5, atol=1e-5)


def test_commutes_while_it_learns():
    """Every call updates the statistics, by a state or by its image."""
    env, norm = normalised(["observation"])
    env.rollout(5)
    x = torch.randn(BODY.dim) * 3 + 1
    results = []
    for g in range(GROUP.order):
        copied = copy.deepcopy(norm.clone())
        results.append(copied(TensorDict(observation=BODY(x, g)))["observation"])
    expected = BODY.orbit(results[0])
    torch.testing.assert_close(torch.stack(results), expected, rtol=1e-4, atol=1e-4)


def test_without_a_group_it_is_vecnormv2():
    symmetry = Symmetry(TRIVIAL, {"observation": scalar(TRIVIAL) * BODY.dim})
    env, norm = normalised(["observation", "reward"], symmetry=symmetry, decay=1.0)
    other = TransformedEnv(Drift(), VecNormV2(["observation", "reward"], decay=1.0))
    ours, theirs = env.rollout(40), other.rollout(40)
    for key in ("observation", "reward"):
        torch.testing.assert_close(norm.loc[key], other.transform.loc[key])
        torch.testing.assert_close(norm.scale[key], other.transform.scale[key], rtol=1e-3, atol=1e-3)
    torch.testing.assert_close(
        ours["next", "observation"][5:], theirs["next", "observation"][5:], rtol=1e-2, atol=1e-2
    )
    assert set(ours.keys(True, True)) == set(theirs.keys(True, True))
    assert env.observation_spec == other.observation_spec


@pytest.mark.parametrize("decay", [0.9, 0.9999])
def test_decay_weighs_recent_steps_more_and_has_no_bias_of_the_start(decay):
    symmetry = Symmetry(TRIVIAL, {"observation": scalar(TRIVIAL) * BODY.dim})
    env, norm = normalised(["observation"], symmetry=symmetry, decay=decay)
    env.rollout(30)
    data = raw(30)
    weights = decay ** torch.arange(len(data)).flip(0).double()
    weights /= weights.sum()
    mean = weights @ data
    variance = weights @ (data - mean) ** 2
    torch.testing.assert_close(norm.loc["observation"].double(), mean, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(norm.scale["observation"].double(), variance.sqrt(), rtol=1e-4, atol=1e-5)


def test_frozen_copied_and_converted():
    env, norm = normalised(["observation"])
    env.rollout(20)
    frozen, before = norm.frozen_copy(), norm.loc["observation"].clone()
    constants = norm.to_observation_norm()
    env.rollout(5)
    assert not torch.equal(norm.loc["observation"], before)
    assert torch.equal(frozen.loc["observation"], before)
    norm.freeze()
    at = norm.loc["observation"].clone()
    env.rollout(5)
    assert torch.equal(norm.loc["observation"], at)

    x = torch.randn(BODY.dim)
    results = [t(TensorDict(observation=x))["observation"] for t in (frozen, constants)]
    torch.testing.assert_close(*results)
    back = norm.denorm(norm(TensorDict(observation=x)))["observation"]
    torch.testing.assert_close(back, x)
    SYMMETRY.check_specs(TransformedEnv(Drift(), constants))
    SYMMETRY.check_specs(TransformedEnv(Drift(), frozen))


def test_state_dict():
    env, norm = normalised(["observation"])
    env.rollout(20)
    other_env, other = normalised(["observation"])
    other_env.load_state_dict(env.state_dict())
    assert torch.equal(other.loc["observation"], norm.loc["observation"])
    assert torch.equal(other.scale["observation"], norm.scale["observation"])


def test_replay_buffer_normalises_both_times_by_one_statistic():
    norm = SymmetricVecNorm(["observation"], symmetry=SYMMETRY, decay=1.0)
    buffer = ReplayBuffer(storage=LazyTensorStorage(64), batch_size=64, transform=norm)
    data = Drift().rollout(64)
    buffer.extend(data)
    buffer.sample()  # which updates
    norm.freeze()
    loc, scale = norm.loc["observation"], norm.scale["observation"]
    for key in ("observation", ("next", "observation")):
        torch.testing.assert_close(buffer[:][key], (data[key] - loc) / scale)
    assert torch.equal(norm.loc["observation"], loc)


def test_half_precision():
    env = TransformedEnv(Drift(dtype=torch.bfloat16), SymmetricVecNorm(["observation"], symmetry=SYMMETRY))
    rollout = env.rollout(300)
    assert rollout["observation"].dtype == torch.bfloat16
    reference, norm = normalised(["observation"])
    reference.rollout(300)
    before = env.transform.loc["observation"]
    env.transform.bfloat16()
    loc = env.transform.loc["observation"]
    assert torch.equal(loc, before)
    assert loc.dtype == torch.float32
    torch.testing.assert_close(loc, norm.loc["observation"], rtol=2e-3, atol=2e-3)


def test_nested_keys_and_names_of_the_output():
    names = ["velocity", "normal"]
    norm = SymmetricVecNorm([VELOCITY, "observation"], names, symmetry=SYMMETRY, reduce_batch_dims=True)
    agent = TensorDict(velocity=torch.randn(9, 3), batch_size=[9])
    td = TensorDict(agent=agent, observation=torch.randn(9, 7), batch_size=[9])
    out = norm(td.clone())
    assert torch.equal(out["observation"], td["observation"])
    assert out["velocity"].shape == (9, 3)
    torch.testing.assert_close(out["normal"][:, 6].std(correction=0), torch.tensor(1.0))


def make_worker():
    return normalised(["observation"])[0]


def test_shared_by_the_workers_of_a_parallel_environment():
    make = EnvCreator(make_worker)
    local = make()
    env = ParallelEnv(2, make, mp_start_method="fork")
    try:
        SYMMETRY.check_specs(env)
        start = int(local.transform._count["observation"])
        env.rollout(10)
        count = int(local.transform._count["observation"]) - start
    finally:
        env.close()
    assert count >= 20
    loc = local.transform.loc["observation"]
    torch.testing.assert_close(loc, BODY.orbit(loc).mean(0), rtol=1e-5, atol=1e-6)
    assert loc[6] > 1  # the scalar's mean, which nothing cancels


def test_malformed():
    with pytest.raises(KeyError, match=r"SymmetricVecNorm reads \['lidar'\]"):
        SymmetricVecNorm(["lidar"], symmetry=SYMMETRY)
    with pytest.raises(TypeError, match="symmetry: expected Symmetry"):
        SymmetricVecNorm(["observation"], symmetry=GROUP)
    with pytest.raises(TypeError, match="in_keys: expected a sequence of keys"):
        SymmetricVecNorm("observation", symmetry=SYMMETRY)
    with pytest.raises(ValueError, match="out_keys: expected one for each"):
        SymmetricVecNorm(["observation"], ["a", "b"], symmetry=SYMMETRY)
    for name, value in (("decay", 1.5), ("eps", 0.0)):
        with pytest.raises(ValueError, match=name):
            SymmetricVecNorm(["observation"], symmetry=SYMMETRY, **{name: value})
    with pytest.raises(ValueError, match="last dimension"):
        SymmetricVecNorm(["observation"], symmetry=SYMMETRY)(TensorDict(observation=torch.ones(5)))
