"""Representations are exact on every device and in every precision, and never wait for a device."""

import copy
import pickle

import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.utils._python_dispatch import TorchDispatchMode

from tests.point_groups import GROUPS, random
from tests.test_representations import BUILDERS, CASES
from torchrl_sym import PointGroup, Representation
from torchrl_sym.representations import axial, invariant, items, polar, pseudoscalar, quaternion, scalar

C3, K4 = GROUPS["C3"], GROUPS["K4"]
REPS = {
    "mixing": polar(C3) + invariant(C3, 2) + quaternion(C3),
    "signed": polar(K4) + axial(K4) + pseudoscalar(K4),
    "items": items(invariant(C3, 3), polar(C3)),
    "trivial": scalar(K4) * 3,
}
every_rep = pytest.mark.parametrize("rep", REPS.values(), ids=REPS)
META = torch.device("meta")


def rounded(rep: Representation, x: torch.Tensor, g: int) -> torch.Tensor:
    """Of float64 arithmetic, once."""
    flat = x.double().flatten(x.ndim - len(rep.event_shape)) @ rep.matrices[g].T
    return flat.reshape(x.shape).to(x.dtype)


def all_ways(rep: Representation, x: torch.Tensor) -> list[torch.Tensor]:
    """Images of ``(rows, *event_shape)`` by all elements, ``(N, rows, ...)``, in each way there is."""
    n = rep.group.order
    g = torch.arange(n, device=x.device)
    rows = rep(x.expand(n, *x.shape), g)
    return [
        rep.orbit(x),
        torch.stack([rep(x, k) for k in range(n)]),
        rows,
        rep.per_row(x.expand_as(rows), g),
    ]


@every_rep
@pytest.mark.parametrize(
    "dtype, autocast",
    [
        (torch.bfloat16, False),
        (torch.bfloat16, True),
        (torch.float32, False),
        (torch.float32, True),
        (torch.float16, False),  # torch.cat of float16 is an error in autocast to bfloat16
    ],
)
def test_results_are_rounded_once(rep, dtype, autocast):
    x = random(64, *rep.event_shape).to(dtype)
    expected = torch.stack([rounded(rep, x, g) for g in range(rep.group.order)])
    with torch.autocast("cpu", torch.bfloat16, enabled=autocast):
        for images in all_ways(rep, x):
            assert images.dtype == dtype and torch.equal(images, expected)


@every_rep
def test_casting_a_module_does_not_round_the_group(rep):
    module = torch.nn.ModuleList([copy.deepcopy(rep)])
    assert not list(module.parameters()) and not list(module.buffers())
    x = random(8, *rep.event_shape)
    for cast in (module.to, torch.nn.Module.half, torch.nn.Module.double):
        (cast(torch.bfloat16) if cast == module.to else cast(module))
        assert torch.equal(module[0].orbit(x), rep.orbit(x))
        assert torch.equal(module[0].matrices, rep.matrices)


@every_rep
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16], ids=str)
def test_the_identity_copies_bits(rep, dtype):
    odd = torch.tensor(
        [torch.nan, torch.inf, -torch.inf, -0.0, torch.finfo(dtype).tiny / 4, 0.1], dtype=dtype
    )
    x = odd.repeat(rep.dim).reshape(6, *rep.event_shape).contiguous()
    for image in (rep(x, 0), rep(x, "identity"), rep.orbit(x)[0]):
        assert image.view(torch.uint8).equal(x.view(torch.uint8))
        assert image.data_ptr() != x.data_ptr()
    image = rep(x, torch.zeros(6).long())
    torch.testing.assert_close(image, x, rtol=0, atol=0, equal_nan=True)


def test_one_entry_does_not_spoil_those_that_it_has_no_part_in():
    rep = polar(C3) * 2
    x = torch.ones(6)
    x[2], x[3] = torch.inf, torch.nan
    for image in (rep(x, 1), rep(x, torch.tensor(1))):
        assert image.isfinite().tolist() == [True, True, False, False, False, True]
        assert image[2] == torch.inf


