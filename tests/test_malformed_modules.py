"""Malformed arguments of the modules, and of the regular representation."""

import torch
from torch import nn

from tests.malformed import (
    Argument,
    assert_refused,
    count,
    each,
    flag,
    function,
    number,
    subject,
    tensor,
    thing,
)
from torchrl_sym import PointGroup
from torchrl_sym import representations as r
from torchrl_sym.modules import (
    EquivariantGRU,
    EquivariantLayerNorm,
    EquivariantLinear,
    EquivariantLSTM,
    EquivariantMLP,
    InvariantMLP,
    TiedScale,
    symmetrize_,
)

K4, MIRROR = PointGroup.klein_four(), PointGroup.reflection("y")
POLAR = r.polar(K4)
another = {"of another group": r.polar(MIRROR), "a group": K4, "a builder": r.polar}
rep = thing(POLAR, **another)
NETWORK = nn.Sequential(nn.Linear(3, 8), nn.ELU(), nn.Linear(8, 3))
GRU, LSTM = EquivariantGRU(POLAR, 8), EquivariantLSTM(POLAR, 8)
INPUT, MEMORY = torch.zeros(2, 5, 3), torch.zeros(1, 2, 8)


def sizes() -> Argument:
    wrong = {
        "no multiple": (8, 6),
        "zero": (0, 8),
        "negative": (-4, 8),
        "fractions": (8.5, 8),
        "true": (True, 8),
        "a number": 8,
        "text": "88",
        "words": ("8", "8"),
        "None": None,
        "nested": ((8, 8),),
        "infinite": (float("inf"),),
        "NaN": (float("nan"),),
    }
    return Argument((8, 8), wrong)


def nonlinearity() -> Argument:
    wrong = {
        "a softmax": lambda: nn.Softmax(-1),
        "a layer norm": lambda: nn.LayerNorm(8),
        "a module": nn.ELU(),
        "a function": torch.tanh,
        "makes no module": lambda: torch.tanh,
        "None": None,
    }
    return function(nn.ELU).but(**wrong)


settings = {"num_cells": sizes(), "activation_class": nonlinearity(), "relaxed": flag(True)}
recurrent = {
    "in_rep": thing(POLAR, **{k: v for k, v in another.items() if k != "of another group"}),
    "hidden_size": count(8, **{"no multiple": 6}),
    "num_layers": count(2),
    "bias": flag(True),
}
alone = recurrent["in_rep"]
features = tensor(torch.zeros(2, 3), **{"another size": torch.zeros(2, 4), "no dimension": torch.zeros(())})
steps = tensor(INPUT, **{"another size": torch.zeros(2, 5, 4), "a step": torch.zeros(2, 3)})
memory = tensor(MEMORY, **{"another size": torch.zeros(1, 2, 9), "of TorchRL": torch.zeros(2, 1, 8)})
both = Argument(
    (MEMORY, MEMORY), {"one": MEMORY[0], "other sizes": (MEMORY, MEMORY[..., :7]), "text": "ab"}
)
mask = Argument(torch.ones(2, 5, dtype=torch.bool), {"of steps": torch.ones(5, dtype=torch.bool)})

SUBJECTS = [
    subject(
        "regular", r.regular, group=thing(K4, representation=POLAR), channels=count(3, **{"huge": 10**7})
    ),
    subject(
        "EquivariantLinear",
        EquivariantLinear,
        in_rep=rep,
        out_rep=rep.but(**{"nothing in common": r.axial(MIRROR)}),
        bias=flag(True),
        relaxed=flag(True),
    ),
    subject("EquivariantMLP", EquivariantMLP, in_rep=rep, out_rep=rep, **settings),
    subject("InvariantMLP", InvariantMLP, in_rep=alone, out_features=count(1), **settings),
    subject("EquivariantGRU", EquivariantGRU, **recurrent),
    subject("EquivariantLSTM", EquivariantLSTM, **recurrent),
    subject("EquivariantLayerNorm", EquivariantLayerNorm, rep=alone, eps=number(1e-5)),
    subject("TiedScale", TiedScale, rep=alone, initial=number(0.5).but(zero=0.0)),
    subject(
        "symmetrize_",
        symmetrize_,
        module=thing(NETWORK, list=[NETWORK], softmax=nn.Softmax(-1), nothing=nn.Sequential()),
        in_rep=rep.but(**{"another size": POLAR + POLAR}),
        out_rep=rep.but(**{"another size": POLAR + POLAR}),
    ),
    subject("a linear layer", EquivariantLinear(POLAR, POLAR), x=features),
    subject("a network", EquivariantMLP(POLAR, POLAR, (8,)), x=features),
    subject("a layer norm", EquivariantLayerNorm(POLAR), x=features),
    subject("a GRU", GRU, input=steps, hx=memory.but("None"), mask=mask),
    subject("an LSTM", LSTM, input=steps, hx=both, mask=mask),
]


@each(SUBJECTS)
def test_malformed_arguments_are_refused(tried):
    assert_refused(tried)
