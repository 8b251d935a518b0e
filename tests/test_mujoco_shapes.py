"""Shapes of the audit: surfaces rather than pieces, scenery apart, nothing vacuous, linear in geoms."""

import time

import mujoco
import numpy as np
import pytest
from scipy.optimize import linear_sum_assignment

from torchrl_sym import PointGroup
from torchrl_sym.mujoco import audit
from torchrl_sym.mujoco.audit.pairing import pair
from torchrl_sym.mujoco.model.filters import Filters, active_geoms
from torchrl_sym.mujoco.model.shapes import DIRECTIONS, geom_supports
from torchrl_sym.mujoco.model.surfaces import outside, surface_points

MIRROR = PointGroup.reflection("y")
FLOOR = '<geom name="floor" type="plane" size="5 5 .1"/>'
SHAPES = {
    "sphere": 'type="sphere" size=".1"',
    "capsule": 'type="capsule" size=".05 .2"',
    "ellipsoid": 'type="ellipsoid" size=".1 .2 .05"',
    "cylinder": 'type="cylinder" size=".1 .2"',
    "box": 'type="box" size=".1 .2 .05"',
    "mesh": 'type="mesh" mesh="wedge"',
}
WEDGE = '<asset><mesh name="wedge" vertex="0 0 0 .3 0 0 0 .2 0 0 0 .1 .2 .2 .1"/></asset>'


def robot(left: str, right: str, world: str = FLOOR, more: str = "", base: str = "") -> mujoco.MjModel:
    """A floating trunk with two legs, whose geoms are given; mass and joints are mirrored."""
    legs = "".join(
        f'<body name="{name}" pos="0 {y} 0"><joint name="{name}" axis="0 1 0" range="-1 1"/>'
        f'<inertial mass="1" pos="0 0 -.15" diaginertia=".01 .01 .01"/>{geoms}</body>'
        for name, y, geoms in (("left", 0.15, left), ("right", -0.15, right))
    )
    return mujoco.MjModel.from_xml_string(f"""<mujoco><compiler angle="radian"/><option cone="elliptic"/>
      {WEDGE}<worldbody>{world}<body name="base" pos="0 0 .5"><freejoint/>
      <geom name="trunk" type="box" size=".2 .1 .05" mass="5"/>{base}{legs}</body></worldbody>{more}
      </mujoco>""")


def rows(report) -> dict[str, float]:
    """What differs, by term."""
    return {row.term: row.residual for row in report.residuals if row.residual > report.tolerance}


def capsule(low: float, high: float = 0.0, more: str = "") -> str:
    return f'<geom type="capsule" fromto="0 0 {high} 0 0 {low}" size=".02" {more}/>'


def box(low: float, high: float, more: str = "") -> str:
    middle, half = (low + high) / 2, (high - low) / 2
    return f'<geom type="box" pos="0 0 {middle}" size=".03 .04 {half}" {more}/>'


FOOT = '<geom size=".04" pos="0 0 -.3"/>'
ALIKE = {
    "twice": (capsule(-0.3) * 2, capsule(-0.3)),
    "contained": (capsule(-0.3) + capsule(-0.2, -0.1), capsule(-0.3)),
    "two capsules in a row": (capsule(-0.3), capsule(-0.15) + capsule(-0.3, -0.15)),
    "a box in two halves": (box(-0.3, 0), box(-0.15, 0) + box(-0.3, -0.15)),
    "halves and thirds": (
        box(-0.3, -0.15) + box(-0.15, 0),
        box(-0.3, -0.2) + box(-0.2, -0.1) + box(-0.1, 0),
    ),
    "a ball in a box": (box(-0.3, 0) + '<geom size=".02" pos="0 0 -.1"/>', box(-0.3, 0)),
    "a capsule without length": ('<geom type="capsule" size=".03 1e-9"/>', '<geom size=".03"/>'),
}
UNLIKE = {
    "a foot on one side": (capsule(-0.3) + FOOT, capsule(-0.3)),
    "a foot in another place": (capsule(-0.3) + FOOT, capsule(-0.3) + FOOT.replace("-.3", ".3")),
    "nothing on one side": (capsule(-0.3), ""),
    "a gap in the middle": (box(-0.3, 0), box(-0.1, 0) + box(-0.3, -0.2)),
    "half of it": (box(-0.3, 0), box(-0.15, 0)),
    "one piece too many": (box(-0.3, 0), box(-0.15, 0) + box(-0.3, -0.15) + FOOT),
    "twice, but one moved": (capsule(-0.3) * 2, capsule(-0.3) + capsule(0.3)),
}


