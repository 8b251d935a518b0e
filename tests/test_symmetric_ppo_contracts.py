"""SymmetricClipPPOLoss beside TorchRL: keys, dispatch, reductions, masks, copies, compilation, DDP."""

import copy
import io
import os
import pickle
import shutil

import pytest
import torch
from tensordict.nn import CompositeDistribution, NormalParamExtractor, TensorDictModule
from tensordict.nn.probabilistic import set_composite_lp_aggregate
from torch import nn
from torchrl.modules import IndependentNormal, ProbabilisticActor, TanhNormal
from torchrl.objectives import ClipPPOLoss, ValueEstimators
from torchrl.objectives.value import GAE

from tests.networks import (
    OBSERVATION_DIM,
    add_transitions,
    assert_unchanged,
    gradients,
    make_actor,
    make_batch,
    make_critic,
    make_symmetry,
    near_policy,
)
from torchrl_sym import MirrorLoss, PointGroup, SymmetricClipPPOLoss, Symmetry, SymmetryAugment
from torchrl_sym.representations import planar, polar, pseudoscalar

EVERYTHING = {"clip_value": 0.2, "mirror_coeff": 0.1}
ELEMENTS = ["all", "random"]


def make_loss(group="K4", *, dtype=torch.float64, distribution=IndependentNormal, seed=0, **kwargs):
    actor = make_actor(distribution, dtype=dtype, seed=seed)
    return SymmetricClipPPOLoss(
        actor, make_critic(dtype=dtype), symmetry=make_symmetry(group), **(EVERYTHING | kwargs)
    )


def batch_of(*size, dtype=torch.float64, **kwargs):
    return near_policy(make_batch(*size, dtype=dtype, **kwargs), make_actor(dtype=dtype))


def seeded(loss, *args, **kwargs):
    torch.manual_seed(0)
    return loss(*args, **kwargs)


def assert_same(found, expected):
    assert set(found.keys()) == set(expected.keys())
    for key, value in expected.items():
        torch.testing.assert_close(found[key], value, msg=lambda m, key=key: f"{key}: {m}")


# --- keys -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("elements", ELEMENTS)
def test_every_key_can_be_renamed_and_nested(elements):
    observation, action, value = ("agent", "obs"), ("agent", "torque"), ("agent", "v")
    loss = SymmetricClipPPOLoss(
        make_actor(observation=observation, action=action),
        make_critic(observation, value),
        symmetry=make_symmetry("D3", observation, action),
        elements=elements,
        **EVERYTHING,
    )
    names = {"advantage": "gain", "value_target": ("agent", "ret"), "value": value}
    loss.set_keys(**names, sample_log_prob=("agent", "old"))
    batch = batch_of(4, 3)
    renamed = batch.copy()
    for old, new in {
        "observation": observation,
        "action": action,
        "action_log_prob": ("agent", "old"),
        "advantage": "gain",
        "value_target": ("agent", "ret"),
        "state_value": value,
    }.items():
        renamed.rename_key_(old, new)
    assert_same(seeded(loss, renamed), seeded(make_loss("D3", elements=elements), batch))


@pytest.mark.parametrize(
    ("reader", "networks"),
    [
        ("the actor", lambda: (make_actor(observation="lidar"), make_critic())),
        ("the critic", lambda: (make_actor(), make_critic("lidar"))),
        ("the surrogate objective", lambda: (make_actor(action="lidar"), make_critic())),
    ],
)
def test_a_key_that_the_symmetry_lacks_is_an_error(reader, networks):
    with pytest.raises(KeyError, match=rf"{reader} reads \['lidar'\], which this symmetry does not"):
        SymmetricClipPPOLoss(*networks(), symmetry=make_symmetry())


def test_set_keys_refuses_an_action_that_the_symmetry_lacks():
    loss = make_loss()
    with pytest.raises(KeyError, match=r"reads \['torque'\], which this symmetry does not transform"):
        loss.set_keys(action="torque")


