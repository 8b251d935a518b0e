"""Which contacts are mirrored: the audit warns of those pairs of shapes whose mirrored steps differ."""

import itertools

import mujoco
import numpy as np
import pytest
import torch
from packaging.version import Version

from torchrl_sym import PointGroup
from torchrl_sym.mujoco import audit, derive
from torchrl_sym.mujoco.model.filters import Filters

MIRROR = PointGroup.reflection("y")
NATIVE, LIBCCD = "", '<flag nativeccd="disable"/>'
SHAPES = {
    "sphere": 'type="sphere" size=".02"',
    "capsule": 'type="capsule" size=".02 .06" quat=".7 0 .7 0"',
    "ellipsoid": 'type="ellipsoid" size=".1 .04 .02"',
    "cylinder": 'type="cylinder" size=".05 .02"',
    "box": 'type="box" size=".1 .04 .02"',
    "mesh": 'type="mesh" mesh="pebble{}"',
    "slab": 'type="mesh" mesh="slab{}"',
    "prism": 'type="mesh" mesh="prism{}"',
}
ANGLES = np.arange(6) * np.pi / 3 + 0.1
SPIRAL, HEIGHT = np.arange(60) * np.pi * (3 - 5**0.5), 1 - (2 * np.arange(60) + 1) / 60
RADIUS = np.sqrt(1 - HEIGHT**2)
POINTS = {
    "pebble": np.stack([RADIUS * np.cos(SPIRAL), RADIUS * np.sin(SPIRAL), HEIGHT], 1) * [0.1, 0.05, 0.02],
    "slab": np.array(
        [
            (x, y, z)
            for z in (-0.02, 0.02)
            for x, y in ((-0.1, -0.03), (0.1, -0.03), (0.1, 0.04), (-0.1, 0.04))
        ]
    ),
    "prism": np.array([(0.08 * np.cos(a), 0.08 * np.sin(a), z) for z in (-0.02, 0.02) for a in ANGLES]),
}
HILLS = np.random.default_rng(0).uniform(0, 0.05, (12, 8)).round(3)
EXACT = {
    *itertools.product(["plane"], ["sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh", "slab"]),
    *itertools.product(["sphere"], ["sphere", "capsule", "cylinder", "box"]),
    *(("capsule", "capsule"), ("capsule", "box"), ("box", "box")),
}
LATELY = {("capsule", "mesh"), ("box", "mesh"), ("mesh", "mesh")}  # MuJoCo 3.11 mirrors nearly all of them
KINDS = ["sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh"]
PAIRS = [
    *itertools.product(["plane"], SHAPES),
    *itertools.product(["hfield"], ["sphere", "box"]),
    *itertools.combinations_with_replacement(KINDS, 2),
]


def numbers(values) -> str:
    return " ".join(f"{x:.17g}" for x in np.ravel(values))


def two_on_two(ground: str, shape: str, flag: str) -> mujoco.MjModel:
    """Two bodies above the ground, or each above a shape; only they and what is below them may touch."""
    points = {f"{k}{side}": v * [1, s, 1] for k, v in POINTS.items() for side, s in (("L", 1), ("R", -1))}
    assets = "".join(f'<mesh name="{name}" vertex="{numbers(v)}"/>' for name, v in points.items())
    hills = numbers(np.concatenate([HILLS, HILLS[::-1]]))
    assets += f'<hfield name="hills" nrow="24" ncol="8" size=".3 .5 .05 .1" elevation="{hills}"/>'
    below = {
        "plane": '<geom name="L" type="plane" size="2 2 .1" pos="0 0 .04"/>',
        "hfield": '<geom name="L" type="hfield" hfield="hills"/>',
    }
    one = "L" if ground in below else "R"
    static, moving, pairs = below.get(ground, ""), "", ""
    for side, y in (("L", 0.2), ("R", -0.2)):
        if ground in SHAPES:
            static += f'<geom name="{side}" {SHAPES[ground].format(side)} pos="0 {y} .02"/>'
        # half a turn leaves a shape as it is, but not the rounding of its frame
        turn = '<frame quat="0 0 0 1">{}</frame>' if side == "R" and '"mesh"' not in SHAPES[shape] else "{}"
        geom = turn.format(f'<geom name="{shape}{side}" {SHAPES[shape].format(side)} mass="1"/>')
        moving += f'<body pos=".02 {y} .065"><freejoint/>{geom}</body>'
        pairs += f'<pair geom1="{side if one == "R" else one}" geom2="{shape}{side}"/>'
    return mujoco.MjModel.from_xml_string(f"""<mujoco><option cone="elliptic" tolerance="1e-12"
      iterations="200">{flag}</option><default><geom contype="0" conaffinity="0"/></default>
      <asset>{assets}</asset><worldbody>{static}{moving}</worldbody><contact>{pairs}</contact></mujoco>""")


def step_errors(model: mujoco.MjModel, runs: int = 8):
    """Velocity errors of mirrored steps against steps of the mirror, in contact."""
    robot, rng = derive(model, MIRROR), np.random.default_rng(0)

    def image(x):
        return robot.map_qvel(torch.tensor(np.array(x)), 1).numpy()

    for _ in range(runs):
        data, other = mujoco.MjData(model), mujoco.MjData(model)
        data.qvel[:] = rng.normal(size=12) * 0.3
        data.qpos[3:7] += rng.normal(size=4) * 0.05
        data.qpos[10:14] += rng.normal(size=4) * 0.05
        mujoco.mj_normalizeQuat(model, data.qpos)
        mujoco.mj_step(model, data, 15)
        for _ in range(4):
            mujoco.mj_step(model, data, 10)
            other.qpos[:] = robot.map_qpos(torch.tensor(data.qpos), 1)
            other.qvel[:], other.qacc_warmstart[:] = image(data.qvel), image(data.qacc_warmstart)
            mujoco.mj_step(model, data)
            mujoco.mj_step(model, other)
            if data.ncon:
                yield float(np.abs(image(data.qvel) - other.qvel).max())


