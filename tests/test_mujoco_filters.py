"""Filters of contacts and sites: what lacks its image weighs as much as it is felt."""

import mujoco
import numpy as np
import pytest

from tests.test_mujoco_derive import step_residual
from tests.test_mujoco_shapes import FLOOR, MIRROR, capsule, robot, rows
from torchrl_sym.mujoco import audit, derive
from torchrl_sym.mujoco.audit.encounters import POSES, Encounters

SHIN = capsule(-0.2)


def exclude(*pairs: tuple[str, str]) -> str:
    return "<contact>" + "".join(f'<exclude body1="{a}" body2="{b}"/>' for a, b in pairs) + "</contact>"


def walker(more: str = "", left: str = "", right: str = "", reach: float = -0.25) -> mujoco.MjModel:
    """Two legs with feet, which hang below the trunk or beside each other."""
    foot = """<body name="{0}_foot" pos="0 {1} {2}"><joint name="{0}_foot" axis="0 1 0" range="-1 1"/>
      <geom size=".03" mass=".1" {3}/></body>"""
    across = 0.0 if reach else -0.14
    return robot(
        SHIN + foot.format("left", across, reach, left),
        SHIN + foot.format("right", -across, reach, right),
        more=more,
    )


def row_of(report, term):
    (row,) = (row for row in report.residuals if row.term == term)
    return row


def test_an_exclude_between_parts_that_never_meet_is_approximate():
    report = audit(walker(exclude(("base", "left_foot"))), MIRROR)
    assert rows(report) == {"excludes": 0.01}
    assert report.verdict.startswith("approximate (largest residual 0.01: excludes")
    row = row_of(report, "excludes")
    assert row.kind == "collision"
    assert row.name == (
        "trunk with geom 3 of 'left_foot' (may not touch, their images may, and do in 0% of poses)"
    )


REDUNDANT = {
    "parent and child": exclude(("base", "left")),
    "parts that bits keep apart": exclude(("left", "right")),
    "both sides": exclude(("base", "left_foot"), ("base", "right_foot")),
    "itself its image": exclude(("left_foot", "right_foot")),
}


@pytest.mark.parametrize("more", REDUNDANT.values(), ids=REDUNDANT)
def test_excludes_that_change_nothing_are_exact(more):
    model = walker(more)
    legs = np.isin(model.geom_bodyid, [model.body("left").id, model.body("right").id])
    model.geom_contype[legs], model.geom_conaffinity[legs] = 0, 1
    assert audit(model, MIRROR).verdict == "exact"


def test_a_filter_may_be_an_exclude_here_and_bits_there():
    """The right foot's bits keep it from everything; so do the left one's excludes."""
    apart = [(other, "left_foot") for other in ("world", "base", "left", "right", "right_foot")]
    bits = 'contype="0" conaffinity="0"'
    assert audit(walker(exclude(*apart), right=bits), MIRROR).verdict == "exact"
    report = audit(walker(exclude(*apart[1:]), right=bits), MIRROR)  # it stands on the floor
    assert rows(report) == {"contype/conaffinity": 1.0}


def test_an_exclude_between_parts_that_often_meet_is_not_a_symmetry():
    """Feet that reach to the trunk."""
    model = robot(
        SHIN + '<body name="l" pos=".1 -.08 0"><joint axis="0 0 1" range="-1 1"/><geom size=".04"/></body>',
        SHIN + '<body name="r" pos=".1 .08 0"><joint axis="0 0 1" range="-1 1"/><geom size=".04"/></body>',
        more=exclude(("base", "l")),
    )
    report = audit(model, MIRROR)
    assert row_of(report, "excludes").residual > 0.5
    assert report.verdict.startswith("not a symmetry")


def test_coupled_joints_keep_parts_apart():
    """Fingers that would meet at random, but which an equality moves together."""
    finger = """<body name="{0}{1}" pos="{2} 0 0"><joint name="{0}{1}" axis="0 1 0" range="-1 1"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.2" size=".01" mass=".1"/></body>"""

    def hand(coupled: bool):
        sides = [finger.format(side, 1, 0.05) + finger.format(side, 2, -0.05) for side in ("l", "r")]
        tie = '<equality><joint joint1="{0}1" joint2="{0}2"/></equality>'
        ties = "".join(tie.format(side) for side in ("l", "r")) if coupled else ""
        return audit(robot(SHIN + sides[0], SHIN + sides[1], more=ties + exclude(("l1", "l2"))), MIRROR)

    assert rows(hand(coupled=True)) == {"excludes": 0.01}
    assert rows(hand(coupled=False))["excludes"] > 0.1


def test_what_floats_free_may_be_anywhere():
    balls = "".join(
        f'<body name="{name}" pos="1 {y} 1"><freejoint/><geom size=".05"/></body>'
        for name, y in (("p", 0.5), ("q", -0.5))
    )
    report = audit(robot(SHIN, SHIN, world=FLOOR + balls, more=exclude(("left", "p"))), MIRROR)
    assert row_of(report, "excludes").residual == 1
    report = audit(walker(left='contype="2" conaffinity="2"'), MIRROR)
    assert rows(report)["contype/conaffinity"] == 1  # one foot does not touch the floor


def test_the_share_of_poses_is_that_of_the_range():
    """A hand turns by a quarter to each side; a block takes the last third of one of them."""
    model = mujoco.MjModel.from_xml_string("""<mujoco><worldbody>
      <geom type="box" pos="0 1.5 0" size="2 1 2"/>
      <body><joint axis="0 0 1" range="-90 90"/>
        <geom type="capsule" fromto="0 0 0 1 0 0" size=".001"/></body></worldbody></mujoco>""")
    share = Encounters(model, mujoco.MjData(model), np.arange(2), model.geom_bodyid).share(0, 1)
    assert share == pytest.approx(1 / 3, abs=3 * (2 / 9 / POSES) ** 0.5)