def test_bad_arguments_are_errors():
    with pytest.raises(ValueError, match="mirror_coeff: expected a finite number of at least 0, got -1"):
        make_loss(mirror_coeff=-1.0)
    with pytest.raises(ValueError, match="expected 'all', 'random' or a sequence of names"):
        make_loss(elements="some")
    with pytest.raises(KeyError, match="no element 'rot-90' in this group"):
        make_loss(elements=["rot-90"])


@pytest.mark.parametrize("options", [{}, EVERYTHING, {"entropy_bonus": False}])
def test_announces_its_keys(options):
    actor, critic, symmetry = make_actor(), make_critic(), make_symmetry()
    base = ClipPPOLoss(actor, critic, **{k: v for k, v in options.items() if k != "mirror_coeff"})
    loss = SymmetricClipPPOLoss(actor, critic, symmetry=symmetry, **options)
    assert set(loss.in_keys) == set(base.in_keys)
    assert set(base.out_keys) < set(loss.out_keys)
    assert set(loss.out_keys) | {"explained_variance"} == set(loss(batch_of()).keys())


@pytest.mark.parametrize("elements", ELEMENTS)
def test_keywords_instead_of_a_tensordict(elements):
    loss = make_loss(elements=elements, clip_value=None)
    batch = add_transitions(batch_of(4, 6))
    names = {key: key if isinstance(key, str) else "_".join(key) for key in loss.in_keys}
    out = seeded(loss, **{name: batch[key] for key, name in names.items()})
    expected = seeded(loss, batch)
    assert len(out) == len(loss.out_keys)
    for key, value in zip(loss.out_keys, out, strict=True):
        torch.testing.assert_close(value, expected[key], msg=key)


# --- advantages, distributions, masks -------------------------------------------------------------


def test_make_value_estimator():
    loss, batch = make_loss(), add_transitions(batch_of(4, 6))
    loss.make_value_estimator(ValueEstimators.GAE, gamma=0.8, lmbda=0.7)
    estimated = GAE(gamma=0.8, lmbda=0.7, value_network=make_critic())(batch.copy())
    assert_same(loss(batch), loss(estimated))


def composite_actor():
    torch.manual_seed(0)
    net = nn.Sequential(nn.Linear(OBSERVATION_DIM, 6, dtype=torch.float64), SplitHeads())
    parameters = [("params", head, name) for head in ("hip", "spin") for name in ("loc", "scale")]
    return ProbabilisticActor(
        TensorDictModule(net, ["observation"], parameters),
        in_keys=["params"],
        out_keys=["hip", "spin"],
        distribution_class=CompositeDistribution,
        distribution_kwargs={"distribution_map": dict.fromkeys(("hip", "spin"), IndependentNormal)},
        return_log_prob=True,
    )


class SplitHeads(nn.Module):
    def forward(self, x):
        hip, spin = x.split([4, 2], -1)
        return *NormalParamExtractor()(hip), *NormalParamExtractor()(spin)


@pytest.mark.parametrize("group", [PointGroup.trivial(), PointGroup.klein_four()])
def test_several_action_heads(group):
    symmetry = Symmetry(
        group,
        {
            "observation": polar(group) + pseudoscalar(group),
            "hip": planar(group),
            "spin": pseudoscalar(group),
        },
    )
    batch = make_batch()
    action, log_prob = batch.pop("action"), batch.pop("action_log_prob")
    batch.update({"hip": action[..., :2], "spin": action[..., 2:]})
    batch.update({"hip_log_prob": log_prob, "spin_log_prob": 0.5 * log_prob})
    with set_composite_lp_aggregate(False):
        actor, critic = composite_actor(), make_critic()
        base, ours = ClipPPOLoss(actor, critic), SymmetricClipPPOLoss(actor, critic, symmetry=symmetry)
        found, original, augmented = ours(batch), base(batch), base(SymmetryAugment(symmetry)(batch))
    for key in ("entropy", "loss_entropy", "kl_approx"):
        torch.testing.assert_close(found[key], original[key])
    assert_same(found["composite_entropy"], original["composite_entropy"])
    for key in ("loss_objective", "loss_critic"):
        torch.testing.assert_close(found[key], augmented[key])


