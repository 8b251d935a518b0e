"""The promise of this package, on losses, buffers, collectors, policies and groups together.

For a policy that is exactly symmetric, and has not changed since it collected the data, a copy is as
probable as its original: every ratio is 1, and every diagnostic per element is 0. For one that is not
symmetric they are not. What makes the copies, stores or collects their rows must not matter, so that a
fault anywhere in between shows here. Every pair of choices is tried together at least once.
"""

import itertools
import random
from collections.abc import Iterator

import pytest
import torch
from tensordict import TensorDictBase
from torchrl.collectors import AsyncBatchedCollector, Collector
from torchrl.data import LazyTensorStorage, ReplayBuffer, SamplerWithoutReplacement, TensorDictReplayBuffer
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import ClipPPOLoss

from tests.symmetric_policies import GROUPS, POLICIES, Task
from torchrl_sym import (
    MirrorLoss,
    SymmetricClipPPOLoss,
    SymmetryAugment,
    SymmetryOrbit,
    SymmetryReplayBuffer,
)

ENVS, STEPS = 24, 3

CHOICES = {
    "loss": ["SymmetricClipPPOLoss", "ClipPPOLoss", "MirrorLoss"],
    "elements": ["all", "random", "named"],
    "buffer": ["none", "ReplayBuffer", "SymmetryReplayBuffer", "SymmetryOrbit"],
    "collector": ["rollout", "Collector", "AsyncBatchedCollector"],
    "policy": list(POLICIES),
    "group": list(GROUPS),
}
SEVERAL_HEADS = ("composite", "sides")

# Pairs that are refused, as the last tests of this file say.
REFUSED = [
    *({"loss": "MirrorLoss", "policy": policy} for policy in SEVERAL_HEADS),
    {"policy": "image", "group": "C3"},
    {"policy": "recurrent", "collector": "AsyncBatchedCollector"},
]


def all_pairs(seed: int = 0) -> Iterator[dict[str, str]]:
    """Cases with every pair of choices that is not refused: the best of some random ones, repeatedly."""
    draw = random.Random(seed)

    def accepted(case: dict[str, str]) -> bool:
        return not any(pair.items() <= case.items() for pair in REFUSED)

    pairs = [
        {a: x, b: y}
        for a, b in itertools.combinations(CHOICES, 2)
        for x, y in itertools.product(CHOICES[a], CHOICES[b])
        if accepted({a: x, b: y})
    ]
    while pairs:
        drawn = [{name: draw.choice(values) for name, values in CHOICES.items()} for _ in range(60)]
        tried = [case | pairs[0] for case in drawn if accepted(case | pairs[0])]
        case = max(tried, key=lambda case: sum(pair.items() <= case.items() for pair in pairs))
        pairs = [pair for pair in pairs if not pair.items() <= case.items()]
        yield case


@pytest.fixture(autouse=True)
def double_precision() -> Iterator[None]:
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    torch.manual_seed(0)
    yield
    torch.set_default_dtype(before)


def collect(task: Task, collector: str) -> TensorDictBase:
    """Rows ``[B]`` of a policy, or its sequences ``[B, T]`` if it has memory, with advantages."""
    if collector == "rollout":
        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
            batch = task.make_env(ENVS).rollout(STEPS, task.actor)
    else:
        if collector == "Collector":
            settings = {"frames_per_batch": ENVS * STEPS, "auto_register_policy_transforms": False}
            source = Collector(task.make_env(ENVS), task.actor, **settings)
        else:  # in threads
            settings = {"frames_per_batch": ENVS, "transport": "driver", "env_backend": "threading"}
            source = AsyncBatchedCollector([task.make_env] * 2, policy=task.actor, **settings)
        batch = next(iter(source)).clone()
        source.shutdown()
    shape = (*batch.shape, *task.each, 1)
    batch["advantage"], batch["value_target"] = torch.randn(shape), torch.randn(shape)
    batch = batch if task.sequences else batch.reshape(-1)
    return batch.exclude(*task.internal)


