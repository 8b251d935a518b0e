"""Running normalisers: their statistics are those of the augmented data, and they commute with L_g."""

import copy
import io

import pytest
import torch
from torch import nn

from torchrl_sym import PointGroup, Representation, representations
from torchrl_sym.normalization import SymmetricNorm, components
from torchrl_sym.representations import (
    axial,
    heading,
    planar,
    points,
    polar,
    pseudoscalar,
    quaternion,
    scalar,
)

GROUPS = {
    "C2": PointGroup.reflection("y"),
    "K4": PointGroup.klein_four(),
    "C3": PointGroup.rotation(3),
    "D3": PointGroup.dihedral(3),
    "C4": PointGroup.rotation(4),
}


def ring(group):
    """Points around the vertical axis, which every element of these groups maps onto themselves."""
    angle = torch.arange(12) * torch.pi / 6
    return points(group, torch.stack([angle.cos(), angle.sin()], -1))


def wrenches(group):
    """A force at each point of the ring, as one vector."""
    pairs = zip(ring(group).matrices, polar(group).matrices, strict=True)
    return Representation(group, torch.stack([torch.kron(a, b) for a, b in pairs]))


BUILDERS = {
    "polar": polar,
    "axial": axial,
    "planar": planar,
    "heading": heading,
    "ring": ring,
    "quaternion": lambda group: quaternion(group, "conjugate"),
    "wrenches": wrenches,
    "sum": lambda group: polar(group) + pseudoscalar(group) * 2 + ring(group) + axial(group) * 2,
}
every_group = pytest.mark.parametrize("group", GROUPS.values(), ids=GROUPS)
every_builder = pytest.mark.parametrize("builder", BUILDERS.values(), ids=BUILDERS)


def skewed(rows, size, seed=0):
    """Rows that nobody would call symmetric: every entry has a mean and a size of its own."""
    generator = torch.Generator().manual_seed(seed)
    x, mean, scale = (torch.randn(n, size, generator=generator, dtype=torch.float64) for n in (rows, 1, 1))
    return 3 * mean + x * scale.exp()


def updated(rep, data, batches=4):
    norm = SymmetricNorm(rep)
    for batch in data.tensor_split(batches):
        norm.update(batch)
    return norm


@every_builder
@every_group
def test_commutes_with_every_element(group, builder):
    rep = builder(group)
    data = skewed(40, rep.dim)
    norm = updated(rep, data)
    for dtype, tolerance in ((torch.float32, 5e-6), (torch.float64, 1e-13)):
        x = data.to(dtype)
        bound = tolerance * float(norm(x).abs().max())
        for g in range(group.order):
            torch.testing.assert_close(norm(rep(x, g)), rep(norm(x), g), rtol=0, atol=bound)


@every_builder
@every_group
def test_statistics_are_those_of_the_augmented_data(group, builder):
    rep = builder(group)
    data = skewed(40, rep.dim)
    norm = updated(rep, data)
    orbit = rep.orbit(data).flatten(0, 1)
    torch.testing.assert_close(norm.mean, orbit.mean(0), rtol=0, atol=1e-12)
    variance = orbit.var(0, correction=0)
    if rep.is_signed_permutation:
        torch.testing.assert_close(norm.var, variance)
    for label in components(rep).unique():  # of mixed entries, the mean of their variances
        members = components(rep) == label
        torch.testing.assert_close(norm.var[members], variance[members].mean().expand(int(members.sum())))


def test_without_a_group_it_is_plain_normalisation():
    data = skewed(100, 3)
    norm = updated(polar(PointGroup.trivial()), data, batches=7)
    expected = (data - data.mean(0)) / (data.std(0, correction=0) + 1e-2)
    torch.testing.assert_close(norm(data), expected)
    assert norm.count == 100


def test_components_of_mixed_and_exchanged_entries():
    turn, flip = PointGroup.rotation(3), PointGroup.reflection("y")
    assert components(polar(turn) + scalar(turn) * 2).tolist() == [0, 0, 1, 2, 3]
    assert components(polar(flip)).tolist() == [0, 1, 2]  # changing sign mixes nothing
    assert len(components(ring(flip)).unique()) == 7  # five pairs, and two points on the plane
    assert len(components(wrenches(PointGroup.rotation(4))).unique()) == 9  # 6 of (x, y), 3 of z