def test_mirror_terms_refuse_several_action_heads():
    group = PointGroup.reflection("x")
    odd = pseudoscalar(group)
    symmetry = Symmetry(group, {"observation": odd * OBSERVATION_DIM, "hip": odd * 2, "spin": odd})
    message = r"compares one action, got an actor with \['hip', 'spin'\]; join its heads"
    with set_composite_lp_aggregate(False):
        with pytest.raises(ValueError, match=message):
            MirrorLoss(composite_actor(), symmetry=symmetry)
        with pytest.raises(ValueError, match=message):
            SymmetricClipPPOLoss(composite_actor(), make_critic(), symmetry=symmetry, mirror_coeff=0.1)


MASKS = [("collector", "mask"), "shifted_valid"]
LOSSES = ["loss_objective", "loss_critic", "loss_entropy", "loss_mirror"]


@pytest.mark.parametrize("key", MASKS)
def test_masked_rows_do_not_count(key):
    loss, batch = make_loss("D3"), batch_of(4, 3)
    mask = torch.arange(12).reshape(4, 3) % 3 > 0
    expected = loss(batch[mask])
    batch["advantage"][~mask] = 1e6
    found = loss(batch.set(key, mask.unsqueeze(-1)))
    for name in LOSSES:
        torch.testing.assert_close(found[name], expected[name])


@pytest.mark.parametrize("key", MASKS)
def test_masked_rows_do_not_count_with_random_elements(key):
    loss, batch = make_loss("D3", elements="random"), batch_of(4, 3)
    mask = torch.arange(12).reshape(4, 3) % 3 > 0
    batch.set(key, mask.unsqueeze(-1))
    expected = seeded(loss, batch)
    for entry in ("advantage", "value_target"):
        batch[entry][~mask] = float("nan")
    found = seeded(loss, batch)
    for name in LOSSES:
        torch.testing.assert_close(found[name], expected[name])


# --- module behaviour -----------------------------------------------------------------------------


@pytest.mark.parametrize("elements", ELEMENTS)
@pytest.mark.parametrize("size", [(12,), (4, 3), (4, 1), (1,)])
def test_reductions(size, elements):
    batch = batch_of(*size)
    none, mean, sum_ = (
        seeded(make_loss(elements=elements, reduction=r), batch) for r in ("none", "mean", "sum")
    )
    rows = size if elements == "random" else (4 * size[0], *size[1:])
    for name in LOSSES:
        original = name in ("loss_entropy", "loss_mirror")
        assert none[name].shape == (size if original else rows), name
        torch.testing.assert_close(mean[name], none[name].mean())
        torch.testing.assert_close(sum_[name], none[name].sum())


@pytest.mark.parametrize("elements", ELEMENTS)
def test_functional_or_not_is_the_same(elements):
    actor, critic, batch = make_actor(), make_critic(), batch_of()
    functional, plain = (
        SymmetricClipPPOLoss(
            actor, critic, symmetry=make_symmetry("D3"), elements=elements, functional=f, **EVERYTHING
        )
        for f in (True, False)
    )
    assert_same(seeded(functional, batch), seeded(plain, batch))
    torch.testing.assert_close(
        seeded(gradients, functional, batch, [actor, critic]),
        seeded(gradients, plain, batch, [actor, critic]),
    )


def test_state_dict_round_trip():
    loss, batch, file = make_loss(entropy_coeff=0.05, mirror_coeff=0.7), batch_of(), io.BytesIO()
    torch.save(loss.state_dict(), file)
    file.seek(0)
    other = make_loss(seed=9)
    base = ClipPPOLoss(make_actor(), make_critic(), clip_value=0.2)
    assert set(loss.state_dict()) == {*base.state_dict(), "mirror_coeff"}  # no constants of the group
    other.load_state_dict(torch.load(file, weights_only=True))
    assert_same(other(batch), loss(batch))


@pytest.mark.parametrize(
    ("coefficient", "name"), [("entropy_coeff", "loss_entropy"), ("mirror_coeff", "loss_mirror")]
)
def test_coefficients_are_schedulable(coefficient, name):
    loss, batch = make_loss(), batch_of()
    before = loss(batch)
    setattr(loss, coefficient, 3 * float(getattr(loss, coefficient)))
    after = loss(batch)
    for key in LOSSES:
        torch.testing.assert_close(after[key], (3 if key == name else 1) * before[key])