def through(
    buffer: str, batch: TensorDictBase, task: Task, elements: str | list[str], copies: bool
) -> TensorDictBase:
    """The batch as a loss gets it: with the copies that a buffer makes, or a transform on its own."""
    if buffer == "none":
        return SymmetryAugment(task.symmetry, elements=elements)(batch) if copies else batch

    settings = {
        "storage": LazyTensorStorage(len(batch)),
        "sampler": SamplerWithoutReplacement(),
        "batch_size": len(batch),
    }
    if buffer == "ReplayBuffer":
        made = ReplayBuffer(**settings, transform=SymmetryAugment(task.symmetry, elements=elements))
    elif buffer == "SymmetryReplayBuffer":
        made = SymmetryReplayBuffer(task.symmetry, elements=elements, **settings)
    else:
        orbit = SymmetryOrbit(task.symmetry, elements)
        made = TensorDictReplayBuffer(**settings, sample_unit=orbit, transform=orbit.transform())
    made.extend(batch)
    return made.sample()


def deviations(case: dict[str, str], symmetric: bool) -> dict[str, torch.Tensor]:
    """What a loss finds different in copies: zeros for a symmetric policy that has not changed."""
    task = POLICIES[case["policy"]](GROUPS[case["group"]], symmetric)
    elements = [task.symmetry.group.names[-1]] if case["elements"] == "named" else case["elements"]
    batch = collect(task, case["collector"])
    rows = through(case["buffer"], batch, task, elements, copies=case["loss"] == "ClipPPOLoss")
    if case["loss"] == "MirrorLoss":
        out = MirrorLoss(task.actor, symmetry=task.symmetry, per_element=True)(rows)
        return {"loss": out["loss_mirror"], "per element": out["mirror_error"]}

    reference = ClipPPOLoss(task.actor, task.critic)(rows.contiguous())  # TorchRL's reads no lazy stacks
    if case["loss"] == "ClipPPOLoss":
        out = reference
        found = {"ESS": out["ESS"] - 1}
    else:
        weight = 0.0 if case["policy"] in SEVERAL_HEADS else 1.0
        settings = {"symmetry": task.symmetry, "elements": elements, "mirror_coeff": weight}
        loss = SymmetricClipPPOLoss(task.actor, task.critic, **settings)
        out = loss(rows)
        found = {name: out[name] - reference[name] for name in ("loss_objective", "loss_critic")}
        found |= {"ESS_sym": out["ESS_sym"] - 1, "mirror": out.get("loss_mirror", torch.zeros(()))}
    found |= {name: value for name, value in out.items() if name.startswith(("kl_approx", "clip_fraction"))}
    return found | {name: out[name] - 1 for name in ("mean_ratio", "max_ratio")}


@pytest.mark.parametrize("case", list(all_pairs()), ids=lambda case: "-".join(case.values()))
def test_copies_are_as_probable_as_their_originals(case):
    for name, value in deviations(case, symmetric=True).items():
        assert value.abs().max() < 1e-9, name
    found = deviations(case, symmetric=False)
    assert max(value.abs().max() for value in found.values()) > 1e-3


@pytest.mark.parametrize("policy", SEVERAL_HEADS)
def test_mirror_losses_of_several_heads_are_refused(policy):
    task = POLICIES[policy](GROUPS["C2"], True)
    with pytest.raises(ValueError, match="compares one action"):
        MirrorLoss(task.actor, symmetry=task.symmetry)
    with pytest.raises(ValueError, match="compares one action"):
        SymmetricClipPPOLoss(task.actor, task.critic, symmetry=task.symmetry, mirror_coeff=1.0)


def test_images_turned_by_other_than_right_angles_are_refused():
    with pytest.raises(ValueError, match="rot-120"):
        POLICIES["image"](GROUPS["C3"], True)


@pytest.mark.parametrize("elements", ["all", "random"])
def test_rows_of_a_policy_with_memory_are_refused(elements):
    """AsyncBatchedCollector gives the rows of several environments in the order of their arrival."""
    task = POLICIES["recurrent"](GROUPS["C2"], True)
    batch = collect(task, "AsyncBatchedCollector")
    loss = SymmetricClipPPOLoss(task.actor, task.critic, symmetry=task.symmetry, elements=elements)
    with pytest.raises(ValueError, match="sequence"):
        loss(batch)


@pytest.mark.parametrize("key", ["loc", "scale"])
def test_deviations_that_elements_mix_are_refused(key):
    """A collector stores a deviation per component, for which a turn by 120 degrees has no place."""
    task = POLICIES["feed-forward"](GROUPS["C3"], True)
    batch = collect(task, "rollout").set(key, torch.ones(ENVS * STEPS, 3))
    if key == "loc":
        assert "loc" in SymmetryAugment(task.symmetry)(batch)
    else:
        with pytest.raises(KeyError, match="mixes components"):
            SymmetryAugment(task.symmetry)(batch)
