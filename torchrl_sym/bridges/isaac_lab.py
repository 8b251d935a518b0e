"""Isaac Lab: the symmetry of a manager-based environment from the representations of its terms.

The configuration of such an environment lists its observations by the names of terms, and that is how their
symmetry is written down best: once for each kind of term, whatever their order, whichever groups have them
and how long their history is. The keys are those that Isaac Lab's own wrapper for rsl_rl and TorchRL's
``IsaacLabWrapper`` give: ``"policy"`` and ``"critic"``, or ``("policy", "joint_pos")`` where the terms of a
group are not concatenated.

Joints are best taken from a model of the robot in MuJoCo's format, by name, in the articulation's order:
``derive(model, group).joints(env.scene["robot"].joint_names)``.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from tensordict import NestedKey

from torchrl_sym import checks
from torchrl_sym.bridges.terms import assemble, given_terms, observation_manager, terms_of
from torchrl_sym.entries import Exchanged
from torchrl_sym.representations import Representation
from torchrl_sym.symmetry import Symmetry


def symmetry(
    env: Any,
    terms: Mapping[str | tuple[str, str], Representation],
    action: Representation,
    *,
    others: Mapping[NestedKey | Exchanged, Representation] | None = None,
) -> Symmetry:
    """The symmetry of an environment, of whose observations the terms are declared.

    Args:
        env: the environment, wrapped or not, for its ``observation_manager``.
        terms: how one frame of every term transforms, by its name; by ``(group, name)`` where a group has
            another one. Histories, concatenation, clips and scales are the manager's, and looked up.
        action: how the action transforms, all terms of it together.
        others: entries that the observation manager does not write, such as ``"pixels"``.

    Raises:
        TypeError: not a manager-based environment, or no representations.
        KeyError: a term is not declared (all are listed), or there is no such term.
        ValueError: a term has another size, or is clipped, scaled or modified such that it does not
            transform; the message names it.

    Example:
        >>> from torchrl_sym import PointGroup
        >>> from torchrl_sym.representations import axial, polar, signed_permutation
        >>> group = PointGroup.reflection("y")
        >>> swap = {"reflect-y": {"L_HAA": "-R_HAA", "R_HAA": "-L_HAA"}}
        >>> legs = signed_permutation(group, ["L_HAA", "R_HAA"], swap)
        >>> terms = {"base_lin_vel": polar(group), "base_ang_vel": axial(group)}
        >>> terms |= dict.fromkeys(["joint_pos", "joint_vel", "actions"], legs)
        >>> symmetry(env, terms, action=legs)  # doctest: +SKIP
    """
    manager = observation_manager(env)
    found = terms_of(manager)
    representations = given_terms(found, terms)
    missing = [term for term in found if term not in representations]
    if missing:
        raise KeyError(
            f"terms: expected a representation for every term, got none for "
            f"{ {term.label: term.frame for term in missing} }; add them by name, e.g. "
            "invariant(group, d) if no element changes them"
        )
    checks.instance("action", action, Representation)
    return assemble(manager, {term: representations[term] for term in found}, action, others)
