"""symmetries: the group that a model was built with is the group that is found, in any plane."""

import mujoco
import pytest

from tests.robots import anymal, model, trifinger
from torchrl_sym import PointGroup
from torchrl_sym.mujoco import symmetries
from torchrl_sym.mujoco.symmetries.planes import candidate_planes

FLOOR = '<geom type="plane" size="5 5 .1"/>'


def star(arms: int, turned: float = 0.0, mirrored: bool = True, uneven: float = 0.0) -> mujoco.MjModel:
    """A free hub with arms all around it; without mirrors, each carries a weight to one side."""
    bodies = []
    for k in range(arms):
        weight = "" if mirrored else '<geom size=".05" pos=".2 .2 0" mass="1"/>'
        mass = 1.0 + uneven * (k == 0)
        bodies.append(
            f'<body name="arm_{k}" euler="0 0 {turned + 360 * k / arms}"><joint name="arm_{k}" axis="0 1 0"'
            f' pos=".1 0 0"/><geom type="capsule" fromto=".1 0 0 .3 0 0" size=".02" mass="{mass}"/>'
            f"{weight}</body>"
        )
    hub = '<freejoint/><inertial pos="0 0 0" mass="2" diaginertia=".1 .1 .1"/>'
    hub = f'<body name="hub" pos="0 0 1">{hub}{"".join(bodies)}</body>'
    return mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{FLOOR}{hub}</worldbody></mujoco>")


@pytest.mark.parametrize("arms", [2, 3, 4, 5, 6, 8, 12])
def test_turns_and_mirrors_of_a_star_are_found(arms):
    found = symmetries(star(arms))
    assert found.group == PointGroup.dihedral(arms)
    assert found.exact_group == found.group
    assert found.verdict.endswith(": exact")


@pytest.mark.parametrize("arms", [3, 5])
def test_turns_without_mirrors_are_found(arms):
    assert symmetries(star(arms, mirrored=False)).group == PointGroup.rotation(arms)


@pytest.mark.parametrize(("arms", "degrees"), [(3, 10.0), (4, 25.0), (5, 7.3)])
def test_mirror_planes_may_stand_anywhere(arms, degrees):
    found = symmetries(star(arms, turned=degrees)).group
    assert found.order == 2 * arms
    expected = PointGroup.dihedral(arms).turned(degrees)
    names = [float(name.removeprefix("reflect-")) for name in found.names if name.startswith("reflect-")]
    planes = [float(n.removeprefix("reflect-")) for n in expected.names if n.startswith("reflect-")]
    assert sorted(names) == pytest.approx(sorted(planes), abs=1e-4)


def test_an_uneven_arm_leaves_one_mirror():
    found = symmetries(star(5, uneven=0.9))
    assert found.exact_group == PointGroup.reflection("y")


def test_robots_of_the_literature():
    assert symmetries(model(anymal())).group == PointGroup.klein_four()
    assert symmetries(model(*trifinger())).group == PointGroup.rotation(3)


def test_elements_that_move_nothing_are_of_no_use():
    slider = mujoco.MjModel.from_xml_string(
        f"""<mujoco><worldbody>{FLOOR}<body pos="0 0 1"><joint name="cart" type="slide" axis="1 0 0"/>
        <geom type="box" size=".1 .1 .1"/></body></worldbody></mujoco>"""
    )
    found = symmetries(slider)
    assert found.group == PointGroup.reflection("x")
    idle = {c.name for c in found.candidates if c.found and not c.moves}
    assert idle == {"reflect-y"}
    assert "(moves nothing)" in str(found)


def test_what_has_no_symmetry_says_why_and_what_cannot_move_is_no_symmetry():
    lopsided = mujoco.MjModel.from_xml_string(
        f"""<mujoco><worldbody>{FLOOR}
        <body name="base" pos="0 0 1"><freejoint/><geom type="box" size=".2 .1 .05"/>
        <body pos=".1 .15 0"><joint axis="0 1 0"/><geom size=".1" pos=".1 .05 .2"/></body></body>
        </worldbody></mujoco>"""
    )
    found = symmetries(lopsided)
    assert found.group.order == 1
    assert found.verdict == "no symmetry"
    assert "not a symmetry (" in str(found)
    stone = '<mujoco><worldbody><body><geom type="box" size=".1 .2 .3"/></body></worldbody></mujoco>'
    assert "nothing to compare" in str(symmetries(mujoco.MjModel.from_xml_string(stone)))


def test_planes_are_proposed_by_pairs_and_by_links_in_them():
    robot = star(3, turned=10.0)
    data = mujoco.MjData(robot)
    mujoco.mj_kinematics(robot, data)
    planes = candidate_planes(robot, data)
    assert planes[:2] == [0.0, 90.0]
    for expected in (40.0, 100.0, 160.0):
        assert min(abs(plane - expected) for plane in planes) < 1e-6


@pytest.mark.parametrize(
    ("argument", "value"), [("keyframe", "none"), ("carried", ["none"]), ("axis", (0.0,))]
)
def test_mistakes_are_errors(argument, value):
    with pytest.raises((KeyError, ValueError), match=r"no|axis"):
        symmetries(star(3), **{argument: value})
