"""Mirror loss: penalises how far a policy is from treating symmetric states alike.

Eq. (symm-loss) of Mittal et al., after Yu, Turk and Liu 2018::

    L_sym(theta) = sum_g E_s || K_g[pi_theta(s)] - pi_theta(L_g[s]) ||^2

where K_g[pi(s)] is a label: gradients flow through pi(L_g[s]) only. The loss stands on its own, so that
it goes beside any other objective (PPO, SAC, TD3), and under ``torch.no_grad`` it is the paper's
symmetry metric. The same equation holds for a critic, whose value no element changes:
V(L_g[s]) = V(s) and Q(L_g[s], K_g[a]) = Q(s, a).
"""

from __future__ import annotations

import functools
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule, dispatch
from torch import Tensor
from torchrl.objectives import LossModule

from torchrl_sym import checks
from torchrl_sym.memory import Memory
from torchrl_sym.networks import Effect, HeldNetwork, check_network, evaluating, inputs
from torchrl_sym.outputs import compared, deterministic_action, is_q_function, output_key, own_keys
from torchrl_sym.representations import Representation
from torchrl_sym.symmetry import Symmetry, check_symmetry


def mirror_error(
    output: Tensor,
    source: Tensor,
    act: Representation | None,
    g: Sequence[int] | Tensor,
    *,
    stop_gradient: bool = True,
) -> Tensor:
    """The terms || K_g[pi(s)] - pi(L_g[s]) ||^2 of Eq. (symm-loss).

    Args:
        output: pi(L_g[s]): ``(n, *B, *event)`` for n elements, ``(*B, *event)`` for one element per row.
        source: pi(s), from the original rows: ``(*B, *event)``.
        act: K_g; None for a vector that no element changes, such as a value.
        g: indices of the n elements, or of each row's element, ``(*B,)``.
        stop_gradient: treat K_g[pi(s)] as a label.

    Returns:
        ``(n, *B)``, of which the loss of a row is the sum over the elements; or ``(*B,)``, of which N times
        the mean over uniformly drawn elements is that sum.

    Example:
        >>> import torch
        >>> from torchrl_sym import PointGroup
        >>> from torchrl_sym.representations import pseudoscalar
        >>> sign = pseudoscalar(PointGroup.reflection("x"))
        >>> mirror_error(torch.tensor([[2.0], [1.0]]), torch.tensor([2.0]), sign, [0, 1])
        tensor([0., 9.])
    """
    with torch.set_grad_enabled(torch.is_grad_enabled() and not stop_gradient):
        if act is None:
            label = source
        elif isinstance(g, Tensor):
            label = act.per_row(source, g)
        else:
            label = torch.stack([act(source, element) for element in g])
    dims = 1 if act is None else len(act.event_shape)
    return (output - label).pow(2).sum(tuple(range(-dims, 0)))