@pytest.mark.parametrize("swap", [False, True])
@pytest.mark.parametrize("pieces", ALIKE.values(), ids=ALIKE)
def test_other_pieces_of_one_surface_are_approximate(pieces, swap):
    report = audit(robot(*pieces[:: -1 if swap else 1]), MIRROR)
    assert report.verdict.startswith("approximate (largest residual 0.01: collision pieces"), str(report)
    assert set(rows(report)) == {"collision pieces"}
    assert not report.exact


@pytest.mark.parametrize("swap", [False, True])
@pytest.mark.parametrize("pieces", UNLIKE.values(), ids=UNLIKE)
def test_what_sticks_out_is_not_a_symmetry(pieces, swap):
    report = audit(robot(*pieces[:: -1 if swap else 1]), MIRROR)
    assert report.verdict.startswith("not a symmetry"), str(report)
    assert rows(report)["collision geometry"] > 0.1


def test_pieces_on_both_sides_are_exact():
    for geoms in (capsule(-0.3) * 2, box(-0.15, 0) + box(-0.3, -0.15)):
        assert audit(robot(geoms, geoms), MIRROR).verdict == "exact"


def test_the_turn_of_three_sees_pieces_from_every_side():
    def limbs(*geoms):
        bodies = "".join(
            f'<body euler="0 0 {120 * k}"><body pos=".3 0 0"><joint axis="0 1 0"/>'
            f'<inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/>{each}</body></body>'
            for k, each in enumerate(geoms)
        )
        return mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{FLOOR}{bodies}</worldbody></mujoco>")

    turn = PointGroup.rotation(3)
    one = audit(limbs(capsule(-0.3) * 2, capsule(-0.3), capsule(-0.3)), turn)
    assert set(rows(one)) == {"collision pieces"}
    two = audit(limbs(capsule(-0.3) + FOOT, capsule(-0.3), capsule(-0.3)), turn)
    assert two.verdict.startswith("not a symmetry (1: collision geometry, rot-120, geom 2 of '")
    for report in (one, two):  # an element and its inverse say the same
        assert {row.element for row in report.residuals if row.residual > 1e-8} == set(turn.names[1:])


def test_a_redundant_geom_is_named_with_its_body():
    report = audit(robot(capsule(-0.3) * 2, capsule(-0.3)), MIRROR)
    assert "geom 3 of 'left' (no single image, but geoms of 'right' cover it)" in report.verdict


def test_a_geom_without_image_is_named_with_the_nearest():
    report = audit(robot(capsule(-0.3) + capsule(-0.3, 0.2), capsule(-0.3)), MIRROR)
    row = next(row for row in report.residuals if row.term == "collision geometry")
    assert row.name == "geom 3 of 'left' (no image; geom 4 of 'right' is nearest, 198 mm off)"


def test_a_redundant_geom_with_other_parameters_is_no_redundant_geom():
    double = capsule(-0.3) + capsule(-0.3, more='friction="2 .005 .0001"')
    assert rows(audit(robot(double, capsule(-0.3)), MIRROR)) == pytest.approx(
        {"collision pieces": 0.01, "friction": 0.5}
    )


