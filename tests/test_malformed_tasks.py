"""Malformed arguments of tasks, states and pictures are refused."""

import functools

import numpy as np
import torch

import tasks
from tasks import base, draws, engines, paths, rendering, specs, state, suite
from tests.malformed import (
    Argument,
    array,
    assert_refused,
    choice,
    count,
    each,
    element,
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

CLIMB, PUSH, CARTPOLE, REPOSE = (base.create(name) for name in tasks.ALL_TASKS)
START = CARTPOLE.sample_goal_state(2, None)
ENV = tasks.make_env("cartpole", num_envs=2, num_threads=1)
IMAGE = np.zeros((20, 30, 3), dtype=np.uint8)
FILM = [START, START]


def span(right: tuple[float, float], **more: object) -> Argument:
    """A range to draw from; None is none."""
    low, high = right
    wrong = {
        "falling": (high, low),
        "one number": high,
        "of one": (low,),
        "of three": (low, high, high),
        "NaN": (low, np.nan),
        "infinite": (low, np.inf),
        "texts": (str(low), str(high)),
        "Nones": (None, None),
        "flags": (False, True),
        "text": "12",
        "a mapping": {0: low, 1: high},
        "empty": (),
    }
    return Argument(right, wrong | more)


state_ = thing(
    START,
    **{
        "positions": START.qpos,
        "a dictionary of it": vars(START),
        "of another task": PUSH.sample_goal_state(2, None),
    },
)
task = thing(CARTPOLE, **{"a name": "cartpole", "an environment": ENV})
n = count(2, low=0)
seconds = optional(number(2.0, low=0.02)).but(zero=0.0)
legged = {"episode_seconds": seconds, "physics_timestep": number(0.01, zero=0.0, odd=0.003),
          "friction": span((0.5, 1.2), negative=(-1.0, 1.0))}  # fmt: skip
frames = Argument(
    [IMAGE],
    {
        "None": None,
        "empty": [],
        "a number": 3,
        "one image": IMAGE[0],
        "texts": ["a"],
        "floats": [IMAGE / 2.0],
        "of two sizes": [IMAGE, IMAGE[1:]],
    },
)
film = Argument(FILM, {"None": None, "empty": [], "one state": START, "texts": ["a"], "a number": 3})
elements = Argument(
    [0, 1],
    {
        "None": None,
        "beyond": [0, 9],
        "negative": [0, -1],
        "texts": ["a", "b"],
        "a number": 3,
        "too few": [0],
        "fractions": [0, 0.5],
    },
)


SUBJECTS = [
    subject("create", base.create, name=choice("cartpole")),
    subject(
        "cartpole",
        functools.partial(base.create, "cartpole"),
        "episode_seconds motor_bias rail_tilt wind",
        episode_seconds=seconds,
        motor_bias=number(0.1, low=-3.0, wide=4.0),
        rail_tilt=number(2.0, low=-45.0, wide=90.0),
        wind=number(2.0, low=-50.0, wide=99.0),
    ),
    subject(
        "anymal_push",
        functools.partial(base.create, "anymal_push"),
        "curriculum friction physics_timestep payload weak_leg",
        **legged,
        curriculum=flag(False),
        added_mass=span((-2.0, 4.0), **{"more than there is": (-100.0, 1.0)}),
        payload=number(2.0),
        payload_position=array(torch.tensor([0.0, 0.0, 0.1])),
        weak_leg=optional(choice("LF")),
    ),
    subject(
        "anymal_climb",
        functools.partial(base.create, "anymal_climb"),
        "height phase curriculum",
        height=number(0.2, low=0.05),
        phase=choice("B"),
        curriculum=flag(False),
    ),
    subject(
        "trifinger_repose",
        functools.partial(base.create, "trifinger_repose"),
        "difficulty yaw radius cube_mass weak_finger",
        **legged,
        difficulty=count(1, **{"five": 5}),
        yaw=optional(number(1.0, wide=4.0)),
        radius=number(0.1, wide=0.2),
        curriculum=flag(False),
        cube_mass=span((0.05, 0.1), negative=(-1.0, 1.0)),
        weak_finger=optional(count(1, low=0, **{"three": 3})),
    ),
    *(
        subject(f"{t.name}, {method}", getattr(t, method), n=n, generator=generator)
        for t in (CARTPOLE, PUSH, CLIMB, REPOSE)
        for method in ("sample_goal_state", "sample_initial_state", "sample_goal_states")
    ),
    subject(
        "sample_goal_states, elements",
        functools.partial(CARTPOLE.sample_goal_states, 2, None),
        elements=optional(elements).but("too few"),
    ),
    subject(
        "transform_state",
        CARTPOLE.transform_state,
        state=state_,
        g=element("reflect-x", 2, **{"of three": torch.zeros(3, dtype=torch.long)}),
    ),
    subject(
        "make_engine",
        functools.partial(engines.make_engine, num_threads=1),
        task=task,
        num_envs=count(2, huge=2**40),
        engine=optional(choice("mujoco")),
    ),
    subject("make_specs", specs.make_specs, task=task, num_envs=count(2)),
    subject("mapped_at_random", CARTPOLE.mapped_at_random, state=state_, generator=generator),
    subject("load", tasks.load, name=choice("cartpole"), random=optional(count(1, low=0, huge=2**40))),
    subject("SuiteTask", suite.SuiteTask, description=task, random=optional(count(1, low=0, huge=2**40))),
    subject(
        "load_model",
        base.load_model,
        asset=choice("cartpole.xml"),
        edit=optional(function(lambda spec: None)),
    ),
    subject(
        "check_range",
        draws.check_range,
        name=Argument("friction", {}),
        span=span((0.5, 1.2)),
        above=Argument(0.0, {}),
    ),
    subject(
        "register",
        lambda cls: base._TASKS.pop(base.register(cls).name),
        cls=Argument(
            type("Fresh", (type(CARTPOLE),), {"name": "fresh"}),
            {
                "None": None,
                "a task": CARTPOLE,
                "a name": "cartpole",
                "another class": dict,
                "a name that is taken": type("Taken", (type(CARTPOLE),), {}),
                "without a name": type("NoName", (base.Task,), {}),
                "a number for a name": type("Number", (type(CARTPOLE),), {"name": 3}),
            },
        ),
    ),
    subject(
        "State",
        state.State,
        qpos=tensor(START.qpos, **of_three(3, 2)),
        qvel=tensor(START.qvel, **of_three(3, 2)),
        mocap_pos=optional(tensor(torch.zeros(2, 1, 3), planar=torch.zeros(2, 1, 2), **of_three(3, 1, 3))),
        mocap_quat=optional(tensor(torch.zeros(2, 1, 4), angles=torch.zeros(2, 1, 3), **of_three(3, 1, 4))),
        time=optional(tensor(torch.zeros(2), **of_three(3))),
        variables=Argument(
            {"target": torch.eye(2)},
            {
                "None": None,
                "a list": [torch.eye(2)],
                "of three rows": {"target": torch.eye(3)},
                "a number": {"target": 3.0},
                "named by a number": {3: torch.eye(2)},
            },
        ),
    ),
    subject(
        "rows",
        START.rows,
        ids=Argument(
            torch.tensor([1]),
            {
                "None": None,
                "text": "a",
                "one number": 1,
                "beyond": torch.tensor([7]),
                "a mask of three": torch.tensor([True] * 3),
                "fractions": torch.tensor([0.5]),
            },
        ),
    ),
    subject(
        "concatenate",
        state.concatenate,
        states=film.but(
            **{
                "of two tasks": [START, PUSH.sample_goal_state(2, None)],
                "mocap in one": [
                    START,
                    state.State(START.qpos, START.qvel, torch.zeros(2, 1, 3), torch.zeros(2, 1, 4)),
                ],
            }
        ),
    ),
    subject(
        "record",
        rendering.record,
        env=thing(ENV, task=CARTPOLE),
        policy=function(ENV.rand_action),
        start=state_,
        steps=optional(count(2, low=0)),
    ),
    subject(
        "render",
        functools.partial(rendering.render, CARTPOLE),
        states=film.but("empty", **{"of another task": [PUSH.sample_goal_state(1, None)]}),
        camera=optional(choice("side")),
        width=count(64, huge=10**7),
        height=count(48, huge=10**7),
    ),
    subject("render, task", lambda task: rendering.render(task, FILM, width=64, height=48), task=task),
    subject(
        "sheet",
        rendering.sheet,
        rows=Argument(
            [[IMAGE]],
            {
                "None": None,
                "empty": [],
                "an empty row": [[]],
                "one image": IMAGE,
                "texts": [["a"]],
                "of two sizes": [[IMAGE, IMAGE[1:]]],
                "floats": [[IMAGE / 2.0]],
            },
        ),
        captions=Argument(
            [["a"]], {"None": None, "empty": [], "too many": [["a", "b"]], "numbers": [[3]], "text": "a"}
        ),
    ),
    subject(
        "save",
        rendering.save,
        path=choice("film.png").but("misspelt", "other case", "true", "a number"),
        frames=frames,
        fps=number(25.0, zero=0.0),
    ),
    subject(
        "overlay",
        paths.overlay,
        task=Argument(PUSH, task.wrong),
        states=Argument(
            [PUSH.sample_goal_states(1, None, [0, 1])] * 2, film.wrong | {"of another task": FILM}
        ),
        elements=elements,
    ),
]


@each(SUBJECTS)
def test_malformed_arguments_are_refused(tried, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # where pictures are saved
    assert_refused(tried)


def test_what_can_be_taken_exactly_is_taken():
    push = base.create("anymal_push", friction=[0.5, 1], payload=np.float32(2), episode_seconds=np.int64(1))
    assert push.friction == (0.5, 1.0) and push.max_steps == 50
    repose = base.create("trifinger_repose", difficulty=torch.tensor(4), weak_finger=1.0)
    assert repose.difficulty == 4 and isinstance(repose.difficulty, int)
    assert len(CARTPOLE.sample_goal_states(np.int64(2), None, np.array([0, 1]))) == 4
    assert len(START.rows([1, 0])) == 2 and len(START.rows(slice(0))) == 0
