"""PPO on the symmetric copies of every sample, with the original probabilities.

Eq. (sym-aug) of Mittal et al.: for a sample (s, a) of the rollout policy pi_k and every element g,::

    ratio_g = pi_theta(K_g[a] | L_g[s]) / pi_k(a | s)        advantage_g = A_k(s, a)

The denominator and the advantage are those of the original. This is what distinguishes the rule from
naive augmentation, whose denominator pi_k(K_g[a] | L_g[s]) can be arbitrarily small.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase, is_tensor_collection
from tensordict.nn import (
    CompositeDistribution,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    dispatch,
)
from tensordict.utils import unravel_key
from torch import Tensor
from torchrl.modules.distributions.utils import has_analytic_entropy
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.utils import distance_loss

from torchrl_sym import checks
from torchrl_sym._torchrl import broadcast_advantage_to_log_weight, check_advantage_broadcast
from torchrl_sym.memory import Memory
from torchrl_sym.mirror_loss import batched, mirror_error
from torchrl_sym.networks import check_network, inputs
from torchrl_sym.orbits import Copies, variance
from torchrl_sym.outputs import deterministic_action, single_action
from torchrl_sym.symmetry import Elements, Symmetry, check_symmetry

# Numbers of ClipPPOLoss and the least they may be; a negative weight of the entropy has its uses.
_LEAST = {"clip_epsilon": 0.0, "critic_coeff": 0.0, "clip_value": 0.0, "entropy_coeff": None}


class SymmetricClipPPOLoss(ClipPPOLoss):
    """:class:`~torchrl.objectives.ClipPPOLoss` on the orbit of every sample.

    Expands, inside the loss, only what the loss reads. Advantage estimation and normalisation see the
    original rows; entropy, ``kl_approx``, ``clip_fraction``, ``ESS`` and the ratios are those of the
    original rows too, so that a KL-adaptive learning rate reacts to the policy's change and not to its
    asymmetry. The same diagnostics per element, ``(N,)``, are ``kl_approx_sym``, ``clip_fraction_sym``
    and ``ESS_sym``.

    The surrogate and the value loss are means over N * B rows: 1/N of the paper's sum over g, which
    keeps the balance with the entropy bonus and the learning rate of plain PPO. With the trivial group
    the loss and its gradients are those of ``ClipPPOLoss`` to the last bit.

    Args:
        actor_network: as in ``ClipPPOLoss``.
        critic_network: as in ``ClipPPOLoss``.

    Keyword Args:
        symmetry: what transforms how; must declare everything that actor and critic read, and the action.
        elements: ``"all"``; names of a subset (the identity is always kept); or ``"random"``: each row
            is mapped by one uniformly drawn element, which has the same expected gradient at 1/N of the
            cost. Diagnostics and entropy then come from the rows that drew the identity.
        mirror_coeff: weight w of the mirror loss (Eq. symm-loss), finite and not negative, added as
            ``loss_mirror``; it reuses the actor's pass over the orbit. 0 leaves it out. Schedulable when
            positive.
        burn_in: for recurrent networks: the first steps of a sequence that begins with a stored memory
            other than zero, which rebuild the copies' memory and count neither for them nor for their
            originals. Defaults to 0: such sequences are refused.
        **clip_ppo_kwargs: everything ``ClipPPOLoss`` accepts, and nothing that it would ignore.

    Raises:
        KeyError: a network reads a key, or the action is one, that the symmetry does not declare; or
            there is no such element.
        ValueError: a number that is not finite or out of range; in a call, sequences whose copies would
            begin from a wrong memory.
        TypeError: an argument of another type, or of a name that neither loss knows.

    Example:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import NormalParamExtractor, TensorDictModule
        >>> from torch import nn
        >>> from torchrl.modules import IndependentNormal, ProbabilisticActor, ValueOperator
        >>> from torchrl_sym import PointGroup, SymmetricClipPPOLoss, Symmetry
        >>> from torchrl_sym.representations import pseudoscalar
        >>> group = PointGroup.reflection("x")
        >>> sign = pseudoscalar(group)
        >>> net = nn.Sequential(nn.Linear(3, 2), NormalParamExtractor())
        >>> actor = ProbabilisticActor(
        ...     TensorDictModule(net, ["observation"], ["loc", "scale"]),
        ...     in_keys=["loc", "scale"],
        ...     distribution_class=IndependentNormal,
        ...     return_log_prob=True,
        ... )
        >>> critic = ValueOperator(nn.Linear(3, 1), in_keys=["observation"])
        >>> loss = SymmetricClipPPOLoss(
        ...     actor, critic, symmetry=Symmetry(group, {"observation": sign * 3, "action": sign})
        ... )
        >>> batch = TensorDict(
        ...     observation=torch.randn(8, 3),
        ...     action=torch.randn(8, 1),
        ...     action_log_prob=torch.zeros(8),
        ...     advantage=torch.randn(8, 1),
        ...     value_target=torch.randn(8, 1),
        ...     batch_size=[8],
        ... )
        >>> loss(batch)["kl_approx_sym"].shape
        torch.Size([2])
    """

    mirror_coeff: Tensor
    entropy_coeff: Tensor
    critic_coeff: Tensor
    clip_value: Tensor | None

    def __init__(
        self,
        actor_network: ProbabilisticTensorDictSequential | None = None,
        critic_network: TensorDictModule | None = None,
        *,
        symmetry: Symmetry,
        elements: Elements = "all",
        mirror_coeff: float = 0.0,
        burn_in: int = 0,
        **clip_ppo_kwargs,
    ) -> None:
        check_symmetry(symmetry)
        checks.real("mirror_coeff", mirror_coeff, 0.0)
        _check_numbers(clip_ppo_kwargs)
        actor = clip_ppo_kwargs.get("actor", actor_network)
        check_network("actor_network", actor)
        if not hasattr(actor, "get_dist"):
            raise TypeError(
                "actor_network: expected a distribution of actions; wrap it in ProbabilisticActor"
            )
        critic = clip_ppo_kwargs.get("critic", critic_network)
        if critic is not None:
            check_network("critic_network", critic)
        super().__init__(actor_network, critic_network, **clip_ppo_kwargs)
        # afterwards, for TorchRL has messages of its own for names that it has removed
        accepted = checks.keywords(SymmetricClipPPOLoss)
        checks.refuse_unknown(type(self).__name__, clip_ppo_kwargs, accepted)
        self.symmetry = symmetry
        self.random = elements == "random" and symmetry.group.order > 1  # else there is nothing to draw
        self.elements = symmetry.elements(elements)
        self._mirrors = mirror_coeff > 0
        # decided here: a number on an accelerator could not be asked without waiting for it
        self._clips_value = self.clip_value is not None and bool(self.clip_value)
        if self._mirrors:
            self.register_coeff_buffer("mirror_coeff", mirror_coeff, device=self.entropy_coeff.device)
            single_action(self.actor_network)
        networks = (self.actor_network, self.critic_network)
        copies = len(self.elements) > 1
        self.memory = Memory.of(self.symmetry, networks, burn_in=burn_in, copies=copies)
        self._require_keys()

    _schedulable_buffers = ClipPPOLoss._schedulable_buffers | {"mirror_coeff"}

    def set_keys(self, **kwargs) -> None:
        """Set tensordict keys, as in ``ClipPPOLoss``; new keys must be known to the symmetry."""
        super().set_keys(**kwargs)
        if hasattr(self, "symmetry"):  # the parent's constructor sets keys before ours runs
            self._require_keys()

    def _require_keys(self) -> None:
        self.symmetry.require(_inputs(self.actor_network), "the actor")
        self.symmetry.require(self._critic_inputs(), "the critic")
        self.symmetry.require(_as_list(self.tensor_keys.action), "the surrogate objective")

    @property
    def out_keys(self) -> list[NestedKey]:
        """Those of ``ClipPPOLoss``, the diagnostics per element, and ``loss_mirror`` if it is on."""
        if self._out_keys is None:
            keys = [*super().out_keys, "kl_approx_sym", "clip_fraction_sym", "ESS_sym"]
            self._out_keys = [*keys, "loss_mirror"] if self._mirrors else keys
        return self._out_keys

    @out_keys.setter
    def out_keys(self, values: list[NestedKey]) -> None:
        self._out_keys = values

    @dispatch  # pyright: ignore[reportArgumentType]
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Compute the losses; the input is not modified."""
        td = batched(tensordict.clone(False), self.actor_network.in_keys[0], self.symmetry)
        self._prepare_advantage(td)
        td = self.memory.prepare(td, self._loss_mask_keys())
        td = td.select(*self._read_keys(), strict=False)
        rows = Copies(
            self.symmetry,
            td,
            self._mapped_keys(),
            self._followers(),
            None if self.random else self.elements,
            memory=self.memory,
            mask_keys=self._loss_mask_keys(),
        )
        advantage = rows.expanded.get(self.tensor_keys.advantage)

        log_weight, dist, kl_approx, log_is_weight = self._log_weight(
            rows.expanded, adv_shape=advantage.shape[:-1]
        )
        if advantage.shape != log_weight.shape:
            advantage = broadcast_advantage_to_log_weight(advantage, log_weight)
            check_advantage_broadcast(advantage, log_weight)
        # with a proximal policy or a capped ratio, the surrogate is weighted by the behaviour ratio
        behaviour = log_weight if log_is_weight is None else log_weight + log_is_weight
        clipped = log_weight.clamp(*self._clip_bounds)
        gain1 = behaviour.exp() * advantage
        gain2 = (clipped if log_is_weight is None else clipped + log_is_weight).exp() * advantage
        gain = torch.minimum(gain1, gain2)

        out: dict[str, Any] = {"loss_objective": -gain}
        with torch.no_grad():
            out |= rows.report(kl_approx, (clipped != log_weight).to(gain.dtype), behaviour)
        if self.entropy_bonus:
            out |= self._report_entropy(self._get_entropy(dist, adv_shape=advantage.shape[:-1]), rows)
        if self._has_critic:
            out |= self._report_critic(rows)
        if self._mirrors:
            out["loss_mirror"] = self.mirror_coeff * self._mirror_error(rows, dist)
        td_out = TensorDict({name: self._reduce(name, value, rows) for name, value in out.items()})
        self._clear_weakrefs(
            td,
            td_out,
            "actor_network_params",
            "critic_network_params",
            "target_actor_network_params",
            "target_critic_network_params",
        )
        return td_out

    def _prepare_advantage(self, td: TensorDictBase) -> None:
        """Estimate the advantage if it is missing, and normalise it, on the original rows."""
        advantage = td.get(self.tensor_keys.advantage, None)
        missing = advantage is None
        if missing:
            if self.critic_network is None:
                raise RuntimeError("expected an advantage in the batch, since there is no critic")
            self.value_estimator(
                td,
                params=self._cached_critic_network_params_detached,
                target_params=self.target_critic_network_params,
            )
            advantage = td.get(self.tensor_keys.advantage)
        advantage = self._maybe_normalize_advantage(advantage, td, update_norm=missing)
        td.set(self.tensor_keys.advantage, advantage)

    def _critic_inputs(self) -> list[NestedKey]:
        """What the critic reads from the batch; a shared trunk's output is the actor's to write."""
        written = {unravel_key(key) for key in self.actor_network.out_keys}
        return [key for key in _inputs(self.critic_network) if unravel_key(key) not in written]

    def _mapped_keys(self) -> list[NestedKey]:
        """What may differ between symmetric copies; they share the rest of what the loss reads."""
        networks = [*_inputs(self.actor_network), *self._critic_inputs()]
        return self.symmetry.together([*networks, *_as_list(self.tensor_keys.action), *self._followers()])

    def _followers(self) -> dict[NestedKey, NestedKey]:
        """Numbers of a row, or of the components of its action, and that action."""
        keys = self.tensor_keys
        actions = _as_list(keys.action)
        numbers = [keys.advantage, keys.value_target, *([keys.value] if self._clips_value else [])]
        probabilities = _as_list(keys.sample_log_prob)
        each = zip(probabilities, actions, strict=False) if len(probabilities) > 1 else []
        return dict.fromkeys([*numbers, *probabilities], actions[0]) | dict(each)

    def _read_keys(self) -> list[NestedKey]:
        return [*self._mapped_keys(), *self._loss_mask_keys()]

    def _get_entropy(self, dist: torch.distributions.Distribution, adv_shape: torch.Size):
        """The entropy; without a look, which the host would wait for, whether it is finite."""
        if isinstance(dist, CompositeDistribution) or not has_analytic_entropy(dist):
            return super()._get_entropy(dist, adv_shape)
        return dist.entropy().unsqueeze(-1)

    def _report_entropy(self, entropy: Tensor | TensorDictBase, rows: Copies) -> dict[str, Any]:
        out: dict[str, Any] = {}
        total = entropy
        if is_tensor_collection(entropy):  # one entropy per action head
            out["composite_entropy"] = rows.originals(entropy.detach())
            total = entropy.sum(dim="feature", reduce=True)  # pyright: ignore[reportCallIssue]
        out["entropy"] = rows.mean(total.detach())
        out["loss_entropy"] = self._weighted_loss_entropy(rows.originals(entropy))
        return out

    def _report_critic(self, rows: Copies) -> dict[str, Tensor]:
        """Value loss of all rows; what was clipped, and the variance explained, of those that count."""
        td = rows.expanded.detach() if self.separate_losses else rows.expanded
        keys = self.tensor_keys
        target, old = td.get(keys.value_target, None), td.get(keys.value, None)
        if target is None:
            raise KeyError(f"expected {keys.value_target!r} in the batch, which a value estimator writes")
        if self._clips_value and old is None:  # in the words of ClipPPOLoss
            raise KeyError(
                f"clip_value is set to {self.clip_value}, but the key {keys.value} was not found in the "
                "input tensordict. Make sure that the 'value' key passed to PPO exists in the input "
                "tensordict, where a value estimator writes it."
            )
        with self._using("critic_network"):
            value = self.critic_network(td).get(keys.value, None)
        if value is None:
            raise KeyError(
                f"expected the critic to write {keys.value!r}, it writes {self.critic_network.out_keys}"
            )
        target, value, old = self._critic_loss_inputs(target, value, old)

        out = {}
        loss = distance_loss(target, value, loss_function=self.loss_critic_type)
        if old is not None and self.clip_value is not None and self._clips_value:
            change = value - old
            bounded = change.clamp(-self.clip_value, self.clip_value)
            other = distance_loss(target, old + bounded, loss_function=self.loss_critic_type)
            loss = torch.maximum(loss, other)
            clipped = (change.detach() != bounded.detach()).to(value.dtype)
            out["value_clip_fraction"] = rows.overall_mean(clipped)
        out["loss_critic"] = self.critic_coeff * loss

        if self.log_explained_variance:
            target, value = target.detach(), value.detach()
            total = variance(target, rows.valid) + torch.finfo(target.dtype).eps
            out["explained_variance"] = 1.0 - variance(target - value, rows.valid) / total
        return out

    @contextlib.contextmanager
    def _using(self, network: str) -> Iterator[None]:
        """With the loss's own parameters in a network."""
        with (
            getattr(self, f"{network}_params").to_module(
                getattr(self, network), preserve_module_state=False
            )
            if self.functional
            else contextlib.nullcontext()
        ):
            yield

    def _mirror_error(self, rows: Copies, dist: torch.distributions.Distribution) -> Tensor:
        """sum_g || K_g[pi(s)] - pi(L_g s) ||^2 per original row, the label detached."""
        act = self.symmetry[_as_list(self.tensor_keys.action)[0]]
        output = deterministic_action(dist)  # pi(L_g s)
        if rows.element is None:
            output = output.unflatten(0, (rows.count, -1))
            return mirror_error(output, output[0], act, self.elements).sum(0).unsqueeze(-1)

        with torch.no_grad(), self._using("actor_network"):
            source = deterministic_action(self.actor_network.get_dist(rows.td))
        # each row is one term of the sum, drawn with probability 1/N
        return rows.count * mirror_error(output, source, act, rows.element).unsqueeze(-1)

    def _reduce(self, name: str, value: Tensor, rows: Copies) -> Tensor:
        if not name.startswith("loss_"):
            return value
        per_original = name in ("loss_entropy", "loss_mirror")
        return self._reduce_loss(value, rows.td if per_original else rows.expanded).squeeze(-1)


def _check_numbers(arguments: Mapping[str, Any]) -> None:
    """Weights and bounds are finite, which ``ClipPPOLoss`` leaves open: a loss of NaN is no error there."""
    for name in arguments.keys() & _LEAST.keys():
        value = arguments[name]
        if (value is None and name != "clip_epsilon") or (name == "clip_value" and isinstance(value, bool)):
            continue  # a default, or the bound of the ratio
        least, parts = _LEAST[name], [value]
        if name == "clip_epsilon" and isinstance(value, tuple | list):
            if len(value) != 2:
                shown = checks.shown(value)
                raise ValueError(f"{name}: expected a number, or two as a tuple of length 2, got {shown}")
            least, parts = None, list(value)  # below and above, whose signs ClipPPOLoss checks
        if name == "entropy_coeff" and isinstance(value, Mapping):
            parts = list(value.values())  # one for each head
        for part in parts:
            checks.real(name, part, least)


def _as_list(keys: NestedKey | list[NestedKey] | None) -> list[NestedKey]:
    if keys is None:
        return []
    return list(keys) if isinstance(keys, list) else [keys]


def _inputs(network: TensorDictModule | None) -> list[NestedKey]:
    return [] if network is None else inputs(network)
