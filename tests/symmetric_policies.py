"""Exactly equivariant policies of every kind that TorchRL's losses take, each with its environment.

A linear map W between two representations is made equivariant by averaging it over the group::

    W <- mean_g rho_out(g)^T W rho_in(g)        b <- mean_g rho_out(g)^T b

Hidden features are copies of the regular representation, whose entries the elements permute, so that any
function of single entries (tanh, the gates of a GRU) commutes with them. Without averaging, the same policy
is one that nothing makes symmetric.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import CompositeDistribution, TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.data import Binary, Bounded, Composite, OneHot, TensorSpec, Unbounded
from torchrl.envs import Compose, EnvBase, InitTracker, TransformedEnv
from torchrl.modules import (
    ActorValueOperator,
    GRUModule,
    IndependentNormal,
    MaskedOneHotCategorical,
    OneHotCategorical,
    ProbabilisticActor,
    TanhNormal,
    ValueOperator,
)

from torchrl_sym import PointGroup, Representation, Symmetry
from torchrl_sym.entries import Exchanged
from torchrl_sym.representations import image, invariant, items, planar, polar, pseudoscalar

GROUPS = {
    "C2": PointGroup.reflection("y"),
    "K4": PointGroup.klein_four(),
    "C3": PointGroup.rotation(3),
}


@dataclass
class Task:
    """A policy, its environment, and how both transform."""

    symmetry: Symmetry
    actor: TensorDictModule
    critic: TensorDictModule
    observations: dict[NestedKey, TensorSpec]
    actions: dict[NestedKey, TensorSpec]
    transforms: list[Callable] = field(default_factory=list)
    each: tuple[int, ...] = ()  # items that have a log-probability and an advantage of their own
    sequences: bool = False  # whether the policy remembers

    @property
    def internal(self) -> list[NestedKey]:
        """What only the policy reads again; and deviations of components that elements mix."""
        mixed = any(not rep.is_signed_permutation for rep in self.symmetry.representations)
        return ["params", "hidden", "feature", *(["scale", ("agents", "scale")] if mixed else [])]

    def make_env(self, num_envs: int | None = None) -> EnvBase:
        env = Wandering(self, torch.Size([] if num_envs is None else [num_envs]))
        return TransformedEnv(env, Compose(*(make() for make in self.transforms)))


class Wandering(EnvBase):
    """Observations at random, whatever the action: what a loss is told of a policy needs no more."""

    def __init__(self, task: Task, batch_size: torch.Size) -> None:
        super().__init__(batch_size=batch_size)
        entries = {**task.observations, **task.actions}
        own = {key: spec.expand(*batch_size, *spec.shape) for key, spec in entries.items()}
        observed, acted = ({k: own[k] for k in part} for part in (task.observations, task.actions))
        self.observation_spec = Composite(observed, shape=batch_size)
        self.action_spec = Composite(acted, shape=batch_size)
        self.reward_spec = Unbounded((*batch_size, 1), dtype=torch.get_default_dtype())

    def _observe(self) -> TensorDictBase:
        out = self.observation_spec.rand()
        if "mask" in self.observation_spec:
            out["mask"][..., -1] = True  # something can always be done
        return out

    def _reset(self, tensordict: TensorDictBase | None = None) -> TensorDictBase:
        return self._observe()

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        done = torch.zeros(*self.batch_size, 1, dtype=torch.bool)
        return self._observe().update({"reward": self.reward_spec.rand(), "done": done, "terminated": done})

    def _set_seed(self, seed: int | None) -> None:
        torch.manual_seed(0 if seed is None else seed)


def regular(group: PointGroup, times: int = 1) -> Representation:
    """The group's elements permuted by multiplication from the left."""
    n = group.order
    matrices = torch.zeros(n, n, n)
    for g in range(n):
        matrices[g, group.table[g], torch.arange(n)] = 1.0
    return Representation(group, matrices) * times


def linear(source: Representation, target: Representation, symmetric: bool) -> nn.Linear:
    """A random linear map from one representation to another, averaged over the group."""
    layer = nn.Linear(source.dim, target.dim)
    if symmetric:
        with torch.no_grad():
            into, out = source.matrices.to(layer.weight), target.matrices.to(layer.weight)
            layer.weight.copy_(torch.einsum("nji,jk,nkl->il", out, layer.weight, into) / len(into))
            layer.bias.copy_(torch.einsum("nji,j->i", out, layer.bias) / len(out))
    return layer


