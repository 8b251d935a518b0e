"""audit: exact on symmetric models, every single perturbation named at its term, public models as known."""

import importlib
import math
from pathlib import Path

import mujoco
import numpy as np
import pytest

from torchrl_sym import PointGroup
from torchrl_sym.mujoco import audit

K4, C2, C3, C4 = (PointGroup.klein_four(), *(PointGroup.rotation(n) for n in (2, 3, 4)))
ANGLES = {"K4": (35, -35, 145, -145), "C2": (0, 180), "C3": (0, 120, 240), "C4": (0, 90, 180, 270)}
GROUPS = {"K4": K4, "C2": C2, "C3": C3, "C4": C4}

LEG = """
<body name="hip{k}" pos="{x!r} {y!r} 0" euler="0 0 {angle!r}">
  <inertial mass=".5" pos=".05 0 0" diaginertia=".001 .002 .002"/>
  <joint name="hip{k}" axis="0 0 1" range="{hip_range}" damping=".1" armature=".01"/>
  <body name="shin{k}" pos=".1 0 0">
    <inertial mass="{mass}" pos="{com}" diaginertia="{inertia}"/>
    <joint name="knee{k}" axis="{axis}" pos="{anchor}" range="{range}" damping="{damping}"
      armature="{armature}" frictionloss="{frictionloss}" stiffness="{stiffness}"
      springref="{springref}" solreflimit="{limit}"/>
    <geom name="shin{k}" type="capsule" fromto="0 0 0 {tip}" size="{radius}" conaffinity="{conaffinity}"
      friction="{friction}" condim="{condim}" priority="{priority}" solref="{solref}" margin="{margin}"/>
    <geom name="foot{k}" type="box" pos=".1 0 -.3" size=".03 .02 .01" euler="{foot}" conaffinity="2"/>
    {extra}
    <site name="foot{k}" pos="{site}" size="{site_size}"/>
  </body>
</body>"""
ACTUATOR = """<general name="knee{k}" joint="knee{k}" gear="{gear}" gainprm="{gain}" biastype="affine"
  biasprm="0 {bias} -1" ctrllimited="true" ctrlrange="{ctrlrange}" forcelimited="true"
  forcerange="{forcerange}"/>"""
EQUALITY = '<connect name="link{k}" body1="shin{k}" body2="base" anchor="{link}"/>'
TENDON = """<fixed name="coil{k}" stiffness="{coil}" springlength="0">
  <joint joint="knee{k}" coef="2"/></fixed>
<spatial name="cord{k}" damping="{cord}"><site site="top{k}"/><site site="foot{k}"/></spatial>"""
DEFAULTS = {
    "hip_range": "-.5 .5", "mass": "1", "com": "0 0 -.1", "inertia": ".003 .004 .001", "axis": "0 1 0",
    "anchor": "0 0 0", "range": "-.2 .9", "damping": ".2", "armature": ".02", "frictionloss": ".1",
    "stiffness": "3", "springref": ".1", "limit": ".02 1", "tip": ".1 0 -.3", "radius": ".03",
    "conaffinity": "2", "friction": "1 .1 .1", "condim": "3", "priority": "0", "solref": ".02 1",
    "margin": "0", "foot": "0 0 0", "extra": "", "site": ".1 0 -.3", "site_size": ".04", "gear": "2",
    "gain": "30", "bias": "-30", "ctrlrange": "-1 2", "forcerange": "-5 6", "link": "0 0 -.2", "coil": "1",
    "cord": "1",
}  # fmt: skip


def robot(kind, changes=None, option='cone="elliptic"', more=""):
    """A floating base with equal legs at some angles; ``changes`` applies to the second leg only."""
    legs = []
    for k, degrees in enumerate(ANGLES[kind]):
        angle = np.radians(degrees)
        place = {
            "k": k,
            "angle": float(angle),
            "x": float(0.2 * np.cos(angle)),
            "y": float(0.2 * np.sin(angle)),
        }
        legs.append(DEFAULTS | place | ((changes or {}) if k == 1 else {}))
    tops = "".join('<site name="top{k}" pos="{x!r} {y!r} .1"/>'.format(**leg) for leg in legs)
    section = {
        name: "".join(part.format(**leg) for leg in legs)
        for name, part in {"leg": LEG, "act": ACTUATOR, "eq": EQUALITY, "tendon": TENDON}.items()
    }
    touches = "".join(f'<touch site="foot{k}"/>' for k in range(len(legs)))
    return mujoco.MjModel.from_xml_string(f"""<mujoco><compiler angle="radian"/><option {option}/>
      <worldbody><geom name="floor" type="plane" size="1 1 1"/>
        <body name="base" pos="0 0 1"><freejoint name="base"/>
          <geom name="base" type="capsule" size=".15 .05" mass="4"/>{tops}{section["leg"]}
        </body></worldbody>
      <actuator>{section["act"]}</actuator><tendon>{section["tendon"]}</tendon>
      <equality>{section["eq"]}</equality><sensor>{touches}</sensor>{more}</mujoco>""")


