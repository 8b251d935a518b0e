"""symmetrize: a perturbed robot becomes exact, a symmetric one stays, the report says what moved."""

from types import SimpleNamespace
from unittest.mock import patch

import mujoco
import numpy as np
import pytest

from tests import robots
from tests.test_mujoco_derive import step_residual
from torchrl_sym import PointGroup
from torchrl_sym.mujoco import SymmetryError, audit, derive, symmetrize, symmetrize_with_report

K4 = PointGroup.klein_four()
C3 = PointGroup.rotation(3)
GROUPS = {"ANYmal": K4, "TriFinger": C3}
CASES = [(name, frames) for name in GROUPS for frames in (None, 0)]


def specification(name: str, frames: int | None = None) -> mujoco.MjSpec:
    """The robot as it is written, before it is compiled."""
    limbs = (robots.anymal(),) if name == "ANYmal" else robots.trifinger()
    stand_in = SimpleNamespace(
        mju_quat2Mat=mujoco.mju_quat2Mat,
        mju_mat2Quat=mujoco.mju_mat2Quat,
        MjModel=SimpleNamespace(from_xml_string=mujoco.MjSpec.from_string),
    )
    with patch.object(robots, "mujoco", stand_in):
        rng = None if frames is None else np.random.default_rng(frames)
        return robots.model(*limbs, frames=rng)


def perturb(spec: mujoco.MjSpec, seed: int) -> mujoco.MjSpec:
    """About one per cent off, in everything that is averaged."""
    rng = np.random.default_rng(seed)

    def off(values, size=0.01):
        return (np.asarray(values) * (1 + size * rng.standard_normal(np.shape(values)))).tolist()

    for body in spec.bodies[1:]:
        body.mass, body.pos = off(body.mass), off(body.pos, 0.005)
        body.ipos = (np.array(body.ipos) + 1e-3 * rng.standard_normal(3)).tolist()
        turn, turned = np.array([1.0, *(0.005 * rng.standard_normal(3))]), np.zeros(4)
        mujoco.mju_mulQuat(turned, turn / np.linalg.norm(turn), body.iquat)
        body.iquat = turned.tolist()
        body.inertia = (np.array(body.inertia) * (1 + 0.01 * rng.standard_normal())).tolist()
        body.add_site(name=f"{body.name}_imu", pos=1e-3 * rng.standard_normal(3))
    for joint in spec.joints:
        if joint.type == mujoco.mjtJoint.mjJNT_FREE:
            continue
        axis = np.array(joint.axis) + 0.01 * rng.standard_normal(3)
        joint.axis, joint.range = (axis / np.linalg.norm(axis)).tolist(), off(joint.range)
        joint.damping, joint.stiffness = off([0.3, 0, 0]), off([2.0, 0, 0])
        joint.armature, joint.frictionloss = off(0.01), off(0.05)
        joint.springref = 0.5 * rng.standard_normal()
    for actuator in spec.actuators:
        actuator.gainprm, actuator.biasprm = off(actuator.gainprm), off(actuator.biasprm)
        actuator.ctrlrange, actuator.forcerange = off([-0.4, 0.4]), off([-30, 30])
    for geom in spec.geoms:
        if geom.type == mujoco.mjtGeom.mjGEOM_SPHERE:
            geom.pos, geom.size, geom.friction = off(geom.pos), off(geom.size), off(geom.friction)
    return spec


def worst_step(compiled, group, seeds=range(6)) -> float:
    robot = derive(compiled, group)
    return max(step_residual(compiled, robot, g, seed)[0] for g in range(group.order) for seed in seeds)


@pytest.mark.parametrize(("name", "frames"), CASES)
@pytest.mark.parametrize("seed", range(2))
def test_perturbed_robot_becomes_exact(name, frames, seed):
    spec = perturb(specification(name, frames), seed)
    assert worst_step(spec.compile(), GROUPS[name]) > 1e-3
    compiled = symmetrize(spec, GROUPS[name], tolerance=3e-2).compile()
    assert audit(compiled, GROUPS[name]).exact, str(audit(compiled, GROUPS[name]))
    assert worst_step(compiled, GROUPS[name]) <= 1e-9


@pytest.mark.parametrize(("name", "frames"), CASES)
def test_symmetric_robot_stays_as_it_is(name, frames):
    spec = specification(name, frames)
    after, report = symmetrize_with_report(spec, GROUPS[name])
    assert report.changes == [], str(report)
    assert str(report).startswith("nothing changed")
    assert largest_difference(spec.compile(), after.compile()) <= 1e-12


def test_averaging_twice_changes_nothing_more():
    once = symmetrize(perturb(specification("ANYmal", 1), 3), K4)
    twice = symmetrize(once, K4)
    assert largest_difference(once.compile(), twice.compile()) <= 1e-12


def largest_difference(a, b) -> float:
    kinds = ("body_", "jnt_", "dof_", "geom_", "site_", "actuator_", "qpos")
    skip = ("body_iquat", "body_inertia")  # principal axes are not unique; inertias come with dof_M0
    names = [n for n in dir(a) if n.startswith(kinds) and n not in skip]
    pairs = [(np.asarray(getattr(a, n), float), np.asarray(getattr(b, n), float)) for n in names]
    return max(float(np.abs(x - y).max(initial=0.0)) for x, y in pairs)


def test_input_is_not_modified():
    spec = perturb(specification("ANYmal"), 0)
    before = spec.to_xml()
    symmetrize(spec, K4)
    assert spec.to_xml() == before


