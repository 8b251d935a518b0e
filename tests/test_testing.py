"""The assertions for users: they let right things pass and name what is wrong."""

import pytest
import torch
from torch import nn

from torchrl_sym import PointGroup, Representation
from torchrl_sym.representations import axial, polar, pseudoscalar, signed_permutation
from torchrl_sym.testing import assert_equivariant, assert_representation

GROUPS = [
    PointGroup.reflection("y"),
    PointGroup.klein_four(),
    PointGroup.rotation(3),
    PointGroup.dihedral(4),
]


def averaged(in_rep: Representation, out_rep: Representation) -> nn.Linear:
    """A linear map made equivariant by averaging over the group: mean_g rho_out(g)^T W rho_in(g)."""
    torch.manual_seed(0)
    layer = nn.Linear(in_rep.dim, out_rep.dim, bias=False).double()
    terms = [b.mT @ layer.weight @ a for a, b in zip(in_rep.matrices, out_rep.matrices, strict=True)]
    layer.weight.data = torch.stack(terms).mean(0)
    return layer


@pytest.mark.parametrize("group", GROUPS, ids=repr)
def test_equivariant_maps_pass_and_others_fail(group):
    in_rep, out_rep = polar(group) + axial(group), polar(group)
    x = torch.randn(16, 6, dtype=torch.float64)
    layer = averaged(in_rep, out_rep)
    assert_equivariant(layer, in_rep, out_rep, inputs=x, tolerance=1e-12)
    with torch.no_grad():
        layer.weight[0, 3] += 0.1
    with pytest.raises(AssertionError, match="not equivariant under"):
        assert_equivariant(layer, in_rep, out_rep, inputs=x)


def test_axial_treated_as_polar_is_named():
    group = PointGroup.reflection("y")
    with pytest.raises(AssertionError, match=r"'reflect-y': entry \d \(roll rate|pitch rate|yaw rate\)"):
        assert_equivariant(
            lambda x: x, axial(group), polar(group), names=["roll rate", "pitch rate", "yaw rate"]
        )


def test_invariance_is_the_default():
    group = PointGroup.rotation(3)
    assert_equivariant(lambda x: x.square().sum(-1, keepdim=True), polar(group))
    with pytest.raises(AssertionError, match="1 of 1 entries differ"):
        assert_equivariant(lambda x: x[..., :1], polar(group))


def test_nan_is_a_violation_and_a_wrong_size_an_error():
    sign = pseudoscalar(PointGroup.reflection("x"))
    with pytest.raises(AssertionError, match="not equivariant"):
        assert_equivariant(lambda x: x * torch.nan, sign, sign)
    with pytest.raises(ValueError, match="expected an output of size 2"):
        assert_equivariant(torch.tanh, sign, sign * 2)


def test_representations_pass_and_damaged_ones_are_named():
    for group in GROUPS:
        assert_representation(polar(group) + axial(group) * 2)
    group = PointGroup.reflection("y")
    hips = signed_permutation(group, ["l", "r"], {"reflect-y": {"l": "-r", "r": "-l"}})
    hips.blocks[0].sign[1, 0] *= -1
    with pytest.raises(
        AssertionError, match=r"rho\(reflect-y\) rho\(reflect-y\) differs from rho\(identity\)"
    ):
        assert_representation(hips)