class Network(nn.Module):
    """Two layers from several inputs to several outputs, each transforming by a representation."""

    def __init__(
        self, inputs: Sequence[Representation], outputs: Sequence[Representation], symmetric: bool
    ) -> None:
        super().__init__()
        self.events = [len(rep.event_shape) for rep in inputs]
        self.shapes = [rep.event_shape for rep in outputs]
        group = inputs[0].group
        joined = functools.reduce(lambda a, b: a + b, [rep.flatten() for rep in inputs])
        hidden = regular(group, 3)
        self.first = linear(joined, hidden, symmetric)
        self.heads = nn.ModuleList(linear(hidden, rep.flatten(), symmetric) for rep in outputs)

    def forward(self, *inputs: Tensor) -> Tensor | tuple[Tensor, ...]:
        flat = [x.flatten(-dims) for x, dims in zip(inputs, self.events, strict=True)]
        dtype = self.first.weight.dtype
        hidden = torch.tanh(self.first(torch.cat([x.to(dtype) for x in flat], -1)))
        outputs = [head(hidden) for head in self.heads]
        out = tuple(x.unflatten(-1, shape) for x, shape in zip(outputs, self.shapes, strict=True))
        return out if len(out) > 1 else out[0]


class Gaussian(nn.Module):
    """Mean and deviation of an action: a deviation each where entries are permuted, else one for all."""

    def __init__(self, inputs: Sequence[Representation], act: Representation, symmetric: bool) -> None:
        super().__init__()
        self.act = act
        if act.is_signed_permutation:
            scale = act.absolute()
        else:  # of an action, or of each agent's
            *places, _ = act.event_shape
            scale = act.leading(1).unflatten((*places, 1)) if places else invariant(act.group, 1)
        self.network = Network(inputs, [act, scale], symmetric)

    def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor]:
        loc, scale = self.network(*inputs)
        return loc, (0.3 * scale.tanh()).exp().expand_as(loc) / 2


def entries(group: PointGroup) -> Representation:
    """Observations: a polar vector and a pseudoscalar."""
    return polar(group) + pseudoscalar(group)


def signed(group: PointGroup) -> Representation:
    """Actions that keep a box: a signed permutation of every group."""
    return regular(group) + pseudoscalar(group)


def real(representation: Representation) -> TensorSpec:
    return Unbounded(torch.Size(representation.event_shape), dtype=torch.get_default_dtype())


def _task(
    symmetry: Symmetry,
    actor: TensorDictModule,
    read: dict[NestedKey, Representation],
    symmetric: bool,
    actions: dict[NestedKey, TensorSpec],
    **options,
) -> Task:
    """With a critic of everything that is read, invariant if the policy is equivariant."""
    group = symmetry.group
    options.setdefault("observations", {key: real(rep) for key, rep in read.items()})
    if "critic" not in options:
        each = options.get("each", ())
        places = regular(group).unflatten((*each, 1)) if each else invariant(group, 1)
        options["critic"] = ValueOperator(
            Network(list(read.values()), [places], symmetric), in_keys=list(read)
        )
    return Task(symmetry, actor, actions=actions, **options)


def _actor(module: TensorDictModule, distribution: Callable, keys=("loc", "scale"), **options):
    return ProbabilisticActor(
        module, in_keys=list(keys), distribution_class=distribution, return_log_prob=True, **options
    )


def _gaussian(
    group: PointGroup,
    symmetric: bool,
    act: Representation,
    distribution: Callable,
    read: dict[NestedKey, Representation] | None = None,
    **options,
) -> Task:
    read = {"observation": entries(group)} if read is None else read
    module = TensorDictModule(Gaussian(list(read.values()), act, symmetric), list(read), ["loc", "scale"])
    actions = {"action": options.pop("spec", real(act))}
    symmetry = Symmetry(group, {**read, "action": act})
    return _task(symmetry, _actor(module, distribution), read, symmetric, actions, **options)