def test_report_names_the_largest_change():
    spec = specification("ANYmal", 0)
    spec.body("LF_HFE").mass *= 1.2
    report = symmetrize_with_report(spec, K4)[1]
    assert {change.term for change in report.changes} == {"mass"}
    largest = report.largest
    assert largest is not None
    assert (largest.term, largest.name) == ("mass", "LF_HFE")
    assert largest.amount == pytest.approx(0.15 * 3.071)  # 1.2 m becomes the mean, 1.05 m
    row = str(report).splitlines()[1].split()
    assert (row[0], row[1], row[-1]) == ("mass", "4", "LF_HFE")


ARMS = """<mujoco><option gravity="0 0 0" cone="elliptic"/>
  <worldbody><frame pos="0 .01 0" euler="0 0 3">
  <body name="left" pos="0 .1 0"><joint name="a" axis="0 0 1" ref="20" range="-30 71" springref="30"
      stiffness="2" pos="0 .02 0"/><joint name="c" type="slide" axis="1 .02 0"/>
    <geom name="rod" type="capsule" fromto="0 .1 0 .3 .1 .02" size=".05"/>
    <body name="tip" pos=".3 .1 0"><geom name="box" type="box" size=".05 .06 .07" euler="0 2 90"/>
      <site name="s" pos=".01 0 0"/></body></body></frame>
  <body name="right" pos="0 -.1 0"><joint name="b" axis="0 0 -1" ref="50" range="0 100" springref="58"
      stiffness="2.1" pos="0 -.02 0"/><joint name="d" type="slide" axis="1 0 0"/>
    <geom name="stick" type="capsule" fromto=".3 -.1 0 0 -.1 0" size=".051"/>
    <body pos=".3 -.1 0"><geom name="block" type="box" size=".061 .05 .07"/><site name="t"/></body></body>
  <geom name="lidar" type="cylinder" size=".02 .02" pos="0 .5 2"/>
  </worldbody><actuator><position name="a" joint="a" kp="5" ctrlrange="-1 1" gear="1.1"/>
  <position name="b" joint="b" kp="5.2" ctrlrange="-.6 1.4" gear="1"/></actuator>
  <keyframe><key name="bent" qpos=".2 .1 .72 .1"/></keyframe></mujoco>"""
# with the signs of a and b equal, a = 0.2 and b = 0.72 are the same pose: their zeros differ by 30 degrees


@pytest.mark.parametrize("keyframe", [None, "bent"])
def test_offsets_frames_welded_bodies_capsules_and_boxes(keyframe):
    spec = mujoco.MjSpec.from_string(ARMS)
    group = PointGroup.reflection("y")
    after, report = symmetrize_with_report(spec, group, keyframe, tolerance=0.1)
    compiled = after.compile()
    robot = derive(compiled, group, keyframe)
    assert robot.table("joint", 1)["a"] == "b"
    assert max(step_residual(compiled, robot, 1, seed, steps=5)[0] for seed in range(6)) <= 1e-9
    found = audit(compiled, group, keyframe)
    assert "scenery: not a symmetry (1: scenery geometry, reflect-y, lidar" in found.verdict
    assert "left alone: geom 'lidar' has no image" in str(report)
    assert compiled.body_mass.sum() == pytest.approx(spec.compile().body_mass.sum())
    after.delete(after.geom("lidar"))
    assert audit(after.compile(), group, keyframe).exact
    again = symmetrize_with_report(after, group, keyframe, tolerance=0.1)[1]
    assert again.changes == [], str(again)


def test_model_without_the_symmetry_is_refused():
    with pytest.raises(SymmetryError, match="has no image under 'rot-120'"):
        symmetrize(specification("ANYmal"), C3)


def test_shapes_given_by_their_ends_keep_their_place():
    body = """<body pos="0 {y} 0"><joint axis="1 0 0"/>
      <geom type="capsule" fromto="0 0 .1 .3 {y} .2" size=".05" mass="{m}"/></body>"""
    arms = body.format(y=0.1, m=1.0) + body.format(y=-0.1, m=1.1)
    spec = mujoco.MjSpec.from_string(f"<mujoco><worldbody>{arms}</worldbody></mujoco>")
    after = symmetrize(spec, PointGroup.reflection("y")).compile()
    assert np.allclose(after.geom_pos, spec.compile().geom_pos, atol=1e-12)
    assert np.allclose(after.geom_size, spec.compile().geom_size, atol=1e-12)
    assert after.body_mass[1:] == pytest.approx([1.05, 1.05])


def test_free_body_away_from_the_centre_stays_there():
    spec = mujoco.MjSpec.from_string("""<mujoco><worldbody><geom type="plane" size="5 5 1"/>
      <body name="cube" pos="1 2 .1"><freejoint/><geom type="box" size=".1 .1 .1" pos="0 .002 0"/></body>
      </worldbody></mujoco>""")
    after, report = symmetrize_with_report(spec, K4, tolerance=3e-2)
    compiled = after.compile()
    assert compiled.qpos0[:3] == pytest.approx([1, 2, 0.1])
    assert {change.term for change in report.changes} == {"centre of mass", "geom position"}
    assert np.abs(compiled.body_ipos[1]).max() < 1e-12
    assert np.abs(compiled.geom_pos[1]).max() < 1e-12
    assert worst_step(compiled, K4) <= 1e-9
