"""benchmarks/audits.py over a folder of models, and what a pose that is solved for costs."""

import mujoco
import pytest

import audits
from torchrl_sym import PointGroup
from torchrl_sym.mujoco import derive
from torchrl_sym.mujoco.derive import SymmetryError, solving

LEG = """<body name="{0}" pos="0 {1} 0"><joint name="{0}_hip" axis="0 1 0" ref="{2}"/>
  <geom type="capsule" size=".02" fromto="0 0 0 .1 0 -.3"/>
  <body name="{0}_shin" pos=".1 0 -.3"><joint name="{0}_knee" axis="0 1 0"/>
    <geom type="capsule" size=".02" fromto="0 0 0 -.1 0 -.3"/></body></body>"""


def walker(turned: float) -> str:
    """Two legs, the right hip of which is zeroed at another angle (degrees)."""
    legs = LEG.format("left", 0.1, 0)
    right = LEG.format("right", -0.1, 0).replace('pos="0 -0.1 0"', f'pos="0 -0.1 0" euler="0 {turned} 0"')
    return (
        "<mujoco><worldbody><body><freejoint/>"
        f'<geom type="box" size=".1 .1 .05"/>{legs}{right}</body></worldbody></mujoco>'
    )


def test_times_of_a_folder_are_summed_up(tmp_path, capsys):
    (tmp_path / "robot.xml").write_text(walker(0))
    (tmp_path / "piece.xml").write_text("<mujoco><default/></mujoco>")
    (tmp_path / "broken.xml").write_text("<mujoco><worldbody><geom/></worldbody></mujoco>")
    model = mujoco.MjModel.from_xml_string(walker(0))
    mujoco.mj_saveModel(model, str(tmp_path / "compiled.mjb"))

    assert audits.main(audits.Arguments(also=(tmp_path,), rounds=1)) == 0
    assert capsys.readouterr().out.startswith("2 models: median ")
    assert audits.main(audits.Arguments(also=(tmp_path,), only=("*.mjb",), rounds=1)) == 0
    assert capsys.readouterr().out.startswith("1 models: median ")


def test_a_folder_without_models_and_none_are_said(tmp_path, capsys):
    assert audits.main(audits.Arguments(also=(tmp_path,))) == 1
    assert "no models" in capsys.readouterr().out
    with pytest.raises(NotADirectoryError, match="menagerie: expected a folder of models"):
        audits.main(audits.Arguments(menagerie=tmp_path / "nowhere"))


def test_the_summary_names_what_takes_longer():
    text = audits.summary({"fast": 0.01, "slow": 0.5, "slower": 2.0, "also fast": 0.03})
    assert text.splitlines() == [
        "4 models: median 0.265 s, 50.0% below 0.1 s, 95th percentile 1.775 s (CPU time)",
        "   2.000 s  slower",
        "   0.500 s  slow",
    ]


def test_a_pose_is_computed_again_only_where_a_joint_was_moved(monkeypatch):
    calls, kinematics = [], solving.kinematics

    def counted(model, pose, data=None):
        calls.append(pose)
        return kinematics(model, pose, data)

    monkeypatch.setattr(solving, "kinematics", counted)
    model = mujoco.MjModel.from_xml_string(walker(40))
    robot = derive(model, PointGroup.reflection("y"))
    assert "moved to where they are symmetric" in robot.pose
    assert robot.offsets("reflect-y")["right_hip"] == pytest.approx(0.698, abs=1e-3)
    assert len(calls) == 2  # as it was, and with one hip moved


def test_siblings_that_are_not_compared_may_still_be_left_for_each_other():
    """Of many siblings only near ones are compared; where one side has more, what is left is far away."""
    places = [(x / 10, y) for y, count in ((1, 12), (-1, 10)) for x in range(count)] + [(5, 0), (6, 0)]
    bodies = "".join(
        f'<body pos="{x} {y} 0"><joint axis="0 1 0"/><geom size=".02"/>'
        '<body pos="0 0 -.1"><joint axis="0 1 0"/><geom size=".02"/></body></body>'
        for x, y in places
    )
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    with pytest.raises(SymmetryError, match="has no image under 'reflect-y'"):
        derive(model, PointGroup.reflection("y"), axis=(0.0, 0.0))