def test_only_the_friction_that_contacts_have_is_compared():
    def friction(condim):
        legs = [capsule(-0.3, more=f'condim="{condim}" friction="1 {t} .1"') for t in (0.1, 0.2)]
        return rows(audit(robot(*legs), MIRROR))

    assert friction(3) == {}
    assert friction(4) == pytest.approx({"friction": 0.5})


def test_margins_are_lengths():
    legs = [capsule(-0.3, more=f'margin="{margin}"') for margin in (0.001, 0.002)]
    assert 0 < rows(audit(robot(*legs), MIRROR))["contact margin"] < 0.01


# --- the functions below


@pytest.mark.parametrize("shape", SHAPES)
def test_support_functions_and_surfaces_agree(shape):
    """All points of a surface are within its support function, some reach it, none is outside."""
    geom = f'<geom {SHAPES[shape]} pos=".1 .2 .3" euler=".3 .4 .5"/>'
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco>{WEDGE}<worldbody><body>{geom}</body></worldbody></mujoco>"
    )
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    reach = geom_supports(model, data, np.array([0]), DIRECTIONS)[0]
    points = surface_points(model, data, 0)
    heights = points @ DIRECTIONS.T
    assert (heights - reach).max() < 1e-9
    assert heights.max(axis=0) == pytest.approx(reach, abs=0.01)
    assert outside(model, data, 0, points).max() < 1e-6
    center = points.mean(axis=0)
    assert (outside(model, data, 0, center + 1.01 * (points - center)) > 0).mean() > 0.9


@pytest.mark.parametrize("shape", ["sphere", "capsule", "cylinder", "box"])
def test_distances_are_those_of_the_simulator(shape):
    ball = '<body mocap="true"><geom size=".01"/></body>'
    geom = f'<geom {SHAPES[shape]} pos=".1 .2 .3" euler=".3 .4 .5"/>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco>{WEDGE}<worldbody>{geom}{ball}</worldbody></mujoco>")
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    for _ in range(20):
        data.mocap_pos[0] = rng.uniform(-0.5, 0.8, 3)
        mujoco.mj_kinematics(model, data)
        far = mujoco.mj_geomDistance(model, data, 0, 1, 5.0, None) + 0.01
        if far > 0.02:
            assert outside(model, data, 0, data.mocap_pos)[0] == pytest.approx(far, abs=1e-6)


@pytest.mark.parametrize("count", [10, 64, 200])
def test_pairs_are_those_of_the_assignment(count):
    rng = np.random.default_rng(count)
    ids = np.arange(count)
    theirs = rng.uniform(-1, 1, (count, 3)) @ DIRECTIONS.T + rng.uniform(0, 0.1, (count, 1))
    order = rng.permutation(count)
    mine = theirs[order] + 1e-4 * rng.standard_normal(theirs.shape)
    rows_, columns = pair(mine, theirs, ids, ids)
    best = linear_sum_assignment(np.abs(mine[:, None] - theirs).max(axis=-1))
    assert np.array_equal(rows_, best[0]) and np.array_equal(columns, best[1])
    assert np.array_equal(columns, order)


def test_what_is_in_one_place_stays():
    ids = np.arange(300)
    same = np.zeros((300, len(DIRECTIONS)))
    assert np.array_equal(pair(same[:20], same[:20], ids[:20], ids[:20])[1], ids[:20])
    rows_, columns = pair(same, same[:299], ids, ids[:299])  # more than are offered at a time
    assert len(set(rows_)) == len(set(columns)) == 299


# --- scenery


BLOCKS = '<geom type="box" pos="0 1 0" size="1 1 .1"/><geom type="box" pos="0 -1 0" size="1 1 .1" {}/>'
SCENERY = {
    "a wall": ("scenery geometry", '<geom type="box" pos="0 60 1" size="60 .1 1"/>'),
    "a slope": ("scenery geometry", '<geom type="plane" size="5 5 1" euler=".1 0 0"/>'),
    "a table": ("scenery geometry", '<body pos="2 1 0"><geom type="cylinder" size=".3 .02"/></body>'),
    "one half is slippery": ("scenery contacts", BLOCKS.format('friction=".5 .005 .0001"')),
    "one half is soft": ("scenery contacts", BLOCKS.format('solref=".05 1"')),
    "one half lets through": ("scenery filters", BLOCKS.format('contype="2" conaffinity="2"')),
    "one half is there twice": ("scenery pieces", BLOCKS.format("") + BLOCKS.split("/>")[0] + "/>"),
}


