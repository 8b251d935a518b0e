"""Copies of recurrent policies: exact, burnt in, or refused.

All ratios of an equivariant policy are 1 if its copies begin with the image of the stored memory; the
copies of an ordinary one are those of a loop written by hand.
"""

import pytest
import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import (
    NormalParamExtractor,
    TensorDictModule,
    TensorDictModuleBase,
    TensorDictSequential,
)
from torch import Tensor, nn
from torchrl.modules import GRUModule, IndependentNormal, LSTMModule, ProbabilisticActor, recurrent_mode
from torchrl.objectives import ClipPPOLoss

from tests.recurrent import (
    CUT,
    EPISODE,
    EXACT,
    GROUP,
    MASK,
    SIGN,
    SWAP,
    UNITS,
    by_hand,
    episodes,
    make_critic,
    make_loss,
    make_policy,
    make_symmetry,
    sliced,
)
from torchrl_sym import MirrorLoss, PointGroup, SymmetricClipPPOLoss, Symmetry
from torchrl_sym.memory import Memory, _require, memory_keys, reset_keys
from torchrl_sym.representations import invariant

kinds = pytest.mark.parametrize("kind", [GRUModule, LSTMModule])
elements = pytest.mark.parametrize("elements", ["all", "random"])


@kinds
@elements
@pytest.mark.parametrize("name", EXACT)
def test_an_unchanged_equivariant_policy_has_ratios_of_one(kind, elements, name):
    batch = EXACT[name](kind, True)
    policy = make_policy(kind, True)
    for equivariant in (True, False):  # images of what is stored, memory rebuilt from zero: the same
        out = make_loss(policy, equivariant, elements=elements, mirror_coeff=1.0)(batch)
        torch.testing.assert_close(out["loss_objective"], torch.tensor(-1.0))
        torch.testing.assert_close(out["loss_mirror"], torch.tensor(0.0))
        if MASK not in batch.keys(True):
            torch.testing.assert_close(out["kl_approx_sym"], torch.zeros(2), atol=1e-6, rtol=0)


@kinds
@elements
@pytest.mark.parametrize("name", CUT)
def test_an_equivariant_memory_is_mapped_wherever_a_sequence_begins(kind, elements, name):
    batch, policy = CUT[name](kind, True), make_policy(kind, True)
    assert batch[memory_keys(policy)[0]].reshape(*batch.shape, -1)[..., 0, :].any()
    out = make_loss(policy, True, elements=elements, mirror_coeff=1.0)(batch)
    torch.testing.assert_close(out["loss_objective"], torch.tensor(-1.0))
    torch.testing.assert_close(out["kl_approx_sym"], torch.zeros(2), atol=1e-6, rtol=0)
    torch.testing.assert_close(out["loss_mirror"], torch.tensor(0.0))
    mirror = MirrorLoss(policy, symmetry=make_symmetry(policy, SWAP))
    torch.testing.assert_close(mirror(batch)["loss_mirror"], torch.tensor(0.0))


@kinds
@pytest.mark.parametrize("name", CUT)
def test_other_memory_cannot_begin_within_an_episode(kind, name):
    batch, policy = CUT[name](kind, False), make_policy(kind)
    for loss in (make_loss(policy), make_loss(policy, elements="random")):
        with pytest.raises(ValueError, match=r"not zero.*reset_at_each_iter.*burn_in=k.*equivariant"):
            loss(batch)
    with pytest.raises(ValueError, match="not zero"):
        MirrorLoss(policy, symmetry=make_symmetry(policy, invariant(GROUP, UNITS)))(batch)
    with pytest.raises(ValueError, match="or without one"):
        make_loss(policy)(batch.exclude(*memory_keys(policy)))


@kinds
@pytest.mark.parametrize("name", ["reset", "stored", "reshaped slices", "first of a collector"])
def test_copies_of_an_ordinary_network_rebuild_their_memory(kind, name):
    batch, policy = EXACT[name](kind, False), make_policy(kind)
    right = (batch["action_log_prob"] - by_hand(policy, batch)).mean()
    assert right.abs() > 1e-4
    kl = make_loss(policy)(batch)["kl_approx_sym"]
    torch.testing.assert_close(kl, torch.stack([torch.zeros(()), right]), atol=1e-6, rtol=1e-4)