PAIRS = {
    "parts that never meet": ('<pair geom1="trunk" geom2="left"/>', 0.01),
    "a foot and the floor": ('<pair geom1="floor" geom2="left"/>', 1.0),
}


@pytest.mark.parametrize(("pair", "residual"), PAIRS.values(), ids=PAIRS)
def test_an_explicit_pair_without_image_weighs_as_much_as_it_is_felt(pair, residual):
    contact = f'<contact>{pair}<pair geom1="floor" geom2="trunk"/>{{}}</contact>'
    feet = {side: f'name="{side}" contype="0" conaffinity="0"' for side in ("left", "right")}
    one, both = (walker(contact.format(x), **feet) for x in ("", pair.replace("left", "right")))
    assert rows(audit(one, MIRROR)) == {"contact pairs": residual}
    assert row_of(audit(one, MIRROR), "contact pairs").kind == "collision"
    assert audit(both, MIRROR).verdict == "exact"


# --- sites


def with_site(sensor: str, actuator: str = "", place: str = "0 -.067 0") -> mujoco.MjModel:
    more = f"<sensor>{sensor}</sensor><actuator>{actuator}</actuator>"
    return robot(SHIN, SHIN, base=f'<site name="imu" pos="{place}"/>', more=more)


@pytest.mark.parametrize("sensor", ["accelerometer", "velocimeter", "touch"])
def test_the_site_of_a_sensor_belongs_to_the_observation(sensor):
    report = audit(with_site(f'<{sensor} site="imu"/>'), MIRROR)
    assert set(rows(report)) == {"sensor sites"}
    assert row_of(report, "sensor sites").kind == "observation"
    assert rows(audit(with_site(f'<{sensor} site="imu"/>', place="0 0 0"), MIRROR)) == {}


@pytest.mark.parametrize("sensor", ['<gyro site="imu"/>', '<framequat objtype="site" objname="imu"/>'])
def test_what_reads_the_same_everywhere_may_be_anywhere(sensor):
    report = audit(with_site(sensor), MIRROR)
    assert report.verdict == "exact" and not report.warnings
    assert "imu" in audit(with_site(""), MIRROR).warnings[0]  # which nothing uses


def test_the_site_of_an_actuator_belongs_to_the_dynamics():
    thruster = '<general site="imu" gear="1 0 0 0 0 0"/>'
    model = with_site('<accelerometer site="imu"/>', thruster, place="0 -.002 0")
    row = row_of(audit(model, MIRROR), "transmission")
    assert row.kind == "dynamics" and row.residual > 1e-4


# --- sides on which tendons pass


def pulleys(left: str, right: str, where: str = "pulley", kind: str = "cylinder") -> mujoco.MjModel:
    """Two arms, each drawn by a tendon round a pulley on it; a side site is given as "x z"."""
    arms = sites = ""
    for name, y, place in (("left", 0.2, left), ("right", -0.2, right)):
        x, z = place.split() if place else ("", "")
        side = f'<site name="side_{name}" pos="{x} {{}} {z}"/>' if place else ""
        here = side.format(0) if where == "pulley" else ""
        sites += f'<site name="top_{name}" pos="0 {y} .3"/>' + side.format(y) * (where == "world")
        arms += f"""<body name="{name}" pos="0 {y} 0"><joint name="{name}" axis="0 1 0"/>{here}
          <geom name="{name}" type="{kind}" size=".05 .03" euler="90 0 0" mass="1" contype="0"
            conaffinity="0"/><site name="tip_{name}" pos="0 0 -.2"/></body>"""
    tendons = "".join(
        f'<spatial name="{name}" stiffness="50" springlength="0"><site site="top_{name}"/>'
        f'<geom geom="{name}" '
        + f'sidesite="side_{name}"' * bool(place)
        + f'/><site site="tip_{name}"/></spatial>'
        for name, place in (("left", left), ("right", right))
    )
    return mujoco.MjModel.from_xml_string(
        f"<mujoco><worldbody>{sites}{arms}</worldbody><tendon>{tendons}</tendon></mujoco>"
    )


def differs(model: mujoco.MjModel) -> bool:
    symmetry = derive(model, MIRROR)
    return max(step_residual(model, symmetry, 1, seed)[0] for seed in range(5)) > 1e-9


@pytest.mark.parametrize("where", ["pulley", "world"])
@pytest.mark.parametrize("kind", ["cylinder", "sphere"])
def test_a_tendon_passes_on_the_image_of_its_side(kind, where):
    same = pulleys(".08 0", ".08 0", where, kind)
    assert audit(same, MIRROR).verdict == "exact" and not differs(same)
    other = audit(pulleys(".08 0", "-.08 0", where, kind), MIRROR)
    assert other.outcome == "no"
    assert "side site side_right is not on the side of right that side_left is sent to" in other.verdict


@pytest.mark.parametrize(
    ("left", "right"), [(".08 0", ""), (".08 0", ".04 0"), (".08 0", "0 .08")],
    ids=["none", "inside", "turned"],
)  # fmt: skip
def test_sides_of_another_kind_are_found(left, right):
    report = audit(pulleys(left, right), MIRROR)
    assert report.outcome == "no"
    assert "left has no image: no tendon" in report.reason


def test_how_far_a_side_site_is_does_not_matter():
    model = pulleys(".08 0", ".16 0")
    report = audit(model, MIRROR)
    assert report.verdict == "exact" and not report.warnings and not differs(model)