def broken(report):
    """Terms that differ, and the names of the parts that differ most."""
    rows = [row for row in report.residuals if row.residual > report.tolerance]
    return {row.term for row in rows}, " ".join(row.name for row in rows)


@pytest.mark.parametrize("kind", GROUPS)
def test_a_symmetric_robot_is_exact(kind):
    report = audit(robot(kind), GROUPS[kind])
    assert report.verdict == "exact", str(report)
    assert report.exact and not report.warnings and not report.unchecked
    assert {row.element for row in report.residuals} == set(GROUPS[kind].names[1:])


SLANT = f"{math.sin(math.radians(1))!r} {math.cos(math.radians(1))!r} 0"
PERTURBATIONS = {
    "mass": ({"mass": "1.01"}, "mass", "shin1"),
    "com": ({"com": "0 .001 -.1"}, "centre of mass", "shin1"),
    "inertia": ({"inertia": ".0031 .004 .001"}, "inertia", "shin1"),
    "axis": ({"axis": SLANT}, "joint axis", "knee1"),
    "anchor": ({"anchor": ".002 0 0"}, "joint anchor", "knee1"),
    "range": ({"range": "-.2 .91"}, "joint range", "knee1"),
    "damping": ({"damping": ".21"}, "damping", "knee1"),
    "armature": ({"armature": ".0201"}, "armature", "knee1"),
    "frictionloss": ({"frictionloss": ".101"}, "frictionloss", "knee1"),
    "stiffness": ({"stiffness": "3.1"}, "stiffness", "knee1"),
    "springref": ({"springref": ".11"}, "springref", "knee1"),
    "limit": ({"limit": ".021 1"}, "joint solref/solimp", "knee1"),
    "geom moved": ({"tip": ".1 .001 -.3"}, "collision geometry", "shin1"),
    "geom size": ({"radius": ".0301"}, "collision geometry", "shin1"),
    "geom turned": ({"foot": "0 0 .01"}, "collision geometry", "foot1"),
    "geom added": (
        {"extra": '<geom name="bump" size=".01" pos=".1 .1 0"/>'},
        "collision geometry",
        "bump (no image)",
    ),
    "friction": ({"friction": "1.01 .1 .1"}, "friction", "shin1"),
    "condim": ({"condim": "4"}, "condim", "shin1"),
    "priority": ({"priority": "1"}, "priority", "shin1"),
    "solref": ({"solref": ".021 1"}, "contact solref/solimp", "shin1"),
    "margin": ({"margin": ".001"}, "contact margin", "shin1"),
    "bits": ({"conaffinity": "1"}, "contype/conaffinity", "shin"),
    "touch size": ({"site_size": ".041"}, "sensor sites", "foot1"),
    "site moved": ({"site": ".1 .001 -.3"}, "tendon path", "cord1"),
    "gear": ({"gear": "2.01"}, "gear", "knee1"),
    "gain": ({"gain": "30.1"}, "actuator gain", "knee1"),
    "bias": ({"bias": "-30.1"}, "actuator bias", "knee1"),
    "ctrlrange": ({"ctrlrange": "-1 2.01"}, "ctrlrange", "knee1"),
    "forcerange": ({"forcerange": "-5 6.01"}, "forcerange", "knee1"),
    "connect": ({"link": "0 .001 -.2"}, "equality constraints", "link1"),
    "coil": ({"coil": "1.01"}, "tendon spring", "coil1"),
    "cord": ({"cord": "1.01"}, "tendon damping", "cord1"),
}


@pytest.mark.parametrize("kind", ["K4", "C3"])
@pytest.mark.parametrize(("change", "term", "name"), PERTURBATIONS.values(), ids=PERTURBATIONS)
def test_one_change_is_found_at_its_term_and_nowhere_else(kind, change, term, name):
    report = audit(robot(kind, change), GROUPS[kind])
    terms, names = broken(report)
    assert terms == {term} | ({"sensor sites"} if "site" in change else set()), str(report)
    assert name in names
    assert name in str(report) and term in report.verdict
    observed = term == "sensor sites"
    assert report.exact == observed
    assert observed or report.worst.term == term


