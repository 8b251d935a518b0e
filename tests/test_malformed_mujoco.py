"""Malformed models, keyframes, bodies, axes and numbers are refused by every verb for MuJoCo models."""

import copy
import functools

import mujoco
import numpy as np
import torch

import tasks
from tests.malformed import (
    Argument,
    assert_refused,
    choice,
    count,
    each,
    element,
    function,
    names,
    number,
    optional,
    subject,
    tensor,
    thing,
)
from torchrl_sym import PointGroup, Symmetry
from torchrl_sym import representations as r
from torchrl_sym.mujoco import (
    audit,
    derive,
    infer,
    symmetries,
    symmetrize,
    symmetrize_with_report,
    verify,
)
from torchrl_sym.mujoco.__main__ import named_group

LEGS = "".join(
    f"""<body name="leg{i}" euler="0 0 {120 * i}"><joint name="leg{i}" axis="0 1 0"/>
    <geom name="leg{i}" type="capsule" fromto="0 0 0 .5 0 0" size=".05"/></body>"""
    for i in range(3)
)
MJCF = f"""<mujoco><worldbody>{LEGS}
  <body name="cube" pos="0 0 1"><freejoint name="cube"/><geom type="box" size=".1 .1 .1"/></body>
  <body name="goal" mocap="true" pos="0 0 2"/></worldbody>
  <actuator>{"".join(f'<motor name="leg{i}" joint="leg{i}"/>' for i in range(3))}</actuator>
  <sensor>{"".join(f'<jointpos name="leg{i}" joint="leg{i}"/>' for i in range(3))}</sensor>
  <keyframe><key name="home"/><key/></keyframe></mujoco>"""
GROUP = PointGroup.rotation(3)
MODEL, SPEC = mujoco.MjModel.from_xml_string(MJCF), mujoco.MjSpec.from_string(MJCF)
ROBOT = derive(MODEL, GROUP, carried=["cube", "goal"])
ENV = tasks.make_env("cartpole", num_envs=8, num_threads=1)


def broken(field: str, value: float = np.nan, **options: object) -> mujoco.MjModel:
    """The model with one number of a field spoilt after it was compiled."""
    model = copy.copy(MODEL)
    getattr(model, field).flat[-1] = value
    return model


SPOILT = {
    f"{field} {value}": broken(field, value)
    for field in ("body_mass", "body_inertia", "body_pos", "geom_size", "qpos0", "key_qpos", "jnt_range",
                  "actuator_gainprm", "dof_damping")
    for value in (np.nan, np.inf)
    if not (field == "key_qpos" and value)
}  # fmt: skip
empty = mujoco.MjModel.from_xml_string("<mujoco/>")
group = thing(GROUP, **{"a representation": r.polar(GROUP), "a name": "rotation-3"})
model = thing(
    MODEL,
    **{
        "a specification": SPEC,
        "simulation data": mujoco.MjData(MODEL),
        "a path": "robot.xml",
        "MJCF": MJCF,
    },
    **{"an empty model": empty},
    **SPOILT,
)
spec = thing(
    SPEC,
    **{"a compiled model": MODEL, "a path": "robot.xml", "MJCF": MJCF, "an empty one": mujoco.MjSpec()},
)
keyframe = optional(choice("home", beyond=MODEL.nkey, negative=-1)).but("a number")
carried = names(["cube", "goal"], fixed=["world"], hinged=["leg0"]).but("one text", "empty", "one twice")
tolerance = number(1e-2)
axis = Argument(
    None,
    {
        "one number": 0.1,
        "of three": (0.0, 0.0, 0.0),
        "of text": ("0", "0"),
        "text": "xy",
        "not a number": (0.0, np.nan),
        "infinite": (np.inf, 0.0),
        "a flag": True,
        "nested": [[0.0, 0.0]],
    },
)
found = {"keyframe": keyframe, "axis": axis, "tolerance": tolerance, "carried": carried}
shared = {"group": group, **found}
qpos, qvel, ctrl = (torch.zeros(2, size) for size in (MODEL.nq, MODEL.nv, MODEL.nu))
rows = {
    "flags": torch.tensor([True, False]),
    "beyond": torch.tensor([0, 3]),
    "of three": torch.zeros(3, dtype=torch.long),
}
g = element("rot-120", 3, **rows)


