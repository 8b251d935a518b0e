"""Assertions for your own tests: is this a representation, is this network equivariant?

They pass silently and fail with the element, entry and size of the worst violation. Equivariance is tested
as mathematics, f(rho_in(g) x) = rho_out(g) f(x) for every element and random x, in the spirit of e3nn's
``assert_equivariant``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from torchrl_sym import checks
from torchrl_sym.representations import Representation, invariant
from torchrl_sym.symmetry import Symmetry


def assert_representation(representation: Representation, *, tolerance: float = 1e-9) -> None:
    """Fail unless rho(e) = 1, every rho(g) is orthogonal, and rho(g) rho(h) = rho(g h) for all pairs.

    Args:
        representation: what to check.
        tolerance: largest entry of a difference that still counts as equal.

    Raises:
        AssertionError: with the element or pair at fault.
        TypeError: no representation, or no number.
        ValueError: a tolerance that is negative or not finite, under which nothing, or anything, passes.

    Example:
        >>> from torchrl_sym import PointGroup
        >>> from torchrl_sym.representations import polar
        >>> assert_representation(polar(PointGroup.dihedral(3)))
    """
    checks.instance("representation", representation, Representation)
    tolerance = checks.real("tolerance", tolerance, 0.0)
    group = representation.group
    generator = torch.Generator("cpu").manual_seed(0)
    shape = (
        4,
        *representation.event_shape,
    )  # a linear map that errs does so on numbers in general position
    x = torch.randn(shape, generator=generator, dtype=torch.float64, device="cpu")
    images = representation.orbit(x)
    residual = (images[0] - x).abs().max()
    assert residual <= tolerance, f"the identity acts as something else, off by {residual:.2g}"
    length = x.flatten(1).norm(dim=-1)
    for g, name in enumerate(group.names):
        residual = (images[g].flatten(1).norm(dim=-1) / length - 1).abs().max()
        assert residual <= tolerance, f"{name!r} does not act orthogonally, off by {residual:.2g}"
        for h, other in enumerate(group.names):
            residual = (representation(images[h], g) - images[int(group.table[g, h])]).abs().max()
            assert residual <= tolerance, (
                f"rho({name}) rho({other}) differs from rho({group.names[int(group.table[g, h])]}) by "
                f"{residual:.2g}"
            )


def assert_equivariant(
    module: Callable[[Tensor], Tensor],
    in_rep: Representation,
    out_rep: Representation | None = None,
    *,
    inputs: Tensor | None = None,
    names: Sequence[str] | None = None,
    tolerance: float = 1e-5,
    seed: int = 0,
) -> None:
    """Fail unless f(rho_in(g) x) = rho_out(g) f(x) for every element.

    Args:
        module: maps ``(rows, in)`` to ``(rows, out)``; called without gradients.
        in_rep: how its input transforms.
        out_rep: how its output transforms. Defaults to invariance, as of a value function.
        inputs: rows to test on. Defaults to 64 standard normal ones.
        names: names of the output entries, for the message.
        tolerance: largest difference allowed, relative to the largest output (or 1 if that is smaller).
        seed: seed of the default inputs.

    Raises:
        AssertionError: with element, output entry and the two values that should agree.
        ValueError: the output's size is not that of ``out_rep``, the representations belong to two groups,
            there are no inputs or other than finite ones, not a name for every output, or a tolerance that
            is negative or not finite.
        TypeError: an argument of another type.

    Example:
        >>> import torch
        >>> from torchrl_sym import PointGroup
        >>> from torchrl_sym.representations import pseudoscalar
        >>> sign = pseudoscalar(PointGroup.reflection("x"))
        >>> assert_equivariant(torch.tanh, sign * 3, sign * 3)
        >>> assert_equivariant(torch.cos, sign, sign)
        Traceback (most recent call last):
        ...
        AssertionError: not equivariant under 'reflect-x': entry 0 of the output is ..., expected ...
    """
    checks.function("module", module)
    group = checks.instance("in_rep", in_rep, Representation).group
    if out_rep is not None and checks.instance("out_rep", out_rep, Representation).group != group:
        raise ValueError(f"out_rep: expected a representation of {group}, got one of {out_rep.group}")
    tolerance = checks.real("tolerance", tolerance, 0.0)
    generator = torch.Generator().manual_seed(checks.whole("seed", seed, 0))
    if inputs is None:
        inputs = torch.randn(64, in_rep.dim, generator=generator)
    if not checks.array("inputs", checks.instance("inputs", inputs, Tensor)).numel():
        raise ValueError(f"inputs: expected rows to test on, got {checks.shown(inputs)}")
    with torch.no_grad():
        output = module(inputs)
        if out_rep is None:
            out_rep = invariant(in_rep.group, output.shape[-1])
        if output.shape[-1] != out_rep.dim:
            raise ValueError(
                f"expected an output of size {out_rep.dim}, as of out_rep, got {tuple(output.shape)}"
            )
        if names is not None and len(checks.names("names", names)) != out_rep.dim:
            raise ValueError(f"names: expected {out_rep.dim}, one per output, got {checks.shown(names)}")
        bound = tolerance * max(1.0, float(output.abs().max()))
        for g, element in enumerate(in_rep.group.names):
            got, expected = module(in_rep(inputs, g)), out_rep(output, g)
            difference = (got - expected).abs().reshape(-1, out_rep.dim)
            worst = difference.amax(dim=0)  # per output entry; NaN counts as a violation
            if not bool((worst <= bound).all()):
                entry = int(worst.nan_to_num(torch.inf).argmax())
                row = int(difference[:, entry].nan_to_num(torch.inf).argmax())
                label = f" ({names[entry]})" if names is not None else ""
                a, b = (x.reshape(-1, out_rep.dim)[row, entry].item() for x in (got, expected))
                raise AssertionError(
                    f"not equivariant under {element!r}: entry {entry}{label} of the output is {a:.4g} on "
                    f"the mapped input, expected {b:.4g}; {int((worst > bound).sum())} of {out_rep.dim} "
                    f"entries differ, the largest by {float(worst[entry]):.2g}"
                )


def assert_env_symmetric(env: Any, symmetry: Symmetry, **verify_kwargs: Any) -> None:
    """Fail unless a MuJoCo-backed environment has the symmetry declared for it.

    Args:
        env: as :func:`~torchrl_sym.mujoco.verify` takes it.
        symmetry: how its observation and action transform.
        **verify_kwargs: arguments of ``verify``.

    Raises:
        AssertionError: with the part, element and entry or joint at fault, and the whole table.

    Example:
        >>> import tasks
        >>> env = tasks.make_env("cartpole", num_envs=16, num_threads=1)
        >>> assert_env_symmetric(env, env.symmetry)
    """
    from torchrl_sym.mujoco.verify import verify  # only this assertion needs MuJoCo

    report = verify(env, symmetry, **verify_kwargs)
    if not report.passed:
        row = report.worst
        if row.passed:
            raise AssertionError(f"{report.verdict}\n\n{report}")
        failure = "not symmetric" if report.deterministic else "not tested, the state decides too little:"
        raise AssertionError(
            f"{failure} under {row.element!r}: {row.part} is off by {row.value:.2g} (limit "
            f"{row.limit:.2g}) at {row.where}\n\n{report}"
        )