@every_rep
def test_copies_follow_the_data_and_stay_out_of_pickles(rep):
    rep = copy.deepcopy(rep)
    with torch.inference_mode():
        all_ways(rep, torch.ones(4, *rep.event_shape, device=META))
    x = torch.ones(4, *rep.event_shape, device=META, requires_grad=True)
    for images in all_ways(rep, x):
        assert images.device == META
        images.sum().backward()  # what was placed in inference mode can be saved for it
    for twin in (copy.deepcopy(rep), pickle.loads(pickle.dumps(rep))):
        assert torch.equal(twin.orbit(random(*rep.event_shape)), rep.orbit(random(*rep.event_shape)))
        assert not any(block._constants._copies for block in twin.blocks)
    assert any(block._constants._copies for block in rep.blocks) != rep.is_trivial or rep.is_trivial


@every_rep
def test_fake_tensors_pass_and_leave_nothing_behind(rep):
    rep, x = copy.deepcopy(rep), random(4, *rep.event_shape)
    expected = rep.orbit(x)
    with FakeTensorMode(allow_non_fake_inputs=True) as mode:
        for device in ("cpu", "cuda"):
            all_ways(rep, torch.ones(4, *rep.event_shape, device=device))
        all_ways(rep, mode.from_tensor(x))
    assert torch.equal(rep.orbit(x), expected)
    assert not any(block._constants._copies for block in rep.blocks)


class NoWaiting(TorchDispatchMode):
    """Raises on what makes the host wait for a device, or sends it a constant."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        for name in ("_local_scalar_dense", "lift_fresh", "nonzero", "is_nonzero", "equal", "_to_copy"):
            if func.name() == f"aten::{name}" and not (
                name == "_to_copy" and "device" not in (kwargs or {})
            ):
                raise AssertionError(f"{func} in a forward path")
        return func(*args, **kwargs or {})


@every_rep
def test_nothing_waits(rep):
    x = random(4, *rep.event_shape)
    g = torch.zeros(4, dtype=torch.int64)
    with NoWaiting():
        rep.orbit(x), rep(x, 1), rep.per_row(x, g)
    with pytest.raises(AssertionError, match="_local_scalar_dense"), NoWaiting():
        rep(x, g)  # looks at indices that somebody else made, on the CPU


def test_values_of_foreign_indices_are_looked_at_on_the_cpu_only():
    rep = REPS["mixing"]
    with pytest.raises(KeyError, match=r"element indices in \[0, 3\), got 0 to 3"):
        rep(torch.ones(4, rep.dim), torch.arange(4))
    rep(torch.ones(4, rep.dim, device=META), torch.arange(4, device=META))


@every_rep
@pytest.mark.parametrize("device", ["cpu", "meta"])
def test_compiles_without_graph_breaks(rep, device):
    torch.compiler.reset()
    rep = copy.deepcopy(rep)  # first used while it is traced
    compiled = torch.compile(lambda x: all_ways(rep, x), fullgraph=True, backend="aot_eager")
    x = random(4, *rep.event_shape, dtype=torch.float32).to(device)
    for _ in range(2):
        images = compiled(x)
        assert device == "meta" or all(map(torch.equal, images, all_ways(rep, x)))


def test_a_default_device_changes_nothing():
    """Groups and representations are built, used and derived while new tensors go elsewhere."""
    for name, group in [case for case in CASES if case[1] in {"K4", "C3"}]:
        expected = BUILDERS[name][0](GROUPS[group])
        try:
            torch.set_default_device("meta")
            made = PointGroup.klein_four() if group == "K4" else PointGroup.rotation(3)
            rep = BUILDERS[name][0](made)
            images = rep.orbit(torch.ones(rep.event_shape))
            found = rep.matrices, rep.components, rep.restrict(made.subgroup([1])).matrices
        finally:
            torch.set_default_device(None)
        assert images.device == META and images.shape == (made.order, *rep.event_shape)
        assert torch.equal(found[0], expected.matrices) and torch.equal(found[1], expected.components)
        assert found[2].device == torch.device("cpu")