@pytest.mark.parametrize(("term", "world"), SCENERY.values(), ids=SCENERY)
def test_the_world_is_scenery(term, world):
    """Its asymmetry is one of the task; the robot's own rows are those of a symmetric robot."""
    shin = capsule(-0.3, more='contype="3" conaffinity="3"')
    report = audit(robot(shin, shin, world=FLOOR + world), MIRROR)
    assert set(rows(report)) == {term}, str(report)
    assert {row.kind for row in report.residuals if row.term == term} == {"scenery"}


def test_a_robot_that_is_not_symmetric_is_not_excused_by_the_scenery():
    report = audit(robot(capsule(-0.3), capsule(-0.3) + FOOT, world=FLOOR + SCENERY["a wall"][1]), MIRROR)
    assert set(rows(report)) == {"collision geometry", "scenery geometry"}
    kinds = {row.term: row.kind for row in report.residuals}
    assert kinds["collision geometry"] == "collision" and kinds["friction"] == "collision"


def test_a_symmetric_world_is_exact_and_decoration_does_not_count():
    walls = '<geom type="box" pos="0 60 1" size="60 .1 1"/><geom type="box" pos="0 -60 1" size="60 .1 1"/>'
    flower = '<geom pos="1 2 0" size=".1" contype="0" conaffinity="0"/>'
    assert (
        audit(robot(capsule(-0.3), capsule(-0.3), world=FLOOR + walls + flower), MIRROR).verdict == "exact"
    )


# --- nothing is vacuous


BALL = '<body pos="1 0 1"><freejoint/><geom size=".1"/></body>'


def drone(world: str = "", option: str = "", bits: str = "") -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(f"""<mujoco><option cone="elliptic">{option}</option><worldbody>
      {world}<body name="drone" pos="0 0 1"><freejoint/>
      <inertial mass="1" pos="0 0 0" diaginertia=".01 .01 .02"/>
      <geom type="box" size=".1 .1 .02" {bits}/>
      <geom name="payload" type="box" size=".02 .02 .02" pos=".1 .07 .03" {bits}/></body>
      </worldbody></mujoco>""")


def test_without_a_floor_shapes_are_compared_and_it_is_said():
    report = audit(drone(), MIRROR)
    assert report.verdict.startswith("not a symmetry") and "payload" in report.verdict
    assert set(rows(report)) == {"collision geometry"}
    assert report.warnings == (
        "contacts of 2 geoms (geom 0 of 'drone', payload): nothing in this file can touch them, only their "
        "shapes were compared; audit the scene with the floor",
    )


def test_legs_that_touch_each_other_are_compared_anyhow():
    report = audit(robot(capsule(-0.3), capsule(-0.3), world=""), MIRROR)
    assert report.verdict == "exact"
    assert report.warnings[0].startswith("contacts of 1 geom (trunk): nothing in this file can touch them")


def test_with_a_floor_nothing_more_is_said():
    report = audit(drone(FLOOR), MIRROR)
    assert set(rows(report)) == {"collision geometry"} and not report.warnings


@pytest.mark.parametrize(
    "change",
    [
        {"bits": 'contype="0" conaffinity="0"'},  # only for the eye
        {"option": '<flag contact="disable"/>'},
        {"world": FLOOR + BALL, "bits": 'contype="2" conaffinity="2"'},  # kept from a floor that is there
    ],
)
def test_what_is_meant_to_touch_nothing_is_not_compared(change):
    report = audit(drone(**change), MIRROR)
    assert report.verdict == "exact" and not report.warnings