@pytest.mark.parametrize("elements", [*ELEMENTS, ["rot-180"]])
@pytest.mark.parametrize("batch", [lambda: batch_of(), lambda: add_transitions(batch_of(4, 6))])
def test_input_is_not_modified(batch, elements):
    assert_unchanged(make_loss(elements=elements, clip_value=None, normalize_advantage=True), batch())


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x))])
def test_can_be_copied(duplicate):
    loss, batch = make_loss("D3"), batch_of()
    assert_same(duplicate(loss)(batch), loss(batch))


@pytest.mark.parametrize("elements", ELEMENTS)
@pytest.mark.parametrize("group", ["C1", "K4", "D3"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_keeps_the_precision(dtype, group, elements):
    out = make_loss(group, dtype=dtype, elements=elements)(batch_of(dtype=dtype))
    assert {key: value.dtype for key, value in out.items()} == dict.fromkeys(out.keys(), dtype)


def test_single_precision_agrees_with_double():
    single = make_loss("D3", dtype=torch.float32)(batch_of().float())
    double = make_loss("D3")(batch_of())
    for name in LOSSES:
        torch.testing.assert_close(single[name].double(), double[name], rtol=1e-4, atol=1e-5)


@pytest.mark.skipif(not shutil.which("c++") and not shutil.which("g++"), reason="no C++ compiler")
def test_compiles_without_graph_breaks():
    loss, batch = make_loss(), batch_of()
    compiled = torch.compile(loss, fullgraph=True)
    assert_same(compiled(batch), loss(batch))
    modules = [loss.actor_network_params, loss.critic_network_params]
    torch.testing.assert_close(gradients(compiled, batch, modules), gradients(loss, batch, modules))


@pytest.mark.parametrize("distribution", [IndependentNormal, TanhNormal])
def test_random_elements_trace_without_graph_breaks(distribution):
    loss = make_loss(elements="random", distribution=distribution)
    batch = batch_of(bound=1.9)
    traced = torch.compile(loss, fullgraph=True, backend="aot_eager")
    found, expected = seeded(traced, batch), seeded(loss, batch)
    for name in ("loss_objective", "loss_critic", "loss_mirror"):
        torch.testing.assert_close(found[name], expected[name])


# --- data-parallel training -----------------------------------------------------------------------


def ddp_loss():
    actor, critic = make_actor(), make_critic()
    return SymmetricClipPPOLoss(actor, critic, symmetry=make_symmetry("K4"), mirror_coeff=0.1)


def ddp_rank(rank, store, result, finished):
    """One of two processes: the gradient of half of the batch, averaged by DDP."""
    torch.set_num_threads(1)
    torch.distributed.init_process_group("gloo", init_method=store, rank=rank, world_size=2)
    loss = ddp_loss()
    parallel = nn.parallel.DistributedDataParallel(loss)
    out = parallel(batch_of(12)[6 * rank : 6 * rank + 6])
    sum(value for name, value in out.items() if name.startswith("loss_")).backward()
    if rank == 0:
        torch.save([p.grad for p in loss.parameters()], result)
    finished.wait(60)
    # At times torch 2.13 hangs when it frees a gloo group: the destructor waits, with Python's lock in
    # hand, for a thread that needs this lock.
    os._exit(0)


@pytest.mark.slow
def test_two_processes_have_the_gradient_of_one(tmp_path):
    result = tmp_path / "gradients.pt"
    finished = torch.multiprocessing.get_context("forkserver").Barrier(2)
    arguments = (f"file://{tmp_path / 'store'}", str(result), finished)
    torch.multiprocessing.start_processes(ddp_rank, arguments, nprocs=2, start_method="forkserver")
    loss = ddp_loss()
    out = loss(batch_of(12))
    sum(value for name, value in out.items() if name.startswith("loss_")).backward()
    for found, p in zip(torch.load(result), loss.parameters(), strict=True):
        torch.testing.assert_close(found, p.grad)
