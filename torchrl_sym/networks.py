"""The networks that a penalty reaches: where their parameters are, and whether somebody moves them.

A loss of TorchRL keeps the parameters of a network apart from the module that computes with them. Those of
an ensemble are drawn anew: beside ``SACLoss``, the Q function that was passed in is an empty form whose own
parameters no optimizer holds, and a penalty on it has no effect that anybody would see. So a penalty takes
the parameters from the loss itself, and speaks up when nobody moves them.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, fields
from typing import TypeVar

import torch
from tensordict import NestedKey, TensorDictParams
from tensordict.nn import TensorDictModule, TensorDictModuleBase
from tensordict.utils import unravel_key
from torch import Tensor, nn
from torchrl.objectives import LossModule

from torchrl_sym import checks

T = TypeVar("T")

# What to do about parameters that no optimizer holds.
_OWN = "give those of the loss to one"
_COPIED = (
    "SACLoss, TD3Loss, REDQLoss and other losses train copies of the network that they are given: use "
    "MirrorLoss.of(loss, 'qvalue_network', symmetry=...), which reaches them"
)


@dataclass(frozen=True, eq=False)
class HeldNetwork:
    """A network, and the parameters that a loss holds for it.

    No module, so that whoever keeps one registers no parameter a second time.

    Args:
        module: what computes.
        params: the parameters to compute with, ``[members]`` for an ensemble; None for the module's own.
        keys: names that another loss has given to entries, as for ``set_keys``.
        borrowed: whether it is another loss that holds them.
    """

    module: TensorDictModuleBase
    params: TensorDictParams | None = None
    keys: Mapping[str, NestedKey] = field(default_factory=dict)
    borrowed: bool = False

    @classmethod
    def inside(cls, loss: LossModule, name: str) -> HeldNetwork:
        """A network of a loss.

        Raises:
            TypeError: no loss.
            ValueError: the loss has no network of this name; the message lists those it has.
        """
        checks.instance("loss", loss, LossModule)
        children = dict(loss.named_children())
        names = [
            key
            for key, value in {**vars(loss), **children}.items()
            if isinstance(value, TensorDictModuleBase)
            and (key in children or f"{key}_params" in children)  # others have no parameters of the loss
            and not (key.startswith("_") or isinstance(value, LossModule))
        ]
        checks.one_of("network", name, names)
        keys = {part.name: getattr(loss.tensor_keys, part.name) for part in fields(loss.tensor_keys)}
        return cls(getattr(loss, name), children.get(f"{name}_params"), keys, True)  # pyright: ignore[reportArgumentType]

    def parameters(self) -> list[nn.Parameter]:
        """The parameters that a penalty would change."""
        return list((self.module if self.params is None else self.params).parameters())

    def each(self, compute: Callable[[], T]) -> list[T]:
        """Results of a computation with the parameters of every member, of the only one if there is one."""
        if self.params is None:
            return [compute()]
        results = []
        for params in self.params.unbind(0) if self.params.batch_dims else [self.params]:
            with params.to_module(self.module, preserve_module_state=False):
                results.append(compute())
        return results


@contextlib.contextmanager
def evaluating(network: nn.Module) -> Iterator[None]:
    """A network as a function of one row: without dropout, by the running statistics of its normalisers.

    Otherwise a row's output depends on chance and on the rest of the batch, and two passes over one state
    differ. Recurrent layers keep their mode, since cuDNN has no gradient in the other.
    """
    switched = [part for part in network.modules() if part.training and not isinstance(part, nn.RNNBase)]
    for part in switched:
        part.training = False
    try:
        yield
    finally:
        for part in switched:
            part.training = True


class Effect:
    """Whether a penalty on a network has one; it is an error if not.

    Gradients pile up in parameters that no optimizer holds: nobody clears them, and the parameters stay as
    they are. Both can be read off the counters of in-place changes, without waiting for the device.
    """

    def __init__(self, held: HeldNetwork) -> None:
        self.held = held
        self._restart()

    def _restart(self) -> None:
        self._parameters: list[nn.Parameter] | None = None
        self._seen: tuple[int, list[int], list[Tensor]] | None = None
        self._proven = False

    def __getstate__(self) -> dict[str, HeldNetwork]:  # a copy's counters start anew
        return {"held": self.held}

    def __setstate__(self, state: dict[str, HeldNetwork]) -> None:
        self.held = state["held"]
        self._restart()

    def require(self, penalty: Tensor, patience: int) -> None:
        """Refuse a penalty that changes nothing.

        Args:
            penalty: what will be minimised.
            patience: number of gradients that may pile up.

        Raises:
            RuntimeError: the penalty has no gradient in trainable parameters; or that many gradients have
                been added up in them, and nobody has cleared them or changed the parameters.
        """
        if torch.compiler.is_compiling() or not torch.is_grad_enabled():
            return
        if self._parameters is None:
            self._parameters = self.held.parameters()
        if not penalty.requires_grad and any(p.requires_grad for p in self._parameters):
            raise RuntimeError(
                f"expected an output with a gradient, got none from the network that writes "
                f"{self.held.module.out_keys}: an arg-max, a rounded or a detached action moves no "
                "parameter; let it write its action values ('action_value', as QValueActor does), or a "
                "distribution of actions"
            )
        if not self._proven:
            self._require_change(self._parameters, patience)

    def _require_change(self, parameters: list[nn.Parameter], patience: int) -> None:
        piled = max((p.grad._version for p in parameters if p.grad is not None), default=0)
        if piled == 0 or piled < patience // 2 or _capturing(parameters[0]):
            return  # cleared again and again: an optimizer holds them
        versions = [p._version for p in parameters]
        sums = [p.detach().sum(dtype=torch.promote_types(p.dtype, torch.float32)) for p in parameters]
        if self._seen is None:  # the counters may be high already, from an earlier training
            self._seen = piled, versions, sums
        elif piled - self._seen[0] >= patience - patience // 2:
            # a fused optimizer counts no change, so that the values decide; once in a run
            same = versions == self._seen[1] and all(map(torch.equal, sums, self._seen[2]))
            if same:
                raise RuntimeError(
                    f"{piled} gradients have been added up in the parameters of the network that writes "
                    f"{self.held.module.out_keys}, and nobody has cleared them or changed the parameters: "
                    f"no optimizer holds them; {_OWN if self.held.borrowed else _COPIED}. If so many "
                    "gradients are added up on purpose, raise the loss's patience"
                )
            self._proven = True


def _capturing(parameter: nn.Parameter) -> bool:
    return parameter.is_cuda and torch.cuda.is_current_stream_capturing()


def check_network(name: str, network: TensorDictModule) -> None:
    """TypeError unless a network reads and writes tensordicts."""
    remedy = "wrap a network in TensorDictModule, ProbabilisticActor or ValueOperator"
    checks.instance(name, network, TensorDictModuleBase, remedy)


def inputs(network: TensorDictModule) -> list[NestedKey]:
    """What a network reads from a batch; not the group of parameters that its own modules fill."""
    written = [key for key in network.out_keys if isinstance(key, tuple)]
    filled = {unravel_key(key[:depth]) for key in written for depth in range(1, len(key))}
    return [key for key in network.in_keys if unravel_key(key) not in filled]