def feed_forward(group: PointGroup, symmetric: bool) -> Task:
    return _gaussian(group, symmetric, planar(group) + pseudoscalar(group), IndependentNormal)


def normal_per_entry(group: PointGroup, symmetric: bool) -> Task:
    """One log-probability per entry of the action."""
    return _gaussian(group, symmetric, signed(group), torch.distributions.Normal)


def tanh_normal(group: PointGroup, symmetric: bool) -> Task:
    act = signed(group)
    distribution = functools.partial(TanhNormal, low=-2.0, high=2.0)
    box = Bounded(-2.0, 2.0, (act.dim,), dtype=torch.get_default_dtype())
    return _gaussian(group, symmetric, act, distribution, spec=box)


def agents(group: PointGroup, symmetric: bool) -> Task:
    """As many agents as elements, with a log-probability and an advantage each, that change places."""
    n = group.order
    read = {("agents", "observation"): items(regular(group), entries(group))}
    act = items(regular(group), planar(group) + pseudoscalar(group))
    module = TensorDictModule(
        Gaussian(list(read.values()), act, symmetric), list(read), [("agents", "loc"), ("agents", "scale")]
    )
    actor = _actor(
        module,
        IndependentNormal,
        [("agents", "loc"), ("agents", "scale")],
        out_keys=[("agents", "action")],
    )
    symmetry = Symmetry(group, {**read, ("agents", "action"): act})
    return _task(symmetry, actor, read, symmetric, {("agents", "action"): real(act)}, each=(n,))


def sides(group: PointGroup, symmetric: bool) -> Task:
    """Hands under keys of their own, and a head of the policy for each, that change places."""
    names = ["left", "right"] if group.order == 2 else [f"hand{k}" for k in range(group.order)]
    hand, act = entries(group), planar(group) + pseudoscalar(group)
    read = {(name, "observation"): hand for name in names}
    together = items(regular(group), hand)

    class Heads(Network):
        def forward(self, *inputs: Tensor) -> tuple[Tensor, ...]:
            loc = super().forward(torch.stack(inputs, -2)).unbind(-2)
            return (*loc, *(torch.full_like(x, 0.5) for x in loc))

    acts = items(regular(group), act)
    parameters = [("params", name, which) for which in ("loc", "scale") for name in names]
    actor = _actor(
        TensorDictModule(Heads([together], [acts], symmetric), list(read), parameters),
        CompositeDistribution,
        ["params"],
        out_keys=[(name, "action") for name in names],
        distribution_kwargs={
            "distribution_map": dict.fromkeys(names, IndependentNormal),
            "name_map": {name: (name, "action") for name in names},
        },
    )

    class Critic(Network):
        def forward(self, *inputs: Tensor) -> Tensor:
            return super().forward(torch.stack(inputs, -2))

    symmetry = Symmetry(
        group,
        {
            Exchanged(*read): together,
            Exchanged(*((name, "action") for name in names)): acts,
        },
    )
    critic = ValueOperator(Critic([together], [invariant(group, 1)], symmetric), in_keys=list(read))
    actions = {(name, "action"): real(act) for name in names}
    return _task(symmetry, actor, read, symmetric, actions, critic=critic)


def camera(group: PointGroup, symmetric: bool) -> Task:
    pixels = image(group, (2, 4, 4), "CHW")
    act = planar(group) + pseudoscalar(group)
    read = {"observation": entries(group), "pixels": pixels}
    return _gaussian(group, symmetric, act, IndependentNormal, read)


def _one_hot(group: PointGroup, symmetric: bool, masked: bool) -> Task:
    act = regular(group) + invariant(group, 1)
    read = {"observation": entries(group)}
    module = TensorDictModule(Network([entries(group)], [act], symmetric), ["observation"], ["logits"])
    observations = {"observation": real(entries(group))}
    distribution, keys = OneHotCategorical, ["logits"]
    if masked:  # the name is one of TorchRL's own
        observations["mask"] = Binary(act.dim, dtype=torch.bool)
        distribution, keys = MaskedOneHotCategorical, ["logits", "mask"]
    symmetry = Symmetry(group, {**read, **({"mask": act} if masked else {}), "action": act})
    actor = _actor(module, distribution, keys)
    actions = {"action": OneHot(act.dim)}
    return _task(symmetry, actor, read, symmetric, actions, observations=observations)


