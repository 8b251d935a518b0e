"""SymmetricClipPPOLoss against Eq. (sym-aug): worked out by hand, and against ClipPPOLoss on copies."""

import math

import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import LazyTensorStorage, ReplayBuffer
from torchrl.data.replay_buffers.samplers import SamplerWithoutReplacement
from torchrl.modules import IndependentNormal, ProbabilisticActor, TanhNormal
from torchrl.objectives import ClipPPOLoss, ValueEstimators
from torchrl.objectives.value import GAE

from tests.networks import (
    GROUPS,
    SYMMETRIC,
    add_transitions,
    gradients,
    make_actor,
    make_batch,
    make_critic,
    make_symmetry,
    near_policy,
    total,
    unbiased,
)
from torchrl_sym import MirrorLoss, PointGroup, SymmetricClipPPOLoss, Symmetry, SymmetryAugment
from torchrl_sym.representations import pseudoscalar

SURROGATE_AND_VALUE = ["loss_objective", "loss_critic"]
DIAGNOSTICS = ["kl_approx", "clip_fraction", "ESS", "entropy", "max_ratio", "mean_ratio"]

OPTIONS = {
    "defaults": {},
    "clip_value": {"clip_value": 0.2},
    "normalize_advantage": {"normalize_advantage": True},
    "max_importance_ratio": {"max_importance_ratio": 1.1},
    "asymmetric clip": {"clip_epsilon": (0.1, 0.3)},
    "delay_actor": {"delay_actor": True},
    "no entropy": {"entropy_bonus": False},
    "sum": {"reduction": "sum"},
    "none": {"reduction": "none"},
}
# Standardising N * B rows divides by another sample deviation than standardising B rows.
SAME_ON_COPIES = [name for name in OPTIONS if name != "normalize_advantage"]


def setup(*size, distribution=IndependentNormal):
    actor, critic = make_actor(distribution), make_critic()
    batch = near_policy(make_batch(*size, bound=1.9), actor)
    return actor, critic, batch


# --- equality with ClipPPOLoss --------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore:No target network updater")  # delay_actor
@pytest.mark.parametrize("distribution", [IndependentNormal, TanhNormal])
@pytest.mark.parametrize("elements", ["all", "random"])
@pytest.mark.parametrize("size", [(12,), (4, 3)])
@pytest.mark.parametrize("option", OPTIONS)
def test_trivial_group_is_clip_ppo_to_the_last_bit(option, size, elements, distribution):
    actor, critic, batch = setup(*size, distribution=distribution)
    symmetry = make_symmetry("C1")
    base = ClipPPOLoss(actor, critic, **OPTIONS[option])
    ours = SymmetricClipPPOLoss(actor, critic, symmetry=symmetry, elements=elements, **OPTIONS[option])
    torch.manual_seed(0)  # the entropy of a TanhNormal is estimated by sampling
    expected = base(batch)
    torch.manual_seed(0)
    found = ours(batch)
    for key, value in expected.items():
        assert torch.equal(found[key], value), key
    torch.manual_seed(0)
    expected = gradients(base, batch, [actor, critic])
    torch.manual_seed(0)
    assert torch.equal(gradients(ours, batch, [actor, critic]), expected)
    assert expected.abs().max() > 1e-3


@pytest.mark.filterwarnings("ignore:No target network updater")
@pytest.mark.parametrize("size", [(12,), (4, 3)])
@pytest.mark.parametrize("option", SAME_ON_COPIES)
@pytest.mark.parametrize("group", SYMMETRIC)
def test_equals_clip_ppo_on_the_augmented_batch(group, option, size):
    actor, critic, batch = setup(*size)
    symmetry = make_symmetry(group)
    base = ClipPPOLoss(actor, critic, **OPTIONS[option])
    ours = SymmetricClipPPOLoss(actor, critic, symmetry=symmetry, **OPTIONS[option])
    augmented = SymmetryAugment(symmetry)(batch)
    expected, found = base(augmented), ours(batch)
    for key in [*SURROGATE_AND_VALUE, "explained_variance"]:
        torch.testing.assert_close(found[key], expected[key])
    torch.testing.assert_close(
        gradients(ours, batch, [actor, critic], SURROGATE_AND_VALUE),
        gradients(base, augmented, [actor, critic], SURROGATE_AND_VALUE),
    )


def test_tanh_normal_with_a_symmetric_box_equals_clip_ppo_on_the_augmented_batch():
    actor, critic, batch = setup(distribution=TanhNormal)
    symmetry = make_symmetry("K4")
    augmented = SymmetryAugment(symmetry)(batch)
    expected = ClipPPOLoss(actor, critic)(augmented)
    found = SymmetricClipPPOLoss(actor, critic, symmetry=symmetry)(batch)
    for key in SURROGATE_AND_VALUE:
        torch.testing.assert_close(found[key], expected[key])


