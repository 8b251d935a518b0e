"""benchmarks/models.py: models of our own of every kind in the catalogue, and the catalogue's own parts.

The whole run needs mujoco_menagerie; here every kind of robot, and of finding, has a small stand-in that
goes the same way: expectation, examination, page.
"""

from pathlib import Path

import pytest

import models
from catalogue import expectations, run, sources
from catalogue.examine import Row, examine
from catalogue.page import bugs, page, still_there
from tests.catalogue_models import MODELS, expect, mjcf
from tests.launch import serve


@pytest.fixture(scope="module", autouse=True)
def server():
    """Of processes, which imports less than the catalogue's own, and runs already."""
    serve()


@pytest.mark.parametrize("name", MODELS)
def test_a_model_of_every_kind_meets_its_expectation(tmp_path, name):
    text, expected = MODELS[name]
    path = tmp_path / "robot.xml"
    path.write_text(text)
    found = examine("ours/robot.xml", path, expected)
    assert found is not None and found["error"] == ""
    assert found["against"] == []


def test_a_wrong_expectation_is_said(tmp_path):
    path = tmp_path / "robot.xml"
    path.write_text(MODELS["humanoid"][0])
    crossed = [("left_hip_roll", "right_hip_pitch"), ("left", "right")]
    found = examine("ours/robot.xml", path, expect(crossed, reflect_y="approximate", reflect_x="exact"))
    assert found is not None
    said = "\n".join(found["against"])
    assert "reflect-y: expected approximate, got exact" in said
    assert "reflect-x: expected exact, got no" in said
    assert "left_hip_roll goes to right_hip_roll, expected right_hip_pitch" in said


@pytest.mark.parametrize(
    ("sides", "name", "image"),
    [
        ([("left", "right")], "arm_left_1", "arm_right_1"),
        ([("left", "right")], "right/left_finger", "left/left_finger"),
        ([("left/left", "right/right"), ("left", "right")], "left/left_finger", "right/right_finger"),
        ([("l", "r")], "l_elbow", "r_elbow"),
        ([("l", "r")], "ball_1", "ball_1"),
        ([("^l", "^r")], "lfemur", "rfemur"),
        ([("Left", "Right")], "hipPitchLeft", "hipPitchRight"),
        ([("L", "R")], "shoulder_L_extend", "shoulder_R_extend"),
        ([("FL", "FR"), ("RL", "RR")], "RR_calf", "RL_calf"),
    ],
)
def test_left_and_right_are_paired_by_words_of_names(sides, name, image):
    assert expect(sides).image(name) == image
    assert expect(sides).image(image) == name


def test_names_without_a_side_stay_and_a_name_of_one_side_alone_may_go_anywhere():
    entry = expect([("left", "right")], reflect_y="exact")
    assert entry.complaints({"reflect-y": "exact"}, [{"left_camera": "eye_2", "neck": "neck"}]) == []
    assert entry.complaints({"reflect-y": "exact"}, [{"neck": "head", "head": "neck"}]) == [
        "reflect-y: neck goes to head, expected neck",
        "reflect-y: head goes to neck, expected head",
    ]


def test_an_actuator_that_is_called_as_a_joint_is_looked_for_among_actuators():
    entry = expect([("left", "right")], reflect_y="exact")
    joints, actuators = {"left": "right", "right": "left"}, {"right": "right"}
    assert entry.complaints({"reflect-y": "exact"}, [joints, actuators]) == []


def test_an_element_that_nobody_asks_for_is_judged_if_it_is_expected():
    found = {"reflect-y": "no", "reflect-30": "approximate"}
    assert expect().complaints(found, []) == []
    assert expect(**{"reflect-30": "exact"}).complaints(found, []) == [
        "reflect-30: expected exact, got approximate"
    ]


def test_an_element_that_was_expected_and_not_tried_is_said():
    assert expect(rot_90="exact").complaints({"reflect-y": "no"}, []) == [
        "rot-90: expected exact, not found"
    ]


def test_expectations_are_read_and_refused_with_a_reason(tmp_path):
    known = expectations.read()
    spot = expectations.expectation("menagerie/boston_dynamics_spot/spot.xml", known)
    assert spot is not None and spot.image("fl_hx") == "fr_hx"
    assert expectations.expectation("menagerie/nobody/robot.xml", known) is None
    wrong = tmp_path / "wrong.toml"
    wrong.write_text('[[model]]\nfiles = ["a/*"]\nkind = "Drones"\nhas = { reflect-y = "perhaps" }\n')
    with pytest.raises(ValueError, match=r"a/\*: expected verdicts of .* got \['perhaps'\]"):
        expectations.read(wrong)


def test_files_that_are_pieces_are_told_from_models_and_from_faults(tmp_path):
    (tmp_path / "robot.xml").write_text(MODELS["two arms"][0])
    (tmp_path / "arena.xml").write_text(mjcf(""))
    (tmp_path / "keys.xml").write_text(
        '<mujoco><keyframe><key name="home" qpos="1 2"/></keyframe></mujoco>'
    )
    (tmp_path / "broken.xml").write_text('<mujoco><worldbody><geom type="box"/></worldbody></mujoco>')
    (tmp_path / "urdf.xml").write_text("<robot/>")
    files = dict(sources.Source("ours", tmp_path).files())
    assert list(files) == [f"ours/{name}.xml" for name in ("arena", "broken", "keys", "robot")]
    loaded = {key: sources.load(path) for key, path in files.items()}
    assert [key for key, one in loaded.items() if one.is_piece] == ["ours/arena.xml", "ours/keys.xml"]
    assert "size" in loaded["ours/broken.xml"].error