def test_residuals_are_the_sizes_of_the_changes():
    def worst(**change):
        return audit(robot("K4", change), K4).worst.residual

    assert worst(mass="1.1") == pytest.approx(0.1 / (4 + 4 * 0.5 + 3 * 1 + 1.1), rel=1e-9)
    assert worst(axis=SLANT) == pytest.approx(np.sin(np.radians(1)), rel=1e-6)
    assert worst(range="-.2 1") == pytest.approx(0.1 / 1.2, rel=1e-9)
    assert worst(damping=".25") == pytest.approx(0.05 * 10 / (6 * 2), rel=1e-9)  # at 10 rad/s, of 12 N m
    assert worst(ctrlrange="-1 2.5") == pytest.approx(0.5 / 3.5, rel=1e-9)


@pytest.mark.parametrize(
    ("more", "term", "residual"),
    [
        ('<contact><exclude body1="base" body2="shin1"/></contact>', "excludes", 0.01),  # which seldom meet
        ('<contact><pair geom1="shin0" geom2="shin1"/></contact>', "contact pairs", 0.01),
        ('<contact><pair geom1="floor" geom2="shin1"/></contact>', "contact pairs", 1),
        ('<equality><joint name="lock" joint1="knee1"/></equality>', "equality constraints", 1),
        ('<equality><weld name="glue" body1="shin1" body2="base"/></equality>', "equality constraints", 1),
    ],
)
def test_one_sided_sets_are_found(more, term, residual):
    report = audit(robot("C3", more=more), C3)
    assert broken(report)[0] == {term}
    assert report.worst.residual == residual
    assert not report.exact


@pytest.mark.parametrize("section", ["equality", "contact"])
def test_sets_that_go_around_are_exact(section):
    pairs = [(0, 1), (1, 2), (2, 0)]
    parts = {
        "equality": '<weld body1="shin{}" body2="shin{}"/>',
        "contact": '<pair geom1="shin{}" geom2="shin{}"/>',
    }
    more = "".join(parts[section].format(*pair) for pair in pairs)
    assert audit(robot("C3", more=f"<{section}>{more}</{section}>"), C3).exact