def vectors(right: torch.Tensor) -> Argument:
    return tensor(right, **{"too wide": torch.zeros(*right.shape[:-1], right.shape[-1] + 1)})


SUBJECTS = [
    subject("derive", derive, model=model, **shared),
    subject("audit", audit, model=model, **shared),
    subject("symmetries", symmetries, model=model, **found),
    subject(
        "infer",
        infer,
        env=thing(ENV, model=MODEL),
        group=thing(ENV.symmetry.group, **{"of another kind": r.polar(GROUP), "a name": "reflect-x"}),
        keyframe=Argument(None, keyframe.wrong),
        axis=axis,
        carried=Argument((), carried.wrong),
        samples=count(24, low=12, **{"a billion": 10**9}),
        seed=count(2, low=0, huge=2**70),
        tolerance=number(1e-4),
        observe=optional(function(lambda observation: observation)),
    ),
    subject("symmetrize", symmetrize, spec=spec, **shared),
    subject("symmetrize_with_report", symmetrize_with_report, spec=spec, **shared),
    subject(
        "verify",
        functools.partial(verify, ENV),
        symmetry=thing(
            ENV.symmetry,
            **{
                "a mapping": {"action": r.polar(GROUP)},
                "without action": Symmetry(GROUP, {"observation": r.polar(GROUP)}),
                "of another size": Symmetry(
                    GROUP, {"observation": r.polar(GROUP), "action": r.polar(GROUP)}
                ),
            },
        ),
        keyframe=Argument(None, {**keyframe.wrong, "that is ignored": "home"}),
        carried=Argument((), {**carried.wrong, "that are ignored": ["cube", "goal"]}),
        states=count(2, **{"a billion": 10**9}),
        steps=count(2, **{"a billion": 10**9}),
        tolerance=tolerance,
        seed=count(2, low=0, huge=2**70),
        observe=optional(function(lambda observation: observation)),
    ),
    subject(
        "verify, dm_control",
        functools.partial(verify, tasks.load("cartpole"), ENV.symmetry, states=1, steps=1),
        keyframe=Argument(None, {**keyframe.wrong, "unknown": "home"}),
        carried=Argument((), {**carried.wrong, "unknown": ["cube"]}),
    ),
    subject(
        "verify, env", lambda env: verify(env, ENV.symmetry, states=1, steps=1), env=thing(ENV, model=MODEL)
    ),
    subject(
        "joints",
        ROBOT.joints,
        names=names(["leg0", "leg1", "leg2"], ordered=True, some=["leg0"], free=["cube"]).but("empty"),
    ),
    subject(
        "sensors",
        ROBOT.sensors,
        names=names(["leg0", "leg1", "leg2"], ordered=True, some=["leg0"]).but("empty"),
    ),
    subject("table", ROBOT.table, kind=choice("joint"), g=element("rot-120", 3)),
    subject("offsets", ROBOT.offsets, g=element("rot-120", 3)),
    subject("map_qpos", ROBOT.map_qpos, qpos=vectors(qpos), g=g),
    subject("map_qvel", ROBOT.map_qvel, qvel=vectors(qvel), g=g),
    subject("map_ctrl", ROBOT.map_ctrl, ctrl=vectors(ctrl), g=g),
    subject(
        "map_mocap",
        ROBOT.map_mocap,
        position=vectors(torch.zeros(2, 1, 3)),
        rotation=vectors(torch.ones(2, 1, 4)),
        g=g,
    ),
    subject("VerifyReport.of", verify(ENV, ENV.symmetry, states=1, steps=1).of, part=choice("reward")),
    subject(
        "named_group",
        named_group,
        name=choice(
            "rotation-3",
            **{
                w: w
                for w in (
                    "rotation-0",
                    "rotation--3",
                    "rotation-3.5",
                    "rotation-²",
                    "rotation-",
                    "dihedral-1000000000",
                    "reflect-z",
                    "rotation-1000000000",
                )
            },
        ).but("other case"),
    ),
]


@each(SUBJECTS)
def test_malformed_arguments_are_refused(tried):
    assert_refused(tried)