@kinds
@pytest.mark.parametrize("name", ["continued", "reshaped slices"])
def test_a_burn_in_counts_the_steps_after_it(kind, name):
    batch, policy = CUT[name](kind, False), make_policy(kind)
    before = batch.clone()
    age = torch.zeros(batch.shape, dtype=torch.int64)
    exact = torch.zeros(batch.shape, dtype=torch.bool)
    for t in range(batch.shape[1]):
        empty = (batch[memory_keys(policy)[0]][:, t] == 0).flatten(1).all(1)
        start = batch["is_init"][:, t, 0] if t else torch.ones(len(batch), dtype=torch.bool)
        age[:, t] = 0 if t == 0 else torch.where(start, 0, age[:, t - 1] + 1)
        exact[:, t] = empty if t == 0 else torch.where(start, empty, exact[:, t - 1])
    counts = exact | (age >= 2)
    assert counts.any() and not counts.all()

    ratio = (by_hand(policy, batch) - batch["action_log_prob"]).exp()
    valid = torch.rand(batch.shape, generator=torch.Generator().manual_seed(0)) < 0.8
    for mask in (None, valid, valid.unsqueeze(-1)):
        counted = counts if mask is None else counts & valid
        given = batch if mask is None else batch.clone().set(MASK, mask)
        out = make_loss(policy, burn_in=2, clip_epsilon=0.99)(given)
        torch.testing.assert_close(out["loss_objective"], -(1 + ratio[counted].mean()) / 2)
    make_loss(policy)(batch.clone().set(MASK, exact))  # what the loss leaves out need not be right
    assert (batch == before).all()

    mirror = MirrorLoss(policy, symmetry=make_symmetry(policy, invariant(GROUP, UNITS)), burn_in=2)
    changed = batch.clone()
    changed["observation"][~counts & (torch.arange(batch.shape[1]) == batch.shape[1] - 1)] += 5.0
    torch.testing.assert_close(mirror(batch)["loss_mirror"], mirror(changed)["loss_mirror"])


def test_a_burn_in_that_leaves_nothing_is_refused():
    policy = make_policy()
    batch = CUT["continued"](GRUModule, False)[:, :2]
    with pytest.raises(ValueError, match="burn_in=2 leaves no step"):
        make_loss(policy, burn_in=2)(batch[~batch["is_init"].flatten(1).any(1)])
    loss = make_loss(policy, burn_in=1)
    loss.loss_mask_key = None
    with pytest.raises(ValueError, match="loss_mask_key"):
        loss(batch)
    with pytest.raises(ValueError, match=r"burn_in: expected 0.*no network has a memory"):
        make_loss(policy, True, burn_in=1)
    with pytest.raises(ValueError, match="burn_in"):
        make_loss(policy, burn_in=-1)


def test_a_memory_has_to_be_declared():
    policy = make_policy(LSTMModule)
    symmetry = Symmetry(GROUP, {"observation": SIGN * 3, "action": SIGN})
    for build in (
        lambda: MirrorLoss(policy, symmetry=symmetry),
        lambda: SymmetricClipPPOLoss(policy, make_critic(), symmetry=symmetry),
    ):
        with pytest.raises(KeyError, match=r"recurrent_state_h.*recurrent_state_c.*invariant\(group, d\)"):
            build()


def test_one_element_is_drawn_from_start_to_start():
    policy = make_policy()
    memory = Memory.of(make_symmetry(policy, invariant(GROUP, UNITS)), [policy])
    batch = episodes(GRUModule, False).repeat(50, 1)
    element = memory.draw(make_symmetry(policy, SWAP), batch)
    starts = batch["is_init"][..., 0]
    changes = element[:, 1:] != element[:, :-1]
    assert not changes[~starts[:, 1:]].any()
    assert 0.3 < changes[starts[:, 1:]].float().mean() < 0.7
    assert 0.3 < element[:, 0].float().mean() < 0.7


def test_a_batch_of_time_only_is_one_sequence():
    policy, batch = make_policy(), episodes(GRUModule, False)
    loss = make_loss(policy)
    flat, one = loss(batch[0]), loss(batch[:1])
    for key in sorted(flat.keys()):
        torch.testing.assert_close(flat[key], one[key])
    with pytest.raises(ValueError, match=r"sequences \[B, T\].*unsqueeze"):
        loss(batch[0].exclude("next", "collector"))
    with pytest.raises(ValueError, match="runs on into another"):
        loss(sliced(GRUModule, False, EPISODE, init_key=None).set("is_init", torch.zeros(30, 1).bool()))


def test_samples_without_order_are_refused():
    policy = make_policy()
    rows = episodes(GRUModule, False).reshape(-1)
    rows = rows[torch.cat([torch.zeros(1, dtype=torch.int64), torch.randperm(len(rows))])]
    for loss in (make_loss(policy), make_loss(policy, burn_in=1)):
        with pytest.raises(ValueError, match=r"runs on into another"):
            loss(rows)


def test_without_copies_nothing_changes():
    policy, batch = make_policy(), CUT["continued"](GRUModule, False)
    trivial = PointGroup.trivial()
    entries = {"observation": invariant(trivial, 3), "action": invariant(trivial, 1)}
    symmetry = Symmetry(trivial, entries | {"recurrent_state": invariant(trivial, UNITS)})
    for given in (batch, batch[0]):
        out = SymmetricClipPPOLoss(policy, make_critic(), symmetry=symmetry)(given)
        expected = ClipPPOLoss(policy, make_critic())(given)
        for key in ("loss_objective", "loss_critic", "loss_entropy"):
            assert torch.equal(out[key], expected[key])


