"""Malformed arguments of what takes a symmetry elsewhere: files, and the bridges to other trainers."""

import functools
import tempfile
from pathlib import Path
from types import SimpleNamespace

import mujoco
import pytest
import torch
from tensordict import TensorDict

from tests.malformed import Argument, assert_refused, choice, each, optional, subject, tensor, thing
from tests.managers import Manager, cfg
from torchrl_sym import PointGroup, Symmetry
from torchrl_sym.bridges import isaac_lab, mjlab
from torchrl_sym.bridges.rsl_rl import data_augmentation
from torchrl_sym.mujoco import derive
from torchrl_sym.representations import invariant, polar

MIRROR, K4 = PointGroup.reflection("y"), PointGroup.klein_four()
MODEL = mujoco.MjModel.from_xml_string("""<mujoco><worldbody>
    <body name="robot/l" pos="0 .1 0"><joint name="robot/left" axis="1 0 0"/><geom size=".1"/></body>
    <body name="robot/r" pos="0 -.1 0"><joint name="robot/right" axis="1 0 0"/><geom size=".1"/></body>
</worldbody></mujoco>""")
JOINTS = derive(MODEL, MIRROR).joints(["robot/left", "robot/right"])
SYMMETRY = Symmetry(MIRROR, {"policy": polar(MIRROR), "action": JOINTS})
FOLDER = Path(tempfile.mkdtemp())
SYMMETRY.save(FOLDER / "symmetry.json")


def joint_vel_rel() -> None:
    """Of the name of mjlab's, for what is read off it: names and settings."""


joint_vel_rel.__module__ = "mjlab.envs.mdp.observations"


def environment(default: tuple[float, float] = (0.0, 0.0)) -> SimpleNamespace:
    """What the bridges read of an environment of two joints."""
    frame = {"joint_vel": JOINTS, "height": invariant(MIRROR, 1)}
    terms = {"joint_vel": cfg(func=joint_vel_rel, params={}), "height": cfg(func=len, params={})}
    settings = SimpleNamespace(
        transmission_type=SimpleNamespace(name="JOINT"), entity_name="robot", clip=None
    )
    action = SimpleNamespace(cfg=settings, target_names=["left", "right"], scale=0.5, offset=0.0)
    return SimpleNamespace(
        observation_manager=Manager({"policy": terms}, frame),
        sim=SimpleNamespace(mj_model=MODEL),
        scene={"robot": SimpleNamespace(joint_names=("left", "right"), data=None)},
        action_manager=SimpleNamespace(active_terms=["joint_pos"], get_term=lambda name: action),
    )


def test_an_environment_is_read_without_its_simulator():
    symmetry = mjlab.symmetry(environment(), MIRROR, terms={"height": invariant(MIRROR, 1)})
    assert symmetry["policy"](torch.tensor([1.0, 2.0, 3.0]), "reflect-y").tolist() == [-2.0, -1.0, 3.0]
    assert symmetry["action"](torch.tensor([1.0, 2.0]), "reflect-y").tolist() == [-2.0, -1.0]


def path(right: Path, **more: object) -> Argument:
    wrong = {"None": None, "a number": 3, "a list": [str(right)], "a folder": FOLDER, "empty": ""}
    return Argument(right, wrong | {"in no folder": FOLDER / "no" / "file.json"} | more)


def terms(right: dict[object, object]) -> Argument:
    some = dict(right)
    name = next(iter(some))
    wrong = {
        "a list": list(some),
        "text": name,
        "a number": 3,
        "of nobody": some | {"nobody": JOINTS},
        "of another group": some | {name: invariant(K4, some[name].dim)},
        "another size": some | {name: invariant(MIRROR, 7)},
        "no representation": some | {name: 3},
        "Nones": dict.fromkeys(some),
        "too few": {},
    }
    return Argument(right, wrong)


others = Argument(
    {"pixels": polar(MIRROR)},
    {
        "a number": 3,
        "a list": ["pixels"],
        "text": "pixels",
        "a key that is none": {3: polar(MIRROR)},
        "a key of the manager": {"policy": invariant(MIRROR, 3)},
        "the action": {"action": JOINTS},
        "of another group": {"pixels": polar(K4)},
        "no representation": {"pixels": 3},
    },
)
env = Argument(
    environment(),
    {
        "None": None,
        "a number": 3,
        "text": "env",
        "no manager": SimpleNamespace(),
        "a list": [environment()],
    },
)
action = optional(thing(JOINTS, group=MIRROR, names=["left", "right"]).but("its class"))
mirror = thing(MIRROR, representation=JOINTS, name="reflection", symmetry=SYMMETRY)
AUGMENT = data_augmentation(SYMMETRY)
OBSERVED = TensorDict(policy=torch.zeros(5, 3), batch_size=[5])

SUBJECTS = [
    subject("Symmetry.save", SYMMETRY.save, path=path(FOLDER / "again.json")),
    subject("Symmetry.load", Symmetry.load, path=path(FOLDER / "symmetry.json")),
    subject(
        "data_augmentation",
        data_augmentation,
        symmetry=thing(SYMMETRY, group=MIRROR, representation=JOINTS),
        action_key=choice("action").but("a list"),
    ),
    subject(
        "augment",
        functools.partial(AUGMENT, None),
        obs=optional(thing(OBSERVED, group=SYMMETRY, dictionary=dict(OBSERVED.items()))),
        actions=optional(tensor(torch.zeros(5, 2))),
    ),
    subject(
        "isaac_lab.symmetry",
        isaac_lab.symmetry,
        env=env,
        terms=terms({"joint_vel": JOINTS, "height": invariant(MIRROR, 1)}),
        action=Argument(JOINTS, action.wrong | {"None": None}),
        others=others,
    ),
    subject(
        "mjlab.symmetry",
        mjlab.symmetry,
        env=env.but(**{"no model": SimpleNamespace(observation_manager=env.right.observation_manager)}),
        group=mirror,
        terms=terms({"height": invariant(MIRROR, 1)}),
        action=action,
        others=others,
        keyframe=Argument(None, {"of nobody": "stand", "a list": [0], "beyond": 3}),
    ),
]


@each(SUBJECTS)
def test_malformed_arguments_are_refused(tried):
    assert_refused(tried)


def test_an_argument_that_is_misspelt_is_refused():
    with pytest.raises(TypeError):
        data_augmentation(SYMMETRY, action_keys="action")
