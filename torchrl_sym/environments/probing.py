"""Whether an environment's transforms commute with the group: tried out, not judged by their class.

What a symmetry declares is what an environment gives out and takes in, behind all of its transforms. A
transform in between may spoil it: measured constants, running statistics, a clip that is wider on one side.
It may be of any class, the user's own, in front of a concatenation, or inside a worker. So all of them are
tried out (:mod:`torchrl_sym.environments.trial`), shell by shell down to the bare environment. Where that
is impossible, only transforms that are known to keep statistics of each entry by itself are refused. So are
gymnasium's; of its other wrappers, which are part of the bare environment, nothing is known.
"""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Sequence

from tensordict import NestedKey
from torchrl.envs import EnvBase, Transform, TransformedEnv, VecNorm, VecNormV2

from torchrl_sym._torchrl import wrappers_of
from torchrl_sym.environments.inside import inside, shell, undisturbed
from torchrl_sym.environments.trial import Declared, Trial

_REMEDY = (
    "use SymmetricVecNorm (or SymmetricNorm inside networks) for running statistics, and constants that "
    "commute: equal for entries that change places, with location 0 for entries that change sign"
)


def check_transforms(env: EnvBase, declared: Declared) -> None:
    """Refuse transforms of declared entries that do not commute with the group, wherever they are.

    Neither the transforms nor the global random generators notice.

    Raises:
        ValueError: with the transform, the entry, the element and a remedy.
    """
    with undisturbed():
        _descend(env, declared)


def _descend(env: EnvBase, declared: Declared) -> None:
    if isinstance(env, TransformedEnv) and shell(env):
        declared = _check_shell(env, declared)
    _refuse_gymnasium(env, declared)
    with inside(env) as inner:
        for each in inner:
            _descend(each, declared)


def _check_shell(env: TransformedEnv, declared: Declared) -> Declared:
    """Refuse the transforms directly around an environment; returns what is known of the entries inside."""
    transforms = shell(env)
    trial = _trial(env, transforms, declared)
    if trial is None:  # some cannot be tried out: the others can
        related = _related(transforms, declared.keys)
        usable: list[Transform] = []
        for transform in transforms:
            if _trial(env, [*usable, transform], declared) is None:
                _refuse_untried(transform, related)
            else:
                usable.append(transform)
        trial = _trial(env, usable, declared)
        if trial is None:  # not even without transforms: an environment of a special kind
            return declared
    wrong = next(trial.violations(), None)
    if wrong is not None:
        guilty = [t for t in trial.transforms if _is_right_without(env, trial, t)] or trial.transforms
        called = " or ".join(dict.fromkeys(type(t).__name__ for t in guilty))
        raise ValueError(f"{called} does not commute with the symmetry: {wrong}; {_REMEDY}")
    if trial.undecided:
        for transform in trial.transforms:
            _refuse_statistics(transform, _related(transforms, declared.keys))
    return trial.inside


def _trial(env: TransformedEnv, transforms: Sequence[Transform], declared: Declared) -> Trial | None:
    """None if they cannot be tried out; without those that add noise, which would hide the others."""
    trial = _attempt(env, transforms, declared)
    if trial is None or not trial.is_random:
        return trial
    for count in range(1, len(transforms) + 1):  # the fewest that will do
        for left_out in itertools.combinations(transforms, count):
            trial = _attempt(env, [t for t in transforms if t not in left_out], declared)
            if trial is not None and not trial.is_random:
                known = all(_is_noise(env, t, transforms, trial) for t in left_out)
                return trial if known else None
    return None


def _attempt(env: TransformedEnv, transforms: Sequence[Transform], declared: Declared) -> Trial | None:
    try:
        return Trial(env, transforms, declared)
    except Exception:  # whatever a user's transform raises when it is away from its environment
        return None


def _is_noise(
    env: TransformedEnv, transform: Transform, transforms: Sequence[Transform], quiet: Trial
) -> bool:
    """Whether a transform makes random what was not; another may only need what it draws."""
    both = [t for t in transforms if t is transform or t in quiet.transforms]
    trial = _attempt(env, both, quiet.declared)
    return trial is not None and trial.is_random


def _is_right_without(env: TransformedEnv, trial: Trial, transform: Transform) -> bool:
    rest = _trial(env, [t for t in trial.transforms if t is not transform], trial.declared)
    return (
        rest is not None
        and bool((rest.judged | ~trial.judged).all())
        and next(rest.violations(), None) is None
    )


def _related(transforms: Sequence[Transform], keys: Sequence[NestedKey]) -> set[NestedKey]:
    """Declared entries, and those that they are made of."""
    related = set(keys)
    for transform in reversed(transforms):
        if related & {*transform.out_keys, *transform.in_keys}:
            related |= set(transform.in_keys)
    return related


def _refuse_untried(transform: Transform, related: set[NestedKey]) -> None:
    name, keys = type(transform).__name__, {*transform.in_keys, *transform.out_keys}
    if keys and not keys & related and not {*transform.in_keys_inv, *transform.out_keys_inv} & related:
        return  # a counter, say
    _refuse_statistics(transform, related)
    warnings.warn(
        f"{name} cannot be tried out away from its environment: whether it commutes with the symmetry is "
        "not known; make sure that it does",
        stacklevel=2,
    )


def _refuse_gymnasium(env: EnvBase, declared: Declared) -> None:
    observed = set(declared.keys) & {*env.observation_spec.keys(True, True)}
    for wrapper in wrappers_of(env) if observed else []:
        classes = [kind.__name__ for kind in type(wrapper).__mro__]
        if "NormalizeObservation" in classes and not getattr(wrapper, "is_symmetric", False):
            raise ValueError(
                f"gymnasium's {type(wrapper).__name__} keeps statistics of each entry of "
                f"{sorted(map(str, observed))}, which are not symmetric; leave it out, and {_REMEDY}"
            )


def _refuse_statistics(transform: Transform, related: set[NestedKey]) -> None:
    touched = related & {*transform.in_keys, *transform.out_keys}
    running = isinstance(transform, VecNorm | VecNormV2) and not getattr(transform, "is_symmetric", False)
    if running and touched:
        raise ValueError(
            f"{type(transform).__name__} keeps statistics of each entry of {sorted(map(str, touched))}, "
            f"which are not symmetric; {_REMEDY}"
        )
