"""The losses never wait for the host: nothing they compute is turned into a number of Python's.

On an accelerator, `.item()`, `bool(tensor)` and `.tolist()` stop until everything before them is done, and
forbid to capture a step into a graph. The device "meta" has no numbers at all, so that each of them fails
there; and on the CPU, a mode that sees every operation refuses those that hand out numbers.
"""

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from tests.networks import make_actor, make_batch, make_critic, make_symmetry, near_policy, total
from torchrl_sym import MirrorLoss, SymmetricClipPPOLoss

WAITS = {
    "aten::_local_scalar_dense",
    "aten::nonzero",
    "aten::masked_select",
    "aten::equal",
    "aten::is_nonzero",
}
SETTINGS = [
    {"elements": elements, **more}
    for elements in ("all", "random", ("rot-180",))
    for more in (
        {},
        {"mirror_coeff": 0.5, "clip_value": 0.2, "normalize_advantage": True},
        {"max_importance_ratio": 2.0, "loss_critic_type": "l2", "reduction": "sum"},
    )
]


class NoWaits(TorchDispatchMode):
    """Refuses operations that hand a number to Python."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = func.name().split(".")[0]
        if name in WAITS:
            raise AssertionError(f"{name} waits for the host")
        return func(*args, **(kwargs or {}))


def refused(*args, **kwargs):
    raise AssertionError("a tensor of the host's numbers")


def loss_of(**settings) -> SymmetricClipPPOLoss:
    actor, critic = make_actor(), make_critic()
    return SymmetricClipPPOLoss(actor, critic, symmetry=make_symmetry("K4"), **settings)


@pytest.mark.parametrize("settings", SETTINGS, ids=str)
def test_a_step_runs_where_there_are_no_numbers(settings):
    loss = loss_of(**settings, functional=False).to("meta")
    out = loss(make_batch(12).to("meta"))
    total(out).backward()
    torch.nn.utils.clip_grad_norm_(loss.parameters(), 1.0)
    assert all(value.device.type == "meta" for value in out.values())


@pytest.mark.parametrize("settings", SETTINGS, ids=str)
def test_a_step_hands_no_number_to_the_host_and_takes_none_from_it(settings, monkeypatch):
    loss = loss_of(**settings)
    batch = near_policy(make_batch(12), make_actor())
    loss(batch)  # first calls may place tables on the device
    for maker in ("tensor", "as_tensor", "from_numpy"):
        monkeypatch.setattr(torch, maker, refused)
    with NoWaits():
        total(loss(batch)).backward()


@pytest.mark.parametrize("device", ["meta"])
def test_losses_follow_the_device_of_networks_and_data(device):
    """Without to(device), as other losses of TorchRL."""
    actor, critic, symmetry = make_actor(), make_critic(), make_symmetry("C3")
    settings = {"symmetry": symmetry, "functional": False}
    losses = [SymmetricClipPPOLoss(actor, critic, elements=e, **settings) for e in ("all", "random")]
    losses += [MirrorLoss(actor, **settings)]
    actor.to(device), critic.to(device)
    batch = make_batch(12).to(device)
    for td in (batch, batch.copy().clear_device_()):
        for loss in losses:
            assert all(value.device.type == device for value in loss(td).values())


def test_the_guard_sees_what_waits():
    for wait in (lambda x: x.item(), bool, float):
        with pytest.raises(AssertionError, match="waits"), NoWaits():
            wait(torch.ones(1))


@pytest.mark.parametrize("elements", ["all", "random"])
@pytest.mark.parametrize("group", ["K4", "C3"])
def test_the_default_device_changes_nothing(elements, group):
    actor, critic, batch = make_actor(), make_critic(), make_batch(12)
    torch.set_default_device("meta")
    try:
        symmetry = make_symmetry(group)
        loss = SymmetricClipPPOLoss(actor, critic, symmetry=symmetry, elements=elements, mirror_coeff=0.5)
        out = loss(batch)
    finally:
        torch.set_default_device(None)
    assert all(value.device.type == "cpu" and value.isfinite().all() for value in out.values())
