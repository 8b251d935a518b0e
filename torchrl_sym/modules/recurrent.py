"""Recurrent layers that commute with a group: LSTM and GRU with a memory that the group permutes.

All gates are pointwise functions of linear maps. With a memory that is a regular representation, and maps
that commute with the group, the memory after a mirrored history is the permuted memory, exactly. So what a
buffer stores has an image, and symmetric copies begin anywhere: nothing has to be rebuilt from the start of
an episode (see :mod:`~torchrl_sym.memory`).

The matrices are computed from the free numbers once a call, and handed to PyTorch's own kernels: what a
step costs is what it costs in ``nn.LSTM`` and ``nn.GRU``.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.utils.rnn import PackedSequence, pack_padded_sequence, pad_packed_sequence

from torchrl_sym import checks
from torchrl_sym.modules.hidden import hidden_units
from torchrl_sym.modules.linear import EquivariantLinear
from torchrl_sym.representations import Representation


class _Recurrent(nn.Module):
    """What LSTM and GRU share; attributes are named as in PyTorch, since TorchRL's modules read them."""

    gates: int
    states: int
    batch_first = True
    bidirectional = False
    proj_size = 0
    dropout = 0.0

    def __init__(
        self,
        in_rep: Representation,
        hidden_size: int,
        num_layers: int = 1,
        bias: bool = True,
        *,
        device: torch.device | str | None = None,
        dtype: torch.dtype | None = None,
    ) -> None:
        super().__init__()
        self.in_rep = checks.instance("in_rep", in_rep, Representation).flatten()
        self.out_rep = hidden_units("hidden_size", hidden_size, in_rep.group)
        self.input_size, self.hidden_size = self.in_rep.dim, self.out_rep.dim
        self.num_layers = checks.whole("num_layers", num_layers, 1)
        self.bias = checks.flag("bias", bias)
        sources = [self.in_rep, *[self.out_rep] * (self.num_layers - 1)]
        made = {"device": device, "dtype": dtype}
        gates = self.out_rep * self.gates
        reading = [EquivariantLinear(rep, gates, bias, **made) for rep in sources]
        remembering = [EquivariantLinear(self.out_rep, gates, bias, **made) for _ in sources]
        self.input_linears: Sequence[EquivariantLinear] = nn.ModuleList(reading)  # pyright: ignore[reportAttributeAccessIssue]
        self.memory_linears: Sequence[EquivariantLinear] = nn.ModuleList(remembering)  # pyright: ignore[reportAttributeAccessIssue]
        self.reset_parameters()

    @torch.no_grad()
    def reset_parameters(self) -> None:
        """Draw the parameters anew, all within PyTorch's bounds, ``1 / sqrt(hidden_size)``."""
        for linear in [*self.input_linears, *self.memory_linears]:
            linear.reset_parameters()
            for parameter in linear.parameters():
                parameter.mul_(math.sqrt(linear.in_rep.dim / self.hidden_size))

    @property
    def memory_rep(self) -> Representation:
        """How what TorchRL stores of the memory transforms, ``(num_layers, hidden_size)`` a step.

        Example:
            >>> from torchrl_sym import PointGroup
            >>> from torchrl_sym.representations import polar
            >>> EquivariantGRU(polar(PointGroup.reflection("y")), 8, num_layers=2).memory_rep.event_shape
            (2, 8)
        """
        return (self.out_rep * self.num_layers).unflatten((self.num_layers, self.hidden_size))

    def _weights(self) -> list[Tensor]:
        """Dense weights and biases in PyTorch's order."""
        weights: list[Tensor] = []
        for pair in zip(self.input_linears, self.memory_linears, strict=True):
            found = [linear.dense_parameters() for linear in pair]
            weights += [weight for weight, _ in found]
            weights += [bias for _, bias in found if bias is not None]
        return weights

    def _run(self, x: Tensor, states: Sequence[Tensor] | None, mask: Tensor | None) -> list[Tensor]:
        if not isinstance(x, Tensor) or x.ndim != 3 or x.shape[-1] != self.input_size:
            raise ValueError(
                f"expected sequences (batch, time, {self.input_size}), got {checks.shown(x)}; a single "
                "step is a sequence of one"
            )
        shape = self.num_layers, x.shape[0], self.hidden_size
        given = [] if states is None else checks.sequence("hx", states, "states")
        right = [isinstance(state, Tensor) and state.shape == shape for state in given]
        if len(given) not in (0, self.states) or not all(right):
            raise ValueError(f"hx: expected {self.states} of shape {shape}, got {checks.shown(states)}")
        if mask is not None and mask.shape != x.shape[:2]:
            raise ValueError(f"mask: expected shape {tuple(x.shape[:2])}, got {checks.shown(mask)}")
        states = given or [x.new_zeros(shape)] * self.states
        settings = self._weights(), self.bias, self.num_layers, 0.0, self.training, False
        if mask is None:
            return [*self._kernel([x], states, *settings, True)]

        packed = pack_padded_sequence(x, mask.sum(-1).cpu(), batch_first=True, enforce_sorted=False)
        order, back = packed.sorted_indices, packed.unsorted_indices
        assert order is not None and back is not None  # enforce_sorted=False
        states = [state.index_select(1, order) for state in states]
        y, *states = self._kernel([packed.data, packed.batch_sizes], states, *settings)
        y = PackedSequence(y, packed.batch_sizes, order, back)
        y, _ = pad_packed_sequence(y, batch_first=True, total_length=x.shape[1])
        return [y, *(state.index_select(1, back) for state in states)]

    @abstractmethod
    def _kernel(self, source: list[Tensor], states: Sequence[Tensor], *settings: Any) -> Sequence[Tensor]:
        """PyTorch's function, of sequences, or of packed data and its batch sizes."""

    def extra_repr(self) -> str:
        return f"{self.input_size}, {self.hidden_size}, num_layers={self.num_layers}"