def test_parts_that_only_their_parents_could_touch_count_as_untouched():
    text = """<mujoco><worldbody><body name="a" pos="0 0 1"><freejoint/><geom size=".1"/>
      <body name="b" pos=".1 0 0"><joint axis="0 1 0"/><geom size=".1"/></body></body>
      </worldbody></mujoco>"""
    report = audit(mujoco.MjModel.from_xml_string(text), MIRROR)
    assert report.verdict == "exact" and "contacts of 2 geoms" in report.warnings[0]


def test_shapes_that_feel_a_fluid_belong_to_the_dynamics():
    def swimmer(size, coefficients=".5 .25 1.5 1 1"):
        fins = "".join(
            f'<geom type="ellipsoid" pos="0 {y} 0" size=".1 {s} .02" mass="1" fluidshape="ellipsoid" '
            f'fluidcoef="{c}" contype="0" conaffinity="0"/>'
            for y, s, c in ((0.3, 0.1, ".5 .25 1.5 1 1"), (-0.3, size, coefficients))
        )
        return mujoco.MjModel.from_xml_string(f"""<mujoco><option density="1000"/><worldbody>
          <body><freejoint/><inertial mass="1" pos="0 0 0" diaginertia="1 1 1"/>{fins}</body>
          </worldbody></mujoco>""")

    assert audit(swimmer(0.1), MIRROR).verdict == "exact"
    assert set(rows(audit(swimmer(0.11), MIRROR))) == {"fluid geometry", "fluid coefficients"}
    assert set(rows(audit(swimmer(0.1, ".6 .25 1.5 1 1"), MIRROR))) == {"fluid coefficients"}
    kinds = {row.kind for row in audit(swimmer(0.11), MIRROR).residuals if row.term.startswith("fluid")}
    assert kinds == {"dynamics"}


# --- time and memory


def terrain(count: int, mirrored: bool = True) -> mujoco.MjModel:
    rng = np.random.default_rng(0)
    boxes = ""
    for x, y, height in rng.uniform((-20, 0.5, 0.1), (20, 20, 0.5), (count // 2, 3)):
        other = y if mirrored else rng.uniform(0.5, 20)
        for place in (y, -other):
            boxes += f'<geom type="box" size=".3 .2 {height}" pos="{x} {place} 0"/>'
    return robot(capsule(-0.3), capsule(-0.3), world=boxes)


def seconds(model: mujoco.MjModel) -> float:
    start = time.process_time()
    audit(model, MIRROR)
    return time.process_time() - start


def test_thousands_of_boxes_take_a_moment():
    model = terrain(1000)
    assert audit(model, MIRROR).verdict == "exact"
    assert seconds(model) < 1
    uneven = terrain(1000, mirrored=False)
    assert set(rows(audit(uneven, MIRROR))) == {"scenery geometry"}
    assert seconds(uneven) < 1
    model = terrain(4000)
    assert seconds(model) < 2
    assert len(Filters(model).body) < 10 and len(active_geoms(model)) == model.ngeom


def test_one_box_of_a_terrain_that_is_there_twice_or_missing_is_named():
    model = terrain(400)
    spec = mujoco.MjSpec()
    boxes = [(model.geom_pos[g], model.geom_size[g]) for g in range(400)]
    for pos, size in [*boxes, boxes[7]]:
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, pos=pos, size=size)
    body = spec.worldbody.add_body(pos=[0, 0, 3])
    body.add_freejoint()
    body.add_geom(size=[0.1, 0, 0])
    report = audit(spec.compile(), MIRROR)
    assert rows(report) == {"scenery pieces": 0.01} and "geom 400 of 'world'" in str(report)
    spec.geoms[7].pos = [50, 50, 0]
    report = audit(spec.compile(), MIRROR)
    assert rows(report)["scenery geometry"] == 1