@pytest.mark.parametrize("flag", [NATIVE, LIBCCD], ids=["native", "libccd"])
@pytest.mark.parametrize("pair", PAIRS, ids="-".join)
def test_warns_of_the_contacts_that_are_not_mirrored(pair, flag):
    model = two_on_two(*pair, flag)
    report = audit(model, MIRROR, tolerance=1e-7)
    assert report.reason is None
    if pair in EXACT or (pair == ("sphere", "mesh") and flag == NATIVE):
        assert report.warnings == ()
        errors = list(step_errors(model))
        assert len(errors) > 5
        assert max(errors) < 1e-9
    else:
        assert len(report.warnings) == 1
        words = [
            {"hfield": "height field", "prism": "mesh", "slab": "mesh"}.get(kind, kind) for kind in pair
        ]
        assert report.warnings[0].startswith(f"contacts of {words[0]} with {words[1]} (")
        if pair not in LATELY or flag != NATIVE or Version(mujoco.__version__) >= Version("3.17"):
            assert any(error > 1e-8 for error in step_errors(model, runs=100))


SILENT = ('<flag contact="disable"/>', '<flag constraint="disable"/>')
FILTERS = {
    "plain": ("", ""),
    "exclude": ("", '<contact><exclude body1="base" body2="foot"/></contact>'),
    "a pair": ("", '<contact><pair geom1="ghost" geom2="leg"/><pair geom1="base" geom2="leg"/></contact>'),
    "a pair in spite of an exclude": (
        "",
        '<contact><exclude body1="base" body2="foot"/><pair geom1="base" geom2="foot"/></contact>',
    ),
    "no filter of parents": ('<flag filterparent="disable"/>', ""),
    "no contacts": (SILENT[0], ""),
    "no constraints": (SILENT[1], ""),
}


@pytest.mark.parametrize(("flag", "more"), FILTERS.values(), ids=FILTERS)
def test_geoms_that_may_collide_are_those_that_do_when_all_overlap(flag, more):
    model = mujoco.MjModel.from_xml_string(f"""<mujoco><option>{flag}</option>
      <default><geom size=".1"/></default>
      <worldbody><geom name="floor" type="plane" size="1 1 1"/><geom name="rock"/>
        <body mocap="true"><geom name="hand"/></body>
        <body name="base"><freejoint/><geom name="base"/><geom name="ghost" contype="0" conaffinity="0"/>
          <body><geom name="welded"/></body>
          <body name="leg" pos=".001 0 0"><joint axis="0 1 0"/><geom name="leg"/>
            <body name="foot" pos=".001 0 0"><joint axis="0 1 0"/><geom name="foot" contype="2"/></body>
          </body>
          <body pos="0 .001 0"><joint axis="1 0 0"/><geom name="tail" contype="2" conaffinity="2"/></body>
        </body>
      </worldbody>{more}</mujoco>""")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    touching = {tuple(sorted(map(int, pair))) for pair in data.contact.geom}
    filters = Filters(model)
    allowed = {
        (a, b)
        for a, b in itertools.combinations(range(model.ngeom), 2)
        if filters.may[filters.of[a], filters.of[b]]
    }
    assert allowed | filters.pairs == touching
    assert bool(touching) == (flag not in SILENT)


def hexapod(option: str = "", more: str = "", shape: str = "cylinder") -> mujoco.MjModel:
    legs = "".join(
        f'<body name="leg{k}" pos="{x} {y} 0"><joint axis="0 1 0"/><geom name="leg{k}" type="{shape}" '
        f'size=".02 .02 .02"/></body>'
        for k, (x, y) in enumerate(itertools.product((-1, 0, 1), (1, -1)))
    )
    return mujoco.MjModel.from_xml_string(f"""<mujoco><option cone="elliptic">{option}</option>
      <worldbody><geom name="floor" type="plane" size="1 1 1"/>
      <geom name="step" type="box" size="1 1 .1" pos="0 0 -1"/>
      <body name="base" pos="0 0 1"><freejoint/><geom name="base" type="sphere" size=".1"/>{legs}</body>
      </worldbody>{more}</mujoco>""")


def test_the_warning_names_the_pairs_and_stays_short():
    (warning,) = audit(hexapod(), MIRROR).warnings
    assert warning.startswith(
        "contacts of cylinder with box (leg0 and step, leg1 and step, 4 more), "
        "cylinder with cylinder (leg0 and leg1, leg0 and leg2, 13 more) are not mirrored: "
    )
    assert "use spheres, capsules and boxes there" in warning
    assert f"warning: {warning}" in str(audit(hexapod(), MIRROR))


def test_no_warning_of_what_cannot_meet():
    assert audit(hexapod('<flag contact="disable"/>'), MIRROR).warnings == ()
    assert audit(hexapod(shape="capsule"), MIRROR).warnings == ()
    alone = hexapod(
        more='<contact><pair geom1="leg0" geom2="floor"/><pair geom1="leg1" geom2="floor"/></contact>'
    )
    alone.geom_contype[:] = alone.geom_conaffinity[:] = 0
    assert audit(alone, MIRROR).warnings == ()
    named = hexapod(
        more='<contact><pair geom1="leg0" geom2="step"/><pair geom1="leg1" geom2="step"/></contact>'
    )
    named.geom_contype[:] = named.geom_conaffinity[:] = 0
    (warning,) = audit(named, MIRROR).warnings
    assert warning.startswith("contacts of cylinder with box (leg0 and step, leg1 and step) are not")