def one_hot(group: PointGroup, symmetric: bool) -> Task:
    return _one_hot(group, symmetric, masked=False)


def masked_one_hot(group: PointGroup, symmetric: bool) -> Task:
    return _one_hot(group, symmetric, masked=True)


def composite(group: PointGroup, symmetric: bool) -> Task:
    """An arm that moves and a hand that chooses."""
    arm, hand = planar(group) + pseudoscalar(group), regular(group) + invariant(group, 1)

    class Heads(Network):
        def forward(self, *inputs: Tensor) -> tuple[Tensor, Tensor, Tensor]:
            loc, logits = super().forward(*inputs)
            return loc, torch.full_like(loc, 0.5), logits

    read = {"observation": entries(group)}
    parameters = [("params", "arm", "loc"), ("params", "arm", "scale"), ("params", "hand", "logits")]
    actor = _actor(
        TensorDictModule(Heads([entries(group)], [arm, hand], symmetric), list(read), parameters),
        CompositeDistribution,
        ["params"],
        out_keys=["arm", "hand"],
        distribution_kwargs={"distribution_map": {"arm": IndependentNormal, "hand": OneHotCategorical}},
    )
    symmetry = Symmetry(group, {**read, "arm": arm, "hand": hand})
    return _task(symmetry, actor, read, symmetric, {"arm": real(arm), "hand": OneHot(hand.dim)})


def shared_trunk(group: PointGroup, symmetric: bool) -> Task:
    read, hidden = {"observation": entries(group)}, regular(group, 2)
    act = planar(group) + pseudoscalar(group)
    model = ActorValueOperator(
        TensorDictModule(Network([entries(group)], [hidden], symmetric), list(read), ["hidden"]),
        _actor(TensorDictModule(Gaussian([hidden], act, symmetric), ["hidden"], ["loc", "scale"]),
               IndependentNormal),
        ValueOperator(Network([hidden], [invariant(group, 1)], symmetric), in_keys=["hidden"]),
    )  # fmt: skip
    symmetry = Symmetry(group, {**read, "action": act})
    actor, critic = model.get_policy_operator(), model.get_value_operator()
    return _task(symmetry, actor, read, symmetric, {"action": real(act)}, critic=critic)


def recurrent(group: PointGroup, symmetric: bool) -> Task:
    """A GRU whose memory the elements permute: its gates are functions of single entries."""
    read, hidden = {"observation": entries(group)}, regular(group, 2)
    act = planar(group) + pseudoscalar(group)
    memory = GRUModule(input_size=4, hidden_size=hidden.dim, in_key="observation", out_key="feature")
    if symmetric:
        for source, weight, bias in (
            (entries(group), memory.gru.weight_ih_l0, memory.gru.bias_ih_l0),
            (hidden, memory.gru.weight_hh_l0, memory.gru.bias_hh_l0),
        ):
            gates = [linear(source, hidden, symmetric) for _ in range(3)]
            weight.data.copy_(torch.cat([gate.weight for gate in gates]))
            bias.data.copy_(torch.cat([gate.bias for gate in gates]))
    head = TensorDictModule(Gaussian([hidden], act, symmetric), ["feature"], ["loc", "scale"])
    actor = _actor(TensorDictSequential(memory, head), IndependentNormal)
    remembered = hidden.unflatten((1, hidden.dim))
    symmetry = Symmetry(group, {**read, "recurrent_state": remembered, "action": act})
    transforms = [InitTracker, memory.make_tensordict_primer]
    options = {"transforms": transforms, "sequences": True}
    return _task(symmetry, actor, read, symmetric, {"action": real(act)}, **options)


POLICIES: dict[str, Callable[[PointGroup, bool], Task]] = {
    "feed-forward": feed_forward,
    "Normal": normal_per_entry,
    "TanhNormal": tanh_normal,
    "one-hot": one_hot,
    "masked": masked_one_hot,
    "composite": composite,
    "recurrent": recurrent,
    "trunk": shared_trunk,
    "agents": agents,
    "sides": sides,
    "image": camera,
}