@pytest.mark.parametrize("names", [["reflect-x"], ["identity", "rot-180"], ["rot-180", "reflect-y"]])
def test_named_elements(names):
    actor, critic, batch = setup()
    symmetry = make_symmetry("K4")
    augmented = SymmetryAugment(symmetry, elements=names)(batch)
    expected = ClipPPOLoss(actor, critic)(augmented)
    found = SymmetricClipPPOLoss(actor, critic, symmetry=symmetry, elements=names)(batch)
    assert len(augmented) == len(batch) * len({"identity", *names}) == len(batch) * len(found["ESS_sym"])
    for key in SURROGATE_AND_VALUE:
        torch.testing.assert_close(found[key], expected[key])


# --- Eq. (sym-aug) by hand ------------------------------------------------------------------------


class LinearGaussian(nn.Module):
    """a ~ N(w s + c, 1)."""

    def __init__(self, w, c):
        super().__init__()
        self.w = nn.Parameter(torch.tensor(w, dtype=torch.float64))
        self.c = nn.Parameter(torch.tensor(c, dtype=torch.float64))

    def forward(self, s):
        return self.w * s + self.c, torch.ones_like(s)


class TwoSided(LinearGaussian):
    """a ~ N(w s, 1) where s > 0 and N(c s, 1) where s < 0: states and mirrored states are apart."""

    def forward(self, s):
        return torch.where(s > 0, self.w * s, self.c * s), torch.ones_like(s)


def one_dimensional(net, states, actions, minus_log_prob, advantages, **kwargs):
    """A loss for s -> -s, a -> -a, and its batch; log-probabilities without - log(2 pi) / 2."""
    group = PointGroup.reflection("x")
    odd = pseudoscalar(group)
    actor = ProbabilisticActor(
        TensorDictModule(net, ["observation"], ["loc", "scale"]),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )
    loss = SymmetricClipPPOLoss(
        actor, symmetry=Symmetry(group, {"observation": odd, "action": odd}), entropy_coeff=0.0, **kwargs
    )

    def column(x):
        return torch.tensor(x, dtype=torch.float64).unsqueeze(-1)

    batch = TensorDict(
        observation=column(states),
        action=column(actions),
        action_log_prob=-column(minus_log_prob).squeeze(-1) - math.log(2 * math.pi) / 2,
        advantage=column(advantages),
        batch_size=[len(states)],
    )
    return loss, batch


def test_three_rows_by_hand():
    # pi = N(s / 2 + 1/4, 1). With e = a - mean, log ratio = q - e^2 / 2 where q = -log pi_k(a|s) - ...
    net = LinearGaussian(0.5, 0.25)
    loss, batch = one_dimensional(net, [1, -1, 2], [1, 0.5, 2], [0.1, 0.5, 0.5], [1, -2, 0.5])
    # originals: e = 1/4, 3/4, 3/4;       log ratio =  0.06875,  0.21875,  0.21875 (log 1.2 = 0.18232)
    # copies:    e = -3/4, -5/4, -5/4;    log ratio = -0.18125, -0.28125, -0.28125 (log 0.8 = -0.22314)
    r1, r2, r1g, r3g = map(math.exp, (0.06875, 0.21875, -0.18125, -0.28125))
    gain = [1 * r1, -2 * r2, 0.5 * 1.2, 1 * r1g, -2 * 0.8, 0.5 * r3g]  # row 3 and copy 2 are clipped
    # TorchRL keeps log 1.2 and log 0.8 in single precision
    assert loss(batch)["loss_objective"].item() == pytest.approx(-sum(gain) / 6, abs=1e-7)
    # grad = ratio A e (s, 1) for what is not clipped
    terms = [(r1 * 0.25, 1), (-2 * r2 * 0.75, -1), (r1g * -0.75, -1), (0.5 * r3g * -1.25, -2)]
    expected = [-sum(x * s for x, s in terms) / 6, -sum(x for x, _ in terms) / 6]
    loss(batch)["loss_objective"].backward()
    assert [net.w.grad.item(), net.c.grad.item()] == pytest.approx(expected, abs=1e-12)


def test_denominators_are_the_original_probabilities():
    """A change of pi on mirrored states only changes the numerators of the copies."""
    net = TwoSided(0.5, 0.5)
    states, actions = [0.5, 1.0, 2.0], [0.2, 0.4, 1.5]
    # A = -1 and a wide clip make each row of the loss its ratio
    loss, batch = one_dimensional(
        net, states, actions, [0.3, 0.2, 0.1], [-1] * 3, reduction="none", clip_epsilon=0.99
    )
    before = loss(batch)["loss_objective"].detach()
    net.c.data.fill_(0.8)
    after = loss(batch)["loss_objective"].detach()

    def log_pi(mean, a):
        return -((a - mean) ** 2) / 2

    change = [
        math.exp(log_pi(-0.8 * s, -a) - log_pi(-0.5 * s, -a)) for s, a in zip(states, actions, strict=True)
    ]
    assert torch.equal(after[:3], before[:3])
    assert (after[3:] / before[3:]).tolist() == pytest.approx(change)
    batch["action_log_prob"] += 0.1  # every denominator, of originals and copies
    torch.testing.assert_close(loss(batch)["loss_objective"], after * math.exp(-0.1))


