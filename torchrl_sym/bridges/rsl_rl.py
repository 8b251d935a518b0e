"""rsl_rl's data augmentation function, made of a symmetry.

rsl_rl (Isaac Lab and mjlab train with it) takes symmetric copies from one function of the user's. It is
called with a batch of observations, a TensorDict of *groups* such as ``policy`` and ``critic``, with
actions, or with one of the two, and returns them for all elements, group-major: all originals, then all
copies under the next element. Nothing checks what it returns. The functions in circulation map the policy's
group and leave that of the critic or the height scan as it is, so that the critic is taught that a mirrored
state has the value of another one.

Here every group is mapped, by the representation that the symmetry declares for it, or the batch is
refused.
"""

from __future__ import annotations

from typing import Any, Protocol

from tensordict import NestedKey, TensorDict
from torch import Tensor

from torchrl_sym import checks
from torchrl_sym.symmetry import Symmetry, check_batch, check_symmetry


class Augmentation(Protocol):
    """The function that rsl_rl calls."""

    def __call__(
        self, env: Any, obs: TensorDict | None, actions: Tensor | None
    ) -> tuple[TensorDict | None, Tensor | None]:
        """Observations ``[B]`` and actions ``(B, d)`` to ``[N * B]`` and ``(N * B, d)``."""
        ...


def data_augmentation(symmetry: Symmetry, *, action_key: NestedKey = "action") -> Augmentation:
    """The function to be given to rsl_rl as ``data_augmentation_func``.

    rsl_rl finds a function by its name, too. Where the configuration must be text, as in Isaac Lab's, keep
    the function in a module of yours, ``augment = data_augmentation(Symmetry.load("anymal.json"))``, and
    write ``"my_module:augment"``.

    Args:
        symmetry: declares every group of observations by its name, whoever reads it, and the action.
            Whether it is strict makes no difference: what is observed is never left as it is.
        action_key: under which key it declares the action.

    Returns:
        The function. It raises KeyError for a group of observations that is not declared, ValueError for
        one of another size, and TypeError where observations come as anything but a TensorDict.

    Raises:
        TypeError: no symmetry, or no key.
        KeyError: the action is not declared.

    Example:
        >>> import torch
        >>> from torchrl_sym import PointGroup
        >>> from torchrl_sym.representations import invariant, polar, pseudoscalar
        >>> group = PointGroup.reflection("y")
        >>> declared = {"policy": polar(group), "critic": polar(group) + invariant(group, 1)}
        >>> augment = data_augmentation(Symmetry(group, declared | {"action": pseudoscalar(group)}))
        >>> obs = TensorDict(policy=torch.ones(1, 3), critic=torch.ones(1, 4), batch_size=[1])
        >>> obs, actions = augment(env=None, obs=obs, actions=torch.ones(1, 1))
        >>> obs["critic"], actions  # the originals first
        (tensor([[ 1.,  1.,  1.,  1.],
                [ 1., -1.,  1.,  1.]]), tensor([[ 1.],
                [-1.]]))
    """
    action = check_symmetry(symmetry)[checks.key("action_key", action_key)]

    def augment(
        env: Any, obs: TensorDict | None, actions: Tensor | None
    ) -> tuple[TensorDict | None, Tensor | None]:
        del env  # what the symmetry needs to know of it is declared
        return (
            None if obs is None else _all_images(symmetry, obs),
            None if actions is None else action.orbit(actions).flatten(0, 1),
        )

    return augment


def _all_images(symmetry: Symmetry, obs: TensorDict) -> TensorDict:
    groups = list(check_batch(obs).keys(True, True))
    missing = [group for group in groups if group not in symmetry]
    if missing:
        raise KeyError(
            f"the observations have {missing}, which this symmetry does not transform (it has "
            f"{symmetry.keys()}); add them, e.g. invariant(group, d) if no element changes them"
        )
    return symmetry.orbit(obs, keys=groups).flatten(0, 1)