def test_shapes_are_compared_not_frames():
    """A box turned by a right angle, a capsule upside down and a mirrored mesh are their images."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3], [1, 1, 1]]) / 10

    def mesh(points):
        return " ".join(map(str, points.ravel()))

    def text(size="2"):
        right = corners * [1, -1, 1] + np.array([0, 0.3, 0])
        return f"""<mujoco><asset><mesh name="l" vertex="{mesh(corners)}"/>
          <mesh name="r" vertex="{mesh(right)}"/>
          </asset><worldbody><geom type="plane" size="1 1 1"/>
          <body pos="0 1 1"><freejoint/><geom type="box" size=".1 .2 .3" mass="1"/>
            <geom type="capsule" size=".05 .1" pos="0 0 1" euler="30 0 0" mass="1"/>
            <geom type="mesh" mesh="l" pos="0 0 -1" mass="1"/></body>
          <body pos="0 -1 1"><freejoint/><geom type="box" size=".{size} .1 .3" euler="0 0 90" mass="1"/>
            <geom type="capsule" size=".05 .1" pos="0 0 1" euler="150 0 0" mass="1"/>
            <geom type="mesh" mesh="r" pos="0 -.3 -1" mass="1"/></body></worldbody></mujoco>"""

    def result(**change):
        model = mujoco.MjModel.from_xml_string(text(**change))
        return audit(
            model, PointGroup.reflection("y"), tolerance=1e-7
        )  # meshes are stored in single precision

    def shape(report):
        return max(row.residual for row in report.residuals if row.term == "collision geometry")

    assert shape(result()) < 1e-7, str(result())
    assert shape(result(size="21")) > 1e-3


def test_signs_and_offsets_flip_ranges():
    """Mirrored axes: the right knee's coordinate is minus the left one's, so is its range."""
    leg = """<body pos="0 {y} 0"><joint name="{name}" axis="{axis} 0 0" range="{range}"/>
      <geom size=".1"/></body>"""

    def result(right):
        legs = leg.format(y=1, name="left", axis=1, range="-10 70")
        legs += leg.format(y=-1, name="right", axis=1, range=right)
        model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{legs}</worldbody></mujoco>")
        return audit(model, PointGroup.reflection("y"))

    assert result("-70 10").exact
    assert result("-10 70").worst.term == "joint range"


@pytest.mark.parametrize(
    ("option", "words"),
    [
        ('cone="pyramidal"', "pyramidal friction cones follow the world's axes and break ['rot-120', "),
        ('cone="elliptic" solver="PGS"', "solver PGS treats contacts in order"),
        ('cone="elliptic" solver="CG"', "solver CG stops before"),
        ('cone="elliptic" noslip_iterations="2"', "noslip_iterations"),
    ],
)
def test_warns_before_anyone_trains(option, words):
    report = audit(robot("C3", option=option), C3)
    assert report.exact
    assert len(report.warnings) == 1 and words in report.warnings[0]
    assert f"warning: {report.warnings[0]}" in str(report)
    assert audit(robot("C3"), C3).warnings == ()


def test_pyramids_break_a_yawed_robot_but_not_a_fixed_one():
    assert "the base can yaw" in audit(robot("K4", option='cone="pyramidal"'), K4).warnings[0]
    assert audit(suite_model("hopper"), PointGroup.reflection("y")).warnings == ()


def test_a_group_that_does_not_fit_is_a_verdict_not_a_crash():
    report = audit(robot("K4"), C3)
    assert (
        report.verdict.startswith("not a symmetry (") and "has no image under 'rot-120'" in report.verdict
    )
    assert not report.exact and report.worst is None and report.residuals == ()
    tilted = audit(robot("K4", option='gravity="1 0 -9"'), K4)
    assert "tilts gravity" in tilted.verdict
    with pytest.raises(KeyError, match="no keyframe 'home'"):
        audit(robot("K4"), K4, "home")


def test_a_site_that_nothing_uses_is_a_warning():
    report = audit(robot("C2", {"extra": '<site name="mark" pos="0 0 .1"/>'}), C2)
    assert report.exact
    assert "1 sites are out of place (mark (no image))" in report.warnings[0]


def test_wind_counts_in_a_fluid_only():
    assert audit(robot("C2", option='cone="elliptic" wind="1 0 0"'), C2).exact
    blown = audit(robot("C2", option='cone="elliptic" wind="1 0 0" density="1.2"'), C2)
    assert broken(blown)[0] == {"wind"}


def test_unsupported_parts_are_named():
    model = mujoco.MjModel.from_xml_string("""<mujoco><asset><hfield name="hills" nrow="3" ncol="3"
      size="1 1 1 1"/></asset><worldbody><geom name="hills" type="hfield" hfield="hills"/>
      <body pos="0 0 2"><freejoint/><geom size=".1"/></body></worldbody></mujoco>""")
    report = audit(model, K4)
    assert report.verdict == "exact in what was checked"
    assert "not checked: the shape of height field 'hills'" in str(report)


def suite_model(name):
    if name in ("quadruped", "swimmer"):  # made by code
        suite = importlib.import_module("dm_control.suite")
        return suite.load(name, {"quadruped": "walk", "swimmer": "swimmer6"}[name]).physics.model.ptr
    text, assets = importlib.import_module(f"dm_control.suite.{name}").get_model_and_assets()
    return mujoco.MjModel.from_xml_string(text, assets)


@pytest.mark.parametrize(
    ("name", "axis"),
    [
        *((name, "x") for name in ("cartpole", "acrobot", "pendulum", "ball_in_cup", "swimmer")),
        *((name, "y") for name in ("reacher", "quadruped", "cheetah", "walker", "hopper")),
    ],
)
def test_models_of_dm_control_that_are_exact(name, axis):
    report = audit(suite_model(name), PointGroup.reflection(axis))
    assert report.verdict == "exact", str(report)


def test_the_humanoid_is_symmetric_but_for_one_range():
    report = audit(suite_model("humanoid"), PointGroup.reflection("y"))
    assert report.verdict.startswith(
        "approximate (largest residual 0.071: joint range, reflect-y, right_hip_y"
    )
    assert broken(report)[0] == {"joint range"}


def test_the_quadruped_does_not_turn_by_right_angles():
    report = audit(suite_model("quadruped"), C4)
    assert report.verdict.startswith("not a symmetry (")
    row = next(r for r in report.residuals if r.element == "rot-90" and r.term == "inertia")
    assert row.residual > 0.05 and row.name == "torso"


@pytest.mark.parametrize(
    ("name", "reason"), [("cheetah", "bshin has no image under 'reflect-x'"), ("walker", "joint range")]
)
def test_runners_have_a_front_and_a_back(name, reason):
    report = audit(suite_model(name), PointGroup.reflection("x"))
    assert report.verdict.startswith("not a symmetry (") and reason in report.verdict


def test_models_of_gymnasium():
    gymnasium = pytest.importorskip("gymnasium")
    folder = Path(gymnasium.__file__).parent / "envs/mujoco/assets"

    def load(name):
        return mujoco.MjModel.from_xml_path(str(folder / f"{name}.xml"))

    for group in (K4, C4):
        assert audit(load("ant"), group).verdict == "exact"
    assert audit(load("half_cheetah"), PointGroup.reflection("y")).exact
    humanoid = audit(load("humanoid"), PointGroup.reflection("y"))
    differs = {row.term: row.name for row in humanoid.residuals if row.residual > humanoid.tolerance}
    assert differs.keys() == {"armature", "stiffness"}
    assert "hip_y" in differs["armature"]  # right hip 0.008, left hip 0.01
    assert "knee" in differs["stiffness"]