class EquivariantGRU(_Recurrent):
    """``nn.GRU`` whose output and memory are regular representations of a group, on rows first.

    In a policy of TorchRL, ``GRUModule(gru=EquivariantGRU(...), in_key=..., out_key=...)``, and in the
    :class:`~torchrl_sym.Symmetry` the memory's entry, ``"recurrent_state": gru.memory_rep``.

    Args:
        in_rep: how one step of the input transforms.
        hidden_size: size of output and memory, a multiple of the group's order.
        num_layers: number of layers, each reading the one before.
        bias: whether to learn additive biases.
        device: where the parameters are made.
        dtype: their type.

    Shape:
        ``(B, T, in_rep.dim)`` and, optional, a memory ``(num_layers, B, hidden_size)``, to
        ``(B, T, hidden_size)`` and the memory after the last step.

    Raises:
        TypeError: an argument of another type.
        ValueError: a size that is no multiple of the group's order.

    Example:
        >>> import torch
        >>> from torchrl_sym import PointGroup
        >>> from torchrl_sym.representations import polar
        >>> vector = polar(PointGroup.reflection("y"))
        >>> gru = EquivariantGRU(vector, hidden_size=8)
        >>> x = torch.randn(2, 5, 3)
        >>> memory, mirrored = (gru(history)[1] for history in (x, vector(x, "reflect-y")))
        >>> torch.allclose(gru.out_rep(memory, "reflect-y"), mirrored, atol=1e-6)
        True
    """

    gates, states = 3, 1

    def forward(
        self, input: Tensor, hx: Tensor | None = None, mask: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Run along time.

        Args:
            input: ``(B, T, in_rep.dim)``.
            hx: the memory to begin with, ``(num_layers, B, hidden_size)``. Defaults to zeros.
            mask: where sequences go on, ``(B, T)``: true up to the end of each. Defaults to all.
        """
        y, memory = self._run(input, None if hx is None else [hx], mask)
        return y, memory

    def _kernel(self, source: list[Tensor], states: Sequence[Tensor], *settings: Any) -> Sequence[Tensor]:
        return torch.gru(*source, states[0], *settings)  # pyright: ignore[reportCallIssue]


class EquivariantLSTM(_Recurrent):
    """``nn.LSTM`` whose output and memory are regular representations of a group, on rows first.

    In a policy of TorchRL, ``LSTMModule(lstm=EquivariantLSTM(...), in_key=..., out_key=...)``, and in the
    :class:`~torchrl_sym.Symmetry` the entries of its memory, ``"recurrent_state_h": lstm.memory_rep`` and
    ``"recurrent_state_c": lstm.memory_rep``.

    Args:
        in_rep: as of :class:`EquivariantGRU`, like all that follow.
        hidden_size: see there.
        num_layers: see there.
        bias: see there.
        device: see there.
        dtype: see there.

    Example:
        >>> import torch
        >>> from torchrl_sym import PointGroup
        >>> from torchrl_sym.representations import polar
        >>> lstm = EquivariantLSTM(polar(PointGroup.klein_four()), hidden_size=8)
        >>> output, (hidden, cell) = lstm(torch.randn(2, 5, 3))
        >>> output.shape, cell.shape
        (torch.Size([2, 5, 8]), torch.Size([1, 2, 8]))
    """

    gates, states = 4, 2

    def forward(
        self, input: Tensor, hx: tuple[Tensor, Tensor] | None = None, mask: Tensor | None = None
    ) -> tuple[Tensor, tuple[Tensor, Tensor]]:
        """Run along time.

        Args:
            input: ``(B, T, in_rep.dim)``.
            hx: hidden and cell state to begin with, each ``(num_layers, B, hidden_size)``. Defaults to
                zeros.
            mask: where sequences go on, ``(B, T)``: true up to the end of each. Defaults to all.
        """
        y, hidden, cell = self._run(input, hx, mask)
        return y, (hidden, cell)

    def _kernel(self, source: list[Tensor], states: Sequence[Tensor], *settings: Any) -> Sequence[Tensor]:
        return torch.lstm(*source, states, *settings)  # pyright: ignore[reportCallIssue]