def test_the_flag_is_required():
    policy = make_policy()
    with pytest.raises(KeyError, match=r"is_init.*InitTracker"):
        make_loss(policy)(episodes(GRUModule, False).exclude("is_init"))


class Cell(TensorDictModuleBase):
    """A user's recurrent network: decays its memory, and begins anew where ``is_init`` is set."""

    def __init__(self, key="h", reset="is_init"):
        super().__init__()
        self.key, self.reset = key, reset
        self.in_keys, self.out_keys = ["observation", key, reset], ["feature", ("next", key)]
        self.net = nn.Linear(3, UNITS)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        x, h, init = self.net(tensordict["observation"]), tensordict[self.key], tensordict[self.reset]
        if not recurrent_mode():
            h = torch.where(init, 0.0, h)
            out = following = (0.5 * h + x).tanh()
        else:
            steps, carried = [], h[..., 0, :]
            for t in range(x.shape[-2]):
                carried = torch.where(init[..., t, :], h[..., t, :], carried)
                carried = (0.5 * carried + x[..., t, :]).tanh()
                steps.append(carried)
            out = following = torch.stack(steps, -2)
        return tensordict.set("feature", out).set(("next", self.key), following)


def wrapped(cell: TensorDictModuleBase) -> ProbabilisticActor:
    net = nn.Sequential(nn.Linear(UNITS, 2), NormalParamExtractor())
    return ProbabilisticActor(
        TensorDictSequential(cell, TensorDictModule(net, ["feature"], ["loc", "scale"])),
        in_keys=["loc", "scale"],
        distribution_class=IndependentNormal,
        return_log_prob=True,
    )


@pytest.mark.parametrize("key", ["h", ("agent", "h")])
def test_a_users_own_network_is_known_by_what_it_reads_and_writes(key):
    torch.manual_seed(0)
    policy = wrapped(Cell(key))
    hidden = TensorDictSequential(Cell(key), TensorDictModule(nn.Identity(), ["feature"], ["loc"]))
    for network in (policy, hidden.select_out_keys("loc")):
        assert memory_keys(network) == [key]
        assert reset_keys(network) == ["is_init"]

    batch = episodes(GRUModule, False).exclude("recurrent_state", ("next", "recurrent_state"))
    batch.set(key, torch.zeros(*batch.shape, UNITS))
    loss = make_loss(policy)
    with torch.no_grad():
        image = batch.clone().set("observation", -batch["observation"])
        right = torch.stack([by_steps(policy, image[b], key) for b in range(len(batch))])
    kl = loss(batch)["kl_approx_sym"][1]
    torch.testing.assert_close(kl, (batch["action_log_prob"] - right).mean(), rtol=1e-4, atol=1e-6)
    batch.get(key)[:, 0] = 0.1
    with pytest.raises(ValueError, match="not zero"):
        loss(batch)


def by_steps(policy: ProbabilisticActor, sequence: TensorDictBase, key) -> Tensor:
    out, memory = [], torch.zeros(1, UNITS)
    for t in range(len(sequence)):
        step = sequence[t : t + 1].select("observation", "is_init").set(key, memory)
        dist = policy.get_dist(step)
        out.append(dist.log_prob(-sequence["action"][t : t + 1])[0])
        memory = policy[0][0](step)["next", key]
    return torch.stack(out)


def test_a_memory_whose_starts_nobody_knows_is_refused():
    parts = TensorDictSequential(
        TensorDictModule(nn.GRUCell(3, UNITS), ["observation", "h"], ["feature"]),
        TensorDictModule(nn.Identity(), ["feature"], [("next", "h")]),
    )
    policy = wrapped(parts)
    assert memory_keys(policy) == ["h"] and not reset_keys(policy)
    with pytest.raises(ValueError, match=r"\['h'\] but not 'is_init'"):
        make_loss(policy)
    make_loss(policy, True)  # an equivariant memory has its image everywhere


def test_a_network_without_memory_is_left_alone():
    net = TensorDictModule(nn.Linear(3, 1), ["observation"], ["action"])
    assert memory_keys(net) == [] and reset_keys(net) == []
    memory = Memory.of(Symmetry(GROUP, {"observation": SIGN * 3}), [net, None])
    batch = TensorDict(observation=torch.ones(5, 3), batch_size=[5])
    assert memory.prepare(batch, [MASK]) is batch
    assert memory.rebuild(batch) is batch
    assert memory.draw(make_symmetry(net, SWAP), batch).shape == (5,)


def test_accelerators_do_not_wait_for_the_check():
    condition = torch.zeros((), dtype=torch.bool, device="meta")
    with pytest.raises(RuntimeError):
        bool(condition)
    _require(condition, "asked without waiting")