def test_a_mesh_that_is_not_at_hand_is_replaced_and_named(tmp_path):
    path = tmp_path / "robot.xml"
    path.write_text(
        mjcf(
            '<body><freejoint/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>'
            '<geom type="mesh" mesh="trunk" contype="0" conaffinity="0"/></body>',
            '<asset><mesh name="trunk" file="trunk.obj" scale=".001 .001 .001"/></asset>',
        )
    )
    loaded = sources.load(path)
    assert loaded.model is not None and loaded.stand_ins == ("trunk",)
    (tmp_path / "trunk.obj").write_text("no mesh")
    assert sources.load(path).model is None


def test_a_folder_that_is_none_is_refused(tmp_path):
    with pytest.raises(NotADirectoryError, match="menagerie: expected a folder of models"):
        sources.sources(tmp_path / "nowhere", ())


def test_what_hangs_dies_or_fails_stops_nothing(tmp_path, monkeypatch):
    texts = {
        "robot": MODELS["three fingers"][0],
        "broken": "<mujoco><worldbody><geom/></worldbody></mujoco>",
    }
    for name, text in {**texts, "arena": mjcf("")}.items():
        (tmp_path / f"{name}.xml").write_text(text)
    jobs = [(f"ours/{name}", tmp_path / f"{name}.xml", None) for name in ("robot", "broken", "arena")]
    kept = tmp_path / "rows.jsonl"
    rows = run.examine_all(jobs, workers=2, limit=60, kept=kept)
    assert [row.key for row in rows] == ["ours/robot", "ours/broken"]
    assert rows[0].verdicts["rot-120"] == "exact" and rows[0].error == ""
    assert rows[1].error.startswith("does not compile: ")
    assert [row.error for row in run.examine_all(jobs[:1], 1, 0, tmp_path / "none")] == [
        "took more than 0 s"
    ]

    whole = kept.read_text()
    kept.write_text(whole + '["ours/cut", {"key')  # killed while it wrote
    assert run.examine_all(jobs, 2, 60, kept) == rows, "what is known is not examined again"
    assert kept.read_text().startswith(whole) and len(kept.read_text().splitlines()) == 4


def test_a_process_that_dies_and_an_error_of_the_library_are_rows(monkeypatch):
    def examine(*_):
        raise RuntimeError("boom")

    monkeypatch.setattr(run, "examine", examine)
    for works, error in ((False, "the process died"), (True, "the library failed: RuntimeError: boom")):
        mine, theirs = run.multiprocessing.Pipe(duplex=False)
        if works:
            run._work(theirs, "ours/robot", Path("robot.xml"), None)
        theirs.close()
        assert run._receive(mine, "ours/robot") == Row("ours/robot", error)


def test_the_page_says_what_was_found_and_what_disagrees(tmp_path):
    rows = [
        Row("menagerie/unitree_go1/go1.xml", verdicts={"reflect-y": "approximate"}, pose="qpos0"),
        Row("menagerie/unitree_go1/scene.xml", verdicts={"reflect-y": "approximate"}, pose="qpos0"),
        Row("menagerie/leap_hand/left_hand.xml", verdicts={"reflect-y": "no"}, stand_ins=("palm",)),
        Row(
            "menagerie/nobody/a|b.xml",
            error="took more than 60 s",
            against=["reflect-y: expected exact, got no"],
        ),
    ]
    for row in rows[:2]:
        row.worst, row.axis = {"reflect-y": "0.0064, inertia of trunk"}, (0.0, 0.5)
    rows[2].words = {"reflect-y": "not a symmetry (thumb has no image)"}
    text = page(rows, expectations.read(), [], "MuJoCo 0\n")
    worst = "0.0064, inertia of trunk"
    assert f"| menagerie/unitree_go1: go1, scene |  | reflect-y | {worst} | qpos0 about (0, 0.5) |" in text
    assert "| menagerie/leap_hand: left_hand* |  |  | thumb has no image |  |" in text
    assert "small ones stand in for them" in text and "took more than 60 s" in text
    assert "- menagerie/nobody/a|b.xml: reflect-y: expected exact, got no" in text
    assert [line for line in text.splitlines() if line.startswith("## ")][:3] == [
        "## Quadrupeds",
        "## Arms and hands",
        "## Others",
    ]


def test_a_mistake_that_was_mended_is_said(tmp_path):
    path = tmp_path / "robot.xml"
    path.write_text('<a>\n  <joint name="right"   range="0 1"/>\n</a>')
    assert still_there(path, [[9, '<joint name="right" range="0 1"/>']])
    assert not still_there(path, [[2, '<joint name="right" range="0 2"/>']])
    assert not still_there(tmp_path / "nowhere.xml", [])
    unmended = bugs([])
    mended = bugs([sources.Source("menagerie", tmp_path)])
    assert sum("not in the version at hand" in part for part in unmended) == 0
    assert sum("not in the version at hand" in part for part in mended) == sum(
        "**menagerie/" in p for p in mended
    )


def test_the_command_prints_a_part_and_says_what_is_wrong_by_its_status(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(sources, "PACKAGES", {})
    folder = tmp_path / "menagerie" / "unitree_go1"
    folder.mkdir(parents=True)
    (folder / "go1.xml").write_text(MODELS["one shank is 4 % heavier"][0])
    arguments = models.Arguments(menagerie=tmp_path / "menagerie", out=tmp_path / "models.md", workers=1)
    assert models.main(arguments) == 0
    assert "| menagerie/unitree_go1: go1 |" in arguments.out.read_text()
    (folder / "go1.xml").write_text(MODELS["knees towards each other"][0])
    arguments.only = ("menagerie/*",)
    assert models.main(arguments) == 1
    captured = capsys.readouterr()
    assert "| menagerie/unitree_go1: go1 |" in captured.out
    assert "menagerie/unitree_go1/go1.xml: reflect-y: expected approximate, got exact" in captured.err
