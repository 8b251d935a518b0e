"""The command line of torchrl_sym.mujoco, and the table of public models."""

import subprocess
import sys
from pathlib import Path

import mujoco
import pytest

from torchrl_sym import PointGroup
from torchrl_sym.mujoco import audit
from torchrl_sym.mujoco.__main__ import Arguments, main, named_group

ROOT = Path(__file__).parents[1]
PAIR = """<mujoco><worldbody>
  <body name="left" pos="0 .1 0"><joint name="left" axis="1 0 0"/><geom size=".1" mass="1"/></body>
  <body name="right" pos="0 -.1 0"><joint name="right" axis="1 0 0"/><geom size=".1" mass="{mass}"/></body>
</worldbody></mujoco>"""


@pytest.fixture
def pair(tmp_path):
    def write(mass=1.0):
        path = tmp_path / "pair.xml"
        path.write_text(PAIR.format(mass=mass))
        return path

    return write


def test_tables_and_audit_are_printed(pair):
    command = [sys.executable, "-m", "torchrl_sym.mujoco", str(pair()), "--group", "reflect-y"]
    result = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=120)
    assert result.returncode == 0, result.stderr
    lines = result.stdout.splitlines()
    assert ["left", "-right"] in [line.split() for line in lines]
    assert "exact" in lines


def test_differences_are_named_and_missing_symmetries_fail(pair, capsys):
    assert main(Arguments(pair(1.02))) == 0
    assert "approximate (largest residual" in capsys.readouterr().out
    assert main(Arguments(pair(), group="rotation-3")) == 1
    assert "not a symmetry (" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("name", "order"), [("klein_four", 4), ("rotation-5", 5), ("dihedral-3", 6), ("reflect-x", 2)]
)
def test_groups_by_name(name, order):
    assert named_group(name).order == order


@pytest.mark.parametrize("name", ["rotation", "rotation-x", "icosahedron"])
def test_unknown_groups_list_the_known_ones(name):
    with pytest.raises(ValueError, match=r"expected one of \['reflect-x'.*got"):
        named_group(name)


def test_symmetrised_model_is_written_and_exact(pair, tmp_path, capsys):
    out = tmp_path / "symmetric.xml"
    assert main(Arguments(pair(1.02), out=out)) == 0
    assert "written to" in capsys.readouterr().out
    assert audit(mujoco.MjModel.from_xml_path(str(out)), PointGroup.reflection("y")).exact
