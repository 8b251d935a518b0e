"""Mirror loss: penalises how far a policy is from treating symmetric states alike.

Eq. (symm-loss) of Mittal et al., after Yu, Turk and Liu 2018::

    L_sym(theta) = sum_g E_s || K_g[pi_theta(s)] - pi_theta(L_g[s]) ||^2

where K_g[pi(s)] is a label: gradients flow through pi(L_g[s]) only. The loss stands on its own, so that
it goes beside any other objective (PPO, SAC, TD3), and under ``torch.no_grad`` it is the paper's
symmetry metric.
"""

from __future__ import annotations

import contextlib
import copy
from dataclasses import dataclass

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule, TensorDictModuleBase, dispatch
from torch import Tensor
from torchrl.modules import OneHotCategorical
from torchrl.objectives import LossModule

from torchrl_sym import checks
from torchrl_sym.memory import Memory
from torchrl_sym.representations import Representation, invariant
from torchrl_sym.symmetry import Symmetry, check_symmetry


class MirrorLoss(LossModule):
    """Squared distance between the mirrored action and the action in the mirrored state.

    Sums over the group and over action entries, as the paper does; the batch is reduced by
    ``reduction``. Implementations that average over copies and entries instead (rsl_rl) need the weight
    ``w_rsl = w * (N - 1) * action_dim`` for the same gradient.

    The deterministic action is compared (mean of a Gaussian, squashed mean of a TanhNormal). A
    deterministic policy works as well, and so does a critic, whose value must be invariant.

    Args:
        actor_network: probabilistic actor, or a module that writes the action or the state value.

    Keyword Args:
        symmetry: what transforms how; must declare everything that the network reads.
        coeff: weight w, finite and not negative; schedulable (``loss.coeff = 0.1``). Defaults to 1.
        stop_gradient: treat K_g[pi(s)] as a label. Defaults to ``True``, as in the paper.
        reduction: ``"mean"`` (default), ``"sum"`` or ``"none"`` over the batch.
        per_element: also return ``mirror_error``, the unweighted error of each element, ``(N,)``.
        burn_in: for recurrent networks: the first steps of a sequence that begins with a stored memory
            other than zero, which rebuild the copies' memory and do not count. Defaults to 0: such
            sequences are refused.
        functional: as in other TorchRL losses. Defaults to ``True``.

    Raises:
        KeyError: the network reads or writes a key that the symmetry does not declare.
        ValueError: a weight or a reduction that is none.
        TypeError: an argument of another type, or of a name that is not above.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl_sym import MirrorLoss, PointGroup, Symmetry
        >>> from torchrl_sym.representations import pseudoscalar
        >>> group = PointGroup.reflection("x")
        >>> symmetry = Symmetry(group, {"observation": pseudoscalar(group), "action": pseudoscalar(group)})
        >>> actor = TensorDictModule(lambda x: x + 1.0, in_keys=["observation"], out_keys=["action"])
        >>> loss = MirrorLoss(actor, symmetry=symmetry, functional=False)
        >>> loss(TensorDict(observation=torch.zeros(4, 1), batch_size=[4]))["loss_mirror"]
        tensor(4.)
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that can be set with ``.set_keys(key=value)``.

        Attributes:
            action: the action, or the action of a deterministic policy. Defaults to ``"action"``.
            value: the output of a critic. Defaults to ``"state_value"``.
        """

        action: NestedKey = "action"
        value: NestedKey = "state_value"

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    actor_network: TensorDictModule
    actor_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams
    coeff: Tensor
    _schedulable_buffers = frozenset({"coeff"})

    @checks.near_names
    def __init__(
        self,
        actor_network: TensorDictModule,
        *,
        symmetry: Symmetry,
        coeff: float = 1.0,
        stop_gradient: bool = True,
        reduction: str | None = None,
        per_element: bool = False,
        burn_in: int = 0,
        functional: bool = True,
    ) -> None:
        check_network("actor_network", actor_network)
        check_symmetry(symmetry)
        checks.real("coeff", coeff, 0.0)
        self._functional = checks.flag("functional", functional)
        self._in_keys: list[NestedKey] | None = None
        self._out_keys: list[NestedKey] | None = None
        super().__init__()
        if functional:
            self.convert_to_functional(actor_network, "actor_network")
        else:
            self.actor_network = actor_network
            self.actor_network_params = None  # type: ignore[assignment]
        self.symmetry = copy.deepcopy(symmetry)  # to(device) must not move the caller's
        self.stop_gradient = checks.flag("stop_gradient", stop_gradient)
        self.per_element = checks.flag("per_element", per_element)
        reduction = "mean" if reduction is None else reduction
        self.reduction = checks.one_of("reduction", reduction, ("none", "mean", "sum"))
        self.register_coeff_buffer("coeff", coeff)
        self._follow_network()
        if self._is_policy():  # any other output may still be named with set_keys
            self._output_representation()
        copies = symmetry.group.order > 1
        self.memory = Memory.of(symmetry, [actor_network], burn_in=burn_in, copies=copies)
        symmetry.require(actor_network.in_keys, "the network")

    @property
    def functional(self) -> bool:
        """Whether parameters are held apart from the module."""
        return self._functional

    def _forward_value_estimator_keys(self, **kwargs) -> None:
        self._in_keys = None

    @property
    def in_keys(self) -> list[NestedKey]:
        """What the network reads."""
        if self._in_keys is None:
            self._in_keys = list(self.actor_network.in_keys)
        return self._in_keys

    @in_keys.setter
    def in_keys(self, values: list[NestedKey]) -> None:
        self._in_keys = values

    @property
    def out_keys(self) -> list[NestedKey]:
        """``loss_mirror``, and ``mirror_error`` with ``per_element=True``."""
        if self._out_keys is None:
            extra: list[NestedKey] = ["mirror_error"] if self.per_element else []
            self._out_keys = ["loss_mirror", *extra]
        return self._out_keys

    @out_keys.setter
    def out_keys(self, values: list[NestedKey]) -> None:
        self._out_keys = values

    def _follow_network(self) -> None:
        """Take over the key of the action that the network writes, where it can be told."""
        network, keys = self.actor_network, self.tensor_keys
        written = network.out_keys
        if hasattr(network, "dist_sample_keys"):
            self.set_keys(action=single_action(network))
        elif keys.action not in written and keys.value not in written:
            declared = set(self.symmetry.keys()) & set(written) - set(network.in_keys)
            if len(declared) == 1:
                self.set_keys(action=declared.pop())

    def _is_policy(self) -> bool:
        network = self.actor_network
        return self.tensor_keys.action in network.out_keys or hasattr(network, "get_dist")

    def _output_representation(self) -> Representation:
        """K_g of what the network puts out; a critic's value is invariant."""
        written = self.actor_network.out_keys
        if self._is_policy():
            return self.symmetry[self.tensor_keys.action]
        if self.tensor_keys.value in written:
            return invariant(self.symmetry.group, 1)
        raise KeyError(
            f"the network writes {written}, neither the action {self.tensor_keys.action!r} nor the value "
            f"{self.tensor_keys.value!r}; name its output with set_keys(action=...) or set_keys(value=...)"
        )

    def _output(self, tensordict: TensorDictBase) -> Tensor:
        with (
            self.actor_network_params.to_module(self.actor_network, preserve_module_state=False)
            if self.functional
            else contextlib.nullcontext()
        ):
            if hasattr(self.actor_network, "get_dist"):
                return deterministic_action(self.actor_network.get_dist(tensordict))
            out = self.actor_network(tensordict)
        key = self.tensor_keys.action
        return out.get(key if key in self.actor_network.out_keys else self.tensor_keys.value)

    @dispatch  # pyright: ignore[reportArgumentType]
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Compute ``loss_mirror``; the input is not modified."""
        tensordict = batched(tensordict.clone(False), self.in_keys[0])
        tensordict = self.memory.prepare(tensordict, self._loss_mask_keys())
        state = tensordict.select(*self.actor_network.in_keys, strict=False)
        orbit = self.memory.rebuild(self.symmetry.orbit(state))  # [N, *B], identity first
        act = self._output_representation()
        if self.stop_gradient and len(orbit) > 1:
            with torch.no_grad():
                label = act.orbit(self._output(orbit[0]))  # K_g[pi(s)]
            error = squared_distance(self._output(orbit[1:]), label[1:])  # (N - 1, *B)
        else:
            output = self._output(orbit)
            label = act.orbit(output[0])
            label = label.detach() if self.stop_gradient else label
            error = squared_distance(output, label)  # (N, *B), zero for the identity
        td_out = TensorDict(loss_mirror=self.coeff * error.sum(0))
        if self.per_element:
            per_element = error.detach().flatten(1).mean(1)
            td_out.set("mirror_error", torch.cat([per_element.new_zeros(1), per_element])[-len(orbit) :])
        td_out = td_out.named_apply(
            lambda name, value: self._reduce_loss(value, tensordict) if name.startswith("loss_") else value
        )
        self._clear_weakrefs(td_out, "actor_network_params", "target_actor_network_params")
        return td_out


def check_network(name: str, network: TensorDictModule) -> None:
    """TypeError unless a network reads and writes tensordicts."""
    remedy = "wrap a network in TensorDictModule, ProbabilisticActor or ValueOperator"
    checks.instance(name, network, TensorDictModuleBase, remedy)


def single_action(actor: TensorDictModule) -> NestedKey:
    """Key of the action that a probabilistic actor samples.

    Raises:
        ValueError: the actor has several action heads, for which no distance is defined.
    """
    keys = actor.dist_sample_keys
    if len(keys) != 1:
        raise ValueError(f"the mirror loss compares one action, got an actor with {keys}; join its heads")
    return keys[0]


def deterministic_action(dist: torch.distributions.Distribution) -> Tensor:
    """The action pi(s) of a distribution: its deterministic sample, or its mean."""
    if isinstance(dist, OneHotCategorical | torch.distributions.OneHotCategorical):
        return dist.probs  # the mode has no gradient; a permutation maps the probabilities alike
    if isinstance(dist, torch.distributions.Categorical):
        raise TypeError(
            "expected an action that a representation can map, got an integer from a Categorical; use "
            "one-hot actions (OneHotCategorical) with a permutation"
        )
    sample = getattr(dist, "deterministic_sample", None)
    return dist.mean if sample is None else sample


def squared_distance(output: Tensor, label: Tensor) -> Tensor:
    """Sum of squared differences over the last dimension."""
    return (output - label).pow(2).sum(-1)


def batched(tensordict: TensorDictBase, key: NestedKey) -> TensorDictBase:
    """Give a tensordict that a keyword call has built the batch size of one of its entries.

    ``dispatch`` takes the longest shape that all entries share, at times with their last dimension.
    """
    value = tensordict.get(key, None)
    if value is None:
        raise KeyError(
            f"expected an entry {key!r}, which the network reads; the batch has "
            f"{sorted(map(str, tensordict.keys(include_nested=True, leaves_only=True)))}"
        )
    if tensordict.batch_dims in (0, value.ndim):
        tensordict.batch_size = value.shape[:-1]  # pyright: ignore[reportAttributeAccessIssue]
    return tensordict