# --- diagnostics ----------------------------------------------------------------------------------


def drawn_elements(symmetry, batch, **kwargs):
    """A loss with random elements, one output of it, and the elements it drew, read off its input."""
    actor, critic = make_actor(), make_critic()
    seen = []
    hook = actor[0].module[0].register_forward_pre_hook(lambda _, args: seen.append(args[0].detach()))
    loss = SymmetricClipPPOLoss(
        actor, critic, symmetry=symmetry, elements="random", functional=False, **kwargs
    )
    out = loss(batch)
    hook.remove()
    images = symmetry["observation"].orbit(batch["observation"])
    element = (images - seen[0]).abs().sum(-1).argmin(0)
    assert len(element.unique()) == symmetry.group.order
    return out, element


@pytest.mark.parametrize("size", [(12,), (4, 3)])
@pytest.mark.parametrize("group", SYMMETRIC)
def test_diagnostics_and_entropy_are_those_of_the_originals(group, size):
    actor, critic, batch = setup(*size)
    symmetry, base = make_symmetry(group), ClipPPOLoss(actor, critic)
    found = SymmetricClipPPOLoss(actor, critic, symmetry=symmetry)(batch)
    expected, mixed = base(batch), base(SymmetryAugment(symmetry)(batch))
    for key in [*DIAGNOSTICS, "loss_entropy"]:
        torch.testing.assert_close(found[key], expected[key], msg=lambda m, key=key: f"{key}: {m}")
    assert (mixed["kl_approx"] - expected["kl_approx"]).abs() > 0.1  # asymmetric enough to tell


@pytest.mark.parametrize("group", ["C2", "D3"])
def test_random_diagnostics_are_those_of_the_rows_that_drew_the_identity(group):
    torch.manual_seed(7)
    actor, critic, batch = setup(48)
    found, element = drawn_elements(make_symmetry(group), batch)
    expected = ClipPPOLoss(actor, critic)(batch[element == 0])
    for key in [*DIAGNOSTICS, "loss_entropy"]:
        torch.testing.assert_close(found[key], expected[key], msg=lambda m, key=key: f"{key}: {m}")


def assert_per_element(found, batches):
    actor, critic = make_actor(), make_critic()
    base = ClipPPOLoss(actor, critic)
    for g, mapped in enumerate(batches):
        expected = base(mapped)
        for key in ("kl_approx", "clip_fraction", "ESS"):
            torch.testing.assert_close(found[f"{key}_sym"][g], expected[key], msg=f"{key} of {g}")


@pytest.mark.parametrize("group", SYMMETRIC)
def test_diagnostics_per_element(group):
    actor, critic, batch = setup(48)
    symmetry = make_symmetry(group)
    found = SymmetricClipPPOLoss(actor, critic, symmetry=symmetry)(batch)
    assert_per_element(found, [symmetry(batch, g) for g in range(symmetry.group.order)])
    in_time = SymmetricClipPPOLoss(actor, critic, symmetry=symmetry)(batch.reshape(12, 4))
    assert_per_element(in_time, [symmetry(batch, g) for g in range(symmetry.group.order)])
    found, element = drawn_elements(symmetry, batch)
    assert_per_element(found, [symmetry(batch[element == g], g) for g in range(symmetry.group.order)])


# --- placement, random elements, mirror term, advantages ------------------------------------------


def trained(make_loss, transform, batch, steps=12):
    """Gradients of every step and final parameters of a small training run from a replay buffer."""
    actor, critic = make_actor(), make_critic()
    loss = make_loss(actor, critic)
    buffer = ReplayBuffer(
        storage=LazyTensorStorage(len(batch)), sampler=SamplerWithoutReplacement(), batch_size=8
    )
    if transform is not None:
        buffer.append_transform(transform)
    buffer.extend(batch)
    parameters = [*actor.parameters(), *critic.parameters()]
    optimizer, history = torch.optim.Adam(parameters, lr=1e-2), []
    torch.manual_seed(11)
    for _ in range(steps):
        optimizer.zero_grad()
        total(loss(buffer.sample())).backward()
        history.append(torch.cat([p.grad.flatten() for p in parameters]))
        optimizer.step()
    return torch.stack(history), torch.cat([p.detach().flatten() for p in parameters])