class MirrorLoss(LossModule):
    """Squared distance between the mirrored action and the action in the mirrored state.

    Sums over the group and over action entries, as the paper does; the batch is reduced by
    ``reduction``. Implementations that average over copies and entries instead (rsl_rl) need the weight
    ``w_rsl = w * (N - 1) * action_dim`` for the same gradient.

    What a network writes is compared as it transforms: the deterministic action (mean of a Gaussian,
    squashed mean of a TanhNormal, probabilities of one-hot actions); the vector of action values of a
    ``QValueActor`` or of a discrete Q function, like a one-hot action; the values V(s) and Q(s, a), which
    no element changes. Networks are evaluated without dropout and by running statistics, so that the loss
    of an exactly symmetric one is zero.

    A loss that expands a network (SAC, TD3, REDQ, CrossQ, IQL, CQL) trains parameters of its own:
    :meth:`of` reaches them.

    Args:
        actor_network: probabilistic actor, or a module that writes the action or a value.

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

    Attributes:
        patience: number of gradients that may be added up in the network's parameters before somebody
            clears them or changes the parameters, 100; more is an error, for then no optimizer holds them.

    Raises:
        KeyError: the network reads or writes a key that the symmetry does not declare.
        ValueError: a weight or a reduction that is none; action values of a signed action.
        TypeError: an argument of another type, or of a name that is not above.
        RuntimeError: when called, if the loss cannot move the network's trainable parameters.

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
            action_value: one value for each discrete action. Defaults to ``"action_value"``.
            state_action_value: the output of Q(s, a). Defaults to ``"state_action_value"``.
            value: the output of a critic. Defaults to ``"state_value"``.
        """

        action: NestedKey = "action"
        action_value: NestedKey = "action_value"
        state_action_value: NestedKey = "state_action_value"
        value: NestedKey = "state_value"

    default_keys = _AcceptedKeys
    tensor_keys: _AcceptedKeys
    actor_network: TensorDictModule
    actor_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams
    coeff: Tensor
    patience: int = 100
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
        borrowed = isinstance(actor_network, HeldNetwork)  # of another loss
        if not borrowed:
            check_network("actor_network", actor_network)
        check_symmetry(symmetry)
        checks.real("coeff", coeff, 0.0)
        self._functional = checks.flag("functional", functional)
        self._in_keys: list[NestedKey] | None = None
        self._out_keys: list[NestedKey] | None = None
        self._compared: tuple[NestedKey, Representation | None] | None = None
        super().__init__()
        self._held = self._borrow(actor_network) if borrowed else self._hold(actor_network)
        self._effect = Effect(self._held)
        self.symmetry = symmetry
        self.stop_gradient = checks.flag("stop_gradient", stop_gradient)
        self.per_element = checks.flag("per_element", per_element)
        reduction = "mean" if reduction is None else reduction
        self.reduction = checks.one_of("reduction", reduction, ("none", "mean", "sum"))
        device = next((p.device for p in self._held.parameters()), torch.device("cpu"))
        self.register_coeff_buffer("coeff", coeff, device=device)
        self.set_keys(**own_keys(self.actor_network, symmetry, self.tensor_keys))
        if output_key(self.actor_network, self.tensor_keys):  # else it may still be named with set_keys
            self._find_output()
        copies = symmetry.group.order > 1
        self.memory = Memory.of(symmetry, [self.actor_network], burn_in=burn_in, copies=copies)
        symmetry.require(self.in_keys, "the network")

    @classmethod
    def of(cls, loss: LossModule, network: str = "qvalue_network", **options: Any) -> MirrorLoss:
        """Mirror loss of a network inside a loss, through the parameters which that loss trains.

        Nothing is registered twice: the mirror loss has no parameter of its own, in ``parameters()`` or in
        the ``state_dict``, and target networks are left alone. The loss of an ensemble is the sum over its
        members, like the temporal-difference losses beside it: each member has the gradient that it would
        have alone. The label of a copy comes from the same member's value of the original. Set keys of the
        loss before.

        Two mirror losses beside one objective both write ``loss_mirror``: add them up.

        Args:
            loss: any loss of TorchRL, with its networks.
            network: the name under which the loss keeps it, such as ``"qvalue_network"``,
                ``"actor_network"``, ``"value_network"`` or ``"critic_network"``.
            **options: those of :class:`MirrorLoss`, without ``functional``.

        Raises:
            ValueError: the loss has no such network; the message lists those it has.
            TypeError: no loss, or a name that is no option.

        Example:
            >>> import torch
            >>> from tensordict import TensorDict
            >>> from tensordict.nn import TensorDictModule
            >>> from torch import nn
            >>> from torchrl.modules import MLP, ValueOperator
            >>> from torchrl.objectives import TD3Loss
            >>> from torchrl_sym import MirrorLoss, PointGroup, Symmetry
            >>> from torchrl_sym.representations import pseudoscalar
            >>> group = PointGroup.reflection("x")
            >>> sign = pseudoscalar(group)
            >>> symmetry = Symmetry(group, {"observation": sign * 3, "action": sign})
            >>> actor = TensorDictModule(nn.Linear(3, 1), in_keys=["observation"], out_keys=["action"])
            >>> qvalue = ValueOperator(MLP(4, 1, num_cells=[8]), in_keys=["observation", "action"])
            >>> objective = TD3Loss(actor, qvalue, bounds=(-1.0, 1.0))
            >>> mirror = MirrorLoss.of(objective, "qvalue_network", symmetry=symmetry)
            >>> batch = TensorDict(observation=torch.randn(8, 3), action=torch.randn(8, 1), batch_size=[8])
            >>> mirror(batch)["loss_mirror"].backward()
            >>> objective.qvalue_network_params["module", "0", "weight"].grad.shape  # of both members
            torch.Size([2, 8, 4])
        """
        accepted = [name for name in checks.keywords(cls) if name not in ("actor_network", "functional")]
        checks.refuse_unknown(f"{cls.__name__}.of", options, accepted)
        return cls(HeldNetwork.inside(loss, network), functional=False, **options)  # pyright: ignore[reportArgumentType]

    def _hold(self, network: TensorDictModule) -> HeldNetwork:
        if not self.functional:
            self.actor_network = network
            self.actor_network_params = None  # type: ignore[assignment]
            return HeldNetwork(network)
        self.convert_to_functional(network, "actor_network")
        return HeldNetwork(network, self.actor_network_params)

    def _borrow(self, inside: HeldNetwork) -> HeldNetwork:
        object.__setattr__(self, "actor_network", inside.module)  # unregistered: another has its parameters
        known = self._AcceptedKeys.__dataclass_fields__
        self.set_keys(**{name: key for name, key in inside.keys.items() if name in known})
        return inside

    @property
    def functional(self) -> bool:
        """Whether parameters are held apart from the module."""
        return self._functional

    def _forward_value_estimator_keys(self, **kwargs) -> None:
        self._in_keys = self._compared = None

    @property
    def in_keys(self) -> list[NestedKey]:
        """What the network reads."""
        if self._in_keys is None:
            self._in_keys = self.symmetry.together(inputs(self.actor_network))
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

    def _find_output(self) -> tuple[NestedKey, Representation | None]:
        """Key of what is compared, and K_g; found once for each choice of keys."""
        if self._compared is None:
            network, keys = self.actor_network, self.tensor_keys
            self._compared = compared(network, self.symmetry, keys)
            if not self._held.borrowed and is_q_function(network, keys):
                warnings.warn(_COPIES, UserWarning, stacklevel=3)
        return self._compared

    def _output(self, tensordict: TensorDictBase) -> Tensor:
        """What is compared, of rows ``[*B]``."""
        if hasattr(self.actor_network, "get_dist"):
            return deterministic_action(self.actor_network.get_dist(tensordict))
        key, _ = self._find_output()
        out = self.actor_network(tensordict).get(key)
        if out.ndim <= tensordict.batch_dims:
            raise ValueError(
                f"expected {key!r} of a shape that continues the batch size "
                f"{tuple(tensordict.batch_size)}, such as (*B, 1), got {tuple(out.shape)}"
            )
        return out

    def _error(self, orbit: TensorDictBase) -> Tensor:
        """Error of each element, that of the identity left out where it is not needed."""
        _, act = self._find_output()
        elements = range(len(orbit))
        if self.stop_gradient and len(orbit) > 1:
            with torch.no_grad():
                source = self._output(orbit[0])
            return mirror_error(self._images(orbit[1:]), source, act, elements[1:])
        output = self._images(orbit)
        return mirror_error(output, output[0], act, elements, stop_gradient=self.stop_gradient)

    def _images(self, orbit: TensorDictBase) -> Tensor:
        """What is compared, of ``[n, *B]``; as rows, since many networks take no more dimensions."""
        rows = orbit.reshape(-1, *orbit.batch_size[2:])
        return self._output(rows).unflatten(0, orbit.batch_size[:2])

    @dispatch  # pyright: ignore[reportArgumentType]
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Compute ``loss_mirror``; the input is not modified."""
        tensordict = batched(tensordict.clone(False), self.in_keys[0], self.symmetry)
        tensordict = self.memory.prepare(tensordict, self._loss_mask_keys())
        state = tensordict.select(*self.symmetry.together(self.in_keys), strict=False)
        orbit = self.memory.rebuild(self.symmetry.orbit(state))  # [N, *B], identity first
        with evaluating(self.actor_network):
            members = self._held.each(lambda: self._error(orbit))
        error = functools.reduce(torch.add, members)  # (N or N - 1, *B)
        self._effect.require(error, self.patience)

        loss = self.coeff * error.sum(0)
        td_out = TensorDict(loss_mirror=self._reduce_loss(loss, tensordict))
        if self.per_element:
            rows = [self._reduce_loss(row, tensordict, reduction="mean") for row in error.detach()]
            identity = [torch.zeros_like(rows[0])] * (len(orbit) - len(rows))
            td_out.set("mirror_error", torch.stack([*identity, *rows]))
        self._clear_weakrefs(td_out, self._held.params)
        return td_out


# A network of this kind is often that of a loss which trains copies of it.
_COPIES = (
    "MirrorLoss has been given a Q function. SACLoss, TD3Loss, REDQLoss, CrossQLoss, IQLLoss, CQLLoss and "
    "DiscreteSACLoss train copies of the one that they are given, which a mirror loss on the original does "
    "not reach: use MirrorLoss.of(loss, 'qvalue_network', symmetry=...)"
)


def batched(tensordict: TensorDictBase, key: NestedKey, symmetry: Symmetry) -> TensorDictBase:
    """Give a tensordict that a keyword call has built the batch size of one of its entries.

    ``dispatch`` takes the longest shape that all entries share, at times with event dimensions.
    """
    value = tensordict.get(key, None)
    if value is None:
        raise KeyError(
            f"expected an entry {key!r}, which the network reads; the batch has "
            f"{sorted(map(str, tensordict.keys(include_nested=True, leaves_only=True)))}"
        )
    if isinstance(value, TensorDictBase):
        return tensordict  # a group, whose own size does not tell
    size = value.shape[: value.ndim - symmetry.event_dims(key)]
    if tensordict.batch_dims == 0 or tensordict.batch_dims > len(size):
        tensordict.batch_size = size  # pyright: ignore[reportAttributeAccessIssue]
    return tensordict
