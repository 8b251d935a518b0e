"""The command line of torchrl_sym.mujoco: what it finds, writes and refuses."""

import subprocess
import sys
from pathlib import Path

import mujoco
import pytest

from torchrl_sym import PointGroup
from torchrl_sym.mujoco import audit
from torchrl_sym.mujoco.__main__ import Arguments, main, named_group
from torchrl_sym.mujoco.model.files import load_spec

ROOT = Path(__file__).parents[1]
PAIR = """<mujoco><worldbody>
  <body name="left" pos="0 .1 0"><joint name="left" axis="1 0 0"/><geom size=".1" mass="1"/></body>
  <body name="right" pos="0 -.1 0"><joint name="right" axis="1 0 0"/><geom size=".1" mass="{mass}"/></body>
</worldbody></mujoco>"""
URDF = """<robot name="walker">
  <link name="trunk">{inertia}<collision><geometry><box size=".4 .2 .1"/></geometry></collision></link>
  <link name="left">{inertia}</link><link name="right">{inertia}</link>
  <joint name="left_hip" type="revolute"><parent link="trunk"/><child link="left"/><origin xyz="0 .2 0"/>
    <axis xyz="1 0 0"/><limit lower="-1" upper=".5" effort="9" velocity="9"/></joint>
  <joint name="right_hip" type="revolute"><parent link="trunk"/><child link="right"/><origin xyz="0 -.2 0"/>
    <axis xyz="1 0 0"/><limit lower="-.5" upper="1" effort="9" velocity="9"/></joint>
</robot>"""
INERTIA = (
    '<inertial><mass value="2"/><inertia ixx=".1" iyy=".1" izz=".1" ixy="0" ixz="0" iyz="0"/></inertial>'
)


@pytest.fixture
def pair(tmp_path):
    def write(mass=1.0):
        path = tmp_path / "pair.xml"
        path.write_text(PAIR.format(mass=mass))
        return path

    return write


@pytest.fixture
def urdf(tmp_path):
    path = tmp_path / "walker.urdf"
    path.write_text(URDF.format(inertia=INERTIA))
    return path


def test_without_a_group_all_are_tried(pair):
    command = [sys.executable, "-m", "torchrl_sym.mujoco", str(pair())]
    result = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=120)
    assert result.returncode == 0, result.stderr
    lines = result.stdout.splitlines()
    assert lines[0] == "reflect-y: exact"
    assert ["left", "-right"] in [line.split() for line in lines]
    assert "exact" in lines


@pytest.mark.parametrize("free_base", [False, True])
@pytest.mark.parametrize("name", ["notes.txt", "robot.urdf", "robot.xml"])
def test_files_that_are_no_models_are_refused(tmp_path, name, free_base, capsys):
    path = tmp_path / name
    path.write_text("no <robot")
    assert main(Arguments(path, free_base=free_base)) == 2
    assert "expected an MJCF or URDF file" in capsys.readouterr().err


def test_options_without_effect_are_refused(pair, tmp_path, capsys):
    assert main(Arguments(pair(), plane=20.0)) == 2
    assert "beside --plane" in capsys.readouterr().err
    assert main(Arguments(pair(), out=tmp_path / "nowhere" / "robot.xml")) == 2
    assert "make it first" in capsys.readouterr().err


def test_differences_are_named_and_missing_symmetries_fail(pair, capsys):
    assert main(Arguments(pair(1.02), group="reflect-y")) == 0
    assert "approximate (largest residual" in capsys.readouterr().out
    assert main(Arguments(pair(), group="rotation-3")) == 1
    assert "not a symmetry (" in capsys.readouterr().out
    assert main(Arguments(pair(9.0), out=Path("nowhere.xml"), group="reflect-y")) == 1
    assert "nowhere.xml was not written" in capsys.readouterr().out


@pytest.mark.parametrize(
    "change",
    [
        {"group": "icosahedron"},
        {"group": "rotation-0"},
        {"keyframe": "home"},
        {"carried": ("cube",)},
        {"tolerance": -1.0},
        {"model": Path("missing.xml")},
        {"free_base": True},
        {"out": Path("no/such/folder/out.xml"), "group": "reflect-y"},
    ],
    ids=lambda change: next(iter(change)),
)
def test_a_mistake_is_one_line_and_status_2(pair, capsys, change):
    arguments = Arguments(**{"model": pair(), **change})
    assert main(arguments) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("error: ")


def test_a_broken_file_is_one_line(tmp_path, capsys):
    path = tmp_path / "broken.xml"
    path.write_text("<mujoco><worldbody><geom/></worldbody></mujoco>")
    assert main(Arguments(path)) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


@pytest.mark.parametrize(
    ("name", "order"),
    [("klein_four", 4), ("rotation-5", 5), ("dihedral-3", 6), ("reflect-x", 2), ("reflect-30", 2)],
)
def test_groups_by_name(name, order):
    assert named_group(name).order == order


@pytest.mark.parametrize("name", ["rotation", "rotation-x", "icosahedron", "reflect-z", "reflect-"])
def test_unknown_groups_list_the_known_ones(name):
    with pytest.raises(ValueError, match=r"expected one of \['reflect-x'.*got"):
        named_group(name)


def test_planes_are_turned(tmp_path, capsys):
    path = tmp_path / "turned.xml"
    path.write_text(PAIR.format(mass=1).replace("<worldbody>", '<worldbody><frame euler="0 0 30">')
                    .replace("</worldbody>", "</frame></worldbody>"))  # fmt: skip
    assert main(Arguments(path, group="reflect-y")) == 1
    assert main(Arguments(path, group="reflect-y", plane=30.0)) == 0
    assert main(Arguments(path)) == 0
    assert "reflect-120: exact" in capsys.readouterr().out


def test_a_urdf_is_nailed_to_the_world_unless_its_base_is_set_free(urdf, capsys):
    assert load_spec(urdf).compile().nq == 2
    model = load_spec(urdf, free_base=True).compile()
    assert model.nq == 2 + 7
    assert model.body("trunk").mass == 2.0
    assert main(Arguments(urdf, free_base=True)) == 0
    assert "left_hip" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("body", "message"),
    [
        ('<body name="a"><freejoint/><geom size=".1"/></body>', "'a' moves already"),
        (
            '<body name="a"><geom size=".1"/></body><body name="b"><geom size=".1"/></body>',
            r"got \['a', 'b'\]",
        ),
    ],
)
def test_which_base_to_set_free_must_be_clear(tmp_path, body, message):
    path = tmp_path / "model.xml"
    path.write_text(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    with pytest.raises(ValueError, match=message):
        load_spec(path, free_base=True)


def test_symmetrised_model_is_written_and_exact(pair, tmp_path, capsys):
    out = tmp_path / "symmetric.xml"
    assert main(Arguments(pair(1.02), out=out)) == 0
    assert "written to" in capsys.readouterr().out
    assert audit(mujoco.MjModel.from_xml_path(str(out)), PointGroup.reflection("y")).exact