@pytest.mark.parametrize("group", ["K4", "C3"])
def test_placement_in_the_buffer_or_in_the_loss_is_the_same(group):
    _, _, batch = setup(24)
    symmetry, options = make_symmetry(group), {"entropy_bonus": False, "clip_value": 0.2}
    inside = trained(lambda a, c: SymmetricClipPPOLoss(a, c, symmetry=symmetry, **options), None, batch)
    outside = trained(lambda a, c: ClipPPOLoss(a, c, **options), SymmetryAugment(symmetry), batch)
    plain = trained(lambda a, c: ClipPPOLoss(a, c, **options), None, batch)
    torch.testing.assert_close(inside, outside, rtol=1e-9, atol=1e-11)
    assert (inside[1] - plain[1]).abs().max() > 1e-2


@pytest.mark.parametrize(("group", "part"), [("K4", "C2"), ("D3", "C3")])
def test_random_elements_are_unbiased(group, part):
    actor, critic = make_actor(asymmetry=1.0), make_critic()  # ratios without heavy tails
    batch = near_policy(make_batch(24), actor)

    def loss(elements, group, mirror_coeff=1.0):
        return SymmetricClipPPOLoss(
            actor, critic, symmetry=make_symmetry(group), elements=elements, mirror_coeff=mirror_coeff
        )

    def draws(*args):
        torch.manual_seed(13)
        random = loss("random", *args)
        return torch.stack([gradients(random, batch, [actor, critic]) for _ in range(400)])

    full = gradients(loss("all", group), batch, [actor, critic])
    accepted, z = unbiased(draws(group), full)
    assert accepted, z.abs().max()
    assert 0.2 < z.pow(2).mean() < 4.0  # about the spread that chance gives to correlated scores
    for biased in ((part,), (group, 0.75)):  # draws from half of the group; a mirror term too small
        accepted, z = unbiased(draws(*biased), full)
        assert not accepted


@pytest.mark.parametrize("size", [(12,), (4, 3)])
@pytest.mark.parametrize("group", SYMMETRIC)
def test_mirror_term_is_the_mirror_loss(group, size):
    actor, critic, batch = setup(*size)
    symmetry = make_symmetry(group)
    mirror = MirrorLoss(actor, symmetry=symmetry, coeff=0.3)
    ours = SymmetricClipPPOLoss(actor, critic, symmetry=symmetry, mirror_coeff=0.3)
    without = SymmetricClipPPOLoss(actor, critic, symmetry=symmetry)(batch)
    found = ours(batch)
    torch.testing.assert_close(found["loss_mirror"], mirror(batch)["loss_mirror"])
    torch.testing.assert_close(
        gradients(ours, batch, [actor], ["loss_mirror"]), gradients(mirror, batch, [actor])
    )
    assert "loss_mirror" not in without
    for key, value in without.items():
        assert torch.equal(found[key], value), key


def test_mirror_term_sums_over_named_elements():
    actor, critic, batch = setup()
    full = MirrorLoss(actor, symmetry=make_symmetry("K4"), per_element=True)(batch)["mirror_error"]
    ours = SymmetricClipPPOLoss(
        actor, critic, symmetry=make_symmetry("K4"), elements=["rot-180"], mirror_coeff=2.0
    )
    index = GROUPS["K4"].index("rot-180")
    torch.testing.assert_close(ours(batch)["loss_mirror"].detach(), 2.0 * full[index])


def test_advantages_are_estimated_on_the_originals():
    actor, critic, batch = setup(4, 6)
    symmetry, batch = make_symmetry("K4"), add_transitions(batch)
    ours = SymmetricClipPPOLoss(actor, critic, symmetry=symmetry, gamma=None)
    base = ClipPPOLoss(actor, critic)
    for loss in (ours, base):
        loss.make_value_estimator(ValueEstimators.GAE, gamma=0.9, lmbda=0.8)
    estimated = GAE(gamma=0.9, lmbda=0.8, value_network=critic)(batch.copy())
    found, expected = ours(batch), base(SymmetryAugment(symmetry)(estimated))
    wrong = base(SymmetryAugment(symmetry)(batch))  # values of copies, by an asymmetric critic
    for key in SURROGATE_AND_VALUE:
        torch.testing.assert_close(found[key], expected[key])
        assert (found[key] - wrong[key]).abs() > 1e-3


def test_advantages_are_normalised_on_the_originals():
    actor, critic, batch = setup()
    symmetry, advantage = make_symmetry("C3"), batch["advantage"]
    normal = batch.copy().set("advantage", (advantage - advantage.mean()) / advantage.std())
    found = SymmetricClipPPOLoss(actor, critic, symmetry=symmetry, normalize_advantage=True)(batch)
    expected = SymmetricClipPPOLoss(actor, critic, symmetry=symmetry)(normal)
    torch.testing.assert_close(found["loss_objective"], expected["loss_objective"])
