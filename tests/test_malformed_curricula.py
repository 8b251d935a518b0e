"""Malformed entries of observations, constants, curricula and what tasks saved of them are refused."""

import numpy as np
import torch

import tasks
from tasks import base, constants, curriculum, observation
from tests.malformed import (
    Argument,
    array,
    assert_refused,
    choice,
    count,
    each,
    flag,
    function,
    generator,
    number,
    of_three,
    optional,
    subject,
    tensor,
    thing,
)
from torchrl_sym import representations as r

CLIMB, PUSH, CARTPOLE, REPOSE = (base.create(name) for name in tasks.ALL_TASKS)


SUBJECTS = [
    subject(
        "Constant",
        constants.Constant,
        values=array(torch.ones(2)).but("a number", "empty", "another size", "one more dimension"),
    ),
    subject(
        "Entry",
        observation.Entry,
        name=choice("velocity").but("misspelt", "other case", "empty"),
        value=function(lambda state: state.qvel),
        representation=thing(r.polar(CARTPOLE.symmetry.group), builder=r.polar),
        unit=Argument("m", {"None": None, "a number": 3}),
        frame=Argument("base", {"None": None}),
        kind=Argument("polar", {"None": None}),
        scale=number(1.0, low=-np.inf),
        divisor=number(2.0, zero=0.0),
    ),
    subject(
        "Observation",
        observation.Observation,
        entries=Argument(
            CARTPOLE.layout(), {"None": None, "empty": [], "texts": ["a"], "a task": CARTPOLE}
        ),
        limit=optional(number(20.0, zero=0.0)),
    ),
    subject(
        "next_level",
        curriculum.next_level,
        level=tensor(torch.tensor([0.0, 1.0]), **of_three(3)),
        success=tensor(torch.tensor([True, False]), **of_three(3)),
        failure=tensor(torch.tensor([False, False]), **of_three(3)),
        last=count(7),
        generator=generator,
    ),
    subject(
        "Averages",
        lambda names: curriculum.Averages(*names),
        names=Argument(
            ["success", "level"],
            {"twice": ["a", "a"], "numbers": [1, 2], "empty texts": [""], "nested": [["a"]]},
        ),
    ),
    subject(
        "Curriculum",
        lambda last, names, rising: curriculum.Curriculum(last, *names, rising=rising),
        last=count(7),
        names=Argument(["success", "level"], {"twice": ["a", "a"], "numbers": [1, 2], "none": []}),
        rising=flag(False),
    ),
    subject(
        "update",
        lambda values: curriculum.Averages("success").update(**values),
        values=Argument(
            {"success": torch.ones(2)},
            {
                "misspelt": {"sucess": torch.ones(2)},
                "text": {"success": "1"},
                "None": {"success": None},
                "a number": {"success": 1.0},
            },
        ),
    ),
    subject(
        "load averages",
        curriculum.Averages("success").load,
        values=Argument(
            {"success": 0.5},
            {
                "None": None,
                "a list": [0.5],
                "text": {"success": "1"},
                "flag": {"success": True},
                "nothing": {"success": None},
            },
        ),
    ),
    subject(
        "load_state_dict of climb",
        CLIMB.load_state_dict,
        saved=Argument(
            CLIMB.state_dict(),
            {
                "None": None,
                "empty": {},
                "of another task": REPOSE.state_dict(),
                "another phase": CLIMB.state_dict() | {"phase": "Z"},
            },
        ),
    ),
    subject(
        "load_state_dict of push",
        PUSH.load_state_dict,
        saved=Argument(
            PUSH.state_dict(), {"None": None, "empty": {}, "of another task": REPOSE.state_dict()}
        ),
    ),
    subject(
        "load_state_dict of repose",
        REPOSE.load_state_dict,
        saved=Argument(
            REPOSE.state_dict(), {"None": None, "a list": [1], "of another task": PUSH.state_dict()}
        ),
    ),
]


@each(SUBJECTS)
def test_malformed_arguments_are_refused(tried):
    assert_refused(tried)