def test_small_differences_of_large_numbers_are_not_lost():
    rep = scalar(PointGroup.reflection("y"))
    noise = skewed(3000, 1)
    norm = updated(rep, (1e4 + 1e-2 * noise).double(), batches=300)
    torch.testing.assert_close(norm.std, 1e-2 * noise.std(0, correction=0), rtol=1e-6, atol=0)


def test_half_precision_neither_stalls_nor_rounds_the_statistics():
    rep = polar(PointGroup.rotation(3))
    data = skewed(4000, 3).bfloat16()
    norm = SymmetricNorm(rep).bfloat16()
    for batch in data.split(10):
        norm.update(batch)
    assert norm(data).dtype == torch.bfloat16
    reference = updated(rep, data.double())
    norm.half().to(torch.bfloat16)  # also after it was trained
    torch.testing.assert_close(norm.mean, reference.mean)
    torch.testing.assert_close(norm.var, reference.var)


def test_several_inputs_are_normalised_by_their_own_statistics():
    group = GROUPS["D3"]
    reps = [polar(group), scalar(group), axial(group)]
    inputs = [skewed(24, rep.dim, seed).reshape(2, 12, -1) for seed, rep in enumerate(reps)]
    norm = SymmetricNorm(*reps)
    norm.update(*inputs)
    for rep, x, y in zip(reps, inputs, norm(*inputs), strict=True):
        torch.testing.assert_close(y, updated(rep, x.reshape(24, -1), 1)(x))
    with pytest.raises(ValueError, match=r"expected 3 inputs with last .*, got \[\(2, 12, 3\)\]"):
        norm(inputs[0])
    with pytest.raises(ValueError, match="expected 3 inputs"):
        norm.update(inputs[1], inputs[0], inputs[2])


@pytest.mark.skipif(not hasattr(representations, "items"), reason="one event dimension only")
def test_items_of_several_event_dimensions():
    group = GROUPS["C3"]
    rep = representations.items(ring(group), polar(group))  # (12, 3)
    data = skewed(30, 36).reshape(30, 12, 3)
    norm = updated(rep, data)
    torch.testing.assert_close(norm.mean, rep.orbit(data).flatten(0, 1).mean(0).flatten())
    for g in range(group.order):
        torch.testing.assert_close(norm(rep(data, g)), rep(norm(data), g))


def test_when_it_updates():
    group = GROUPS["C2"]
    data = skewed(20, 3)
    norm = SymmetricNorm(polar(group), until=30)
    norm(data)  # in training mode
    assert norm.count == 0
    torch.testing.assert_close(norm(data), data / 1.01)
    for rows in (20, 40, 40):
        norm.update(data)
        assert norm.count == rows
    norm.update(data[:0])
    assert norm.mean.isfinite().all()

    eager = SymmetricNorm(polar(group), update_in_forward=True)
    torch.testing.assert_close(eager(data), updated(polar(group), data, 1)(data))
    eager.eval()(data + 1)
    assert eager.count == 20


def test_it_travels_with_its_network():
    rep = polar(GROUPS["D3"])
    net = nn.Sequential(SymmetricNorm(rep), nn.Linear(3, 2))
    net[0].update(skewed(20, 3))
    file = io.BytesIO()
    torch.save(net.state_dict(), file)
    file.seek(0)
    other = nn.Sequential(SymmetricNorm(rep), nn.Linear(3, 2))
    other.load_state_dict(torch.load(file))
    x = skewed(5, 3).float()
    assert torch.equal(other(x), net(x))
    assert torch.equal(copy.deepcopy(net)(x), net(x))
    exported = torch.export.export(net, (x,)).module()
    torch.testing.assert_close(exported(x), net(x))


def test_malformed():
    with pytest.raises(ValueError, match="at least one representation"):
        SymmetricNorm()
    with pytest.raises(TypeError, match="representations: expected Representation, got 3"):
        SymmetricNorm(3)
    with pytest.raises(ValueError, match="one group"):
        SymmetricNorm(polar(GROUPS["C2"]), polar(GROUPS["C3"]))
    for name, value in (("eps", 0.0), ("until", 0), ("update_in_forward", 1)):
        with pytest.raises((TypeError, ValueError), match=name):
            SymmetricNorm(polar(GROUPS["C2"]), **{name: value})
