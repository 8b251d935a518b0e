"""mjlab's own environments with the bridge: robots in mirrored states observe the images of each other.

The simulation is single precision on the CPU. mjlab pins another MuJoCo: install it in an environment of
its own.
"""

import copy
import dataclasses
import os
import re
import subprocess
import sys
from pathlib import Path

import mujoco
import pytest
import torch
from tensordict import TensorDict
from torchrl.envs import MJLabWrapper

from tests.foreign import assert_loss_takes_copies
from torchrl_sym import PointGroup, Symmetry
from torchrl_sym.bridges import mjlab
from torchrl_sym.bridges.rsl_rl import data_augmentation
from torchrl_sym.mujoco import SymmetryError, derive
from torchrl_sym.representations import axial, invariant, polar

os.environ.setdefault("MJLAB_WARP_QUIET", "1")
envs, observation, entities, rl, registry = (
    pytest.importorskip(f"mjlab.{name}", reason="pip install mjlab")
    for name in (
        "envs",
        "managers.observation_manager",
        "managers.scene_entity_config",
        "rl",
        "tasks.registry",
    )
)

ROOT = Path(__file__).parents[1]
MIRROR = PointGroup.reflection("y")
BOXES = [(0.75, 0.3, 0.1), (-0.6, 0.6, 0.3), (0.1, 0.9, 0.2)]  # x, y and height of some, in metres
CLOSE = 1e-2  # single precision, five steps with contacts, of velocities up to 10 rad/s


def mirrored_boxes(spec: mujoco.MjSpec) -> None:
    """Something to be scanned on both sides, which nothing collides with."""
    for x, y, height in BOXES:
        for side in (-1, 1):
            spec.worldbody.add_geom(
                type=mujoco.mjtGeom.mjGEOM_BOX,
                pos=[x, side * y, height / 2],
                size=[0.15, 0.2, height / 2],
                contype=0,
                conaffinity=0,
                group=0,
            )


def make(robot: str):
    """Two robots on a plane between boxes, with groups of every kind, and nothing random."""
    flat = registry.load_env_cfg(f"Mjlab-Velocity-Flat-Unitree-{robot}")
    rough = registry.load_env_cfg(f"Mjlab-Velocity-Rough-Unitree-{robot}")
    flat.scene.num_envs, flat.events, flat.sim.njmax = 2, {}, 600
    flat.scene.spec_fn = mirrored_boxes
    flat.scene.sensors += tuple(s for s in rough.scene.sensors if s.name == "terrain_scan")
    actor, critic = flat.observations["actor"], flat.observations["critic"]
    actor.enable_corruption, actor.history_length = False, 3
    critic.terms = critic.terms | {"height_scan": rough.observations["critic"].terms["height_scan"]}
    some = {
        name: copy.deepcopy(critic.terms[name]) for name in ("projected_gravity", "joint_pos", "actions")
    }
    some["joint_pos"] = dataclasses.replace(some["joint_pos"], scale=0.5, clip=(-1.0, 1.0))
    flat.observations["frames"] = observation.ObservationGroupCfg(
        terms=some, history_length=2, flatten_history_dim=False
    )
    parts = some | {"joint_pos": dataclasses.replace(some["joint_pos"], history_length=4)}
    flat.observations["parts"] = observation.ObservationGroupCfg(terms=parts, concatenate_terms=False)
    return envs.ManagerBasedRlEnv(flat, device="cpu")


@pytest.fixture(scope="module")
def humanoid():
    env = make("G1")
    yield env
    env.close()


def mirrored_steps(env, symmetry, steps: int = 5):
    """Observations of two robots, the second of which is and does the image of the first."""
    robot, random = derive(env.sim.mj_model, MIRROR), torch.Generator().manual_seed(0)
    env.reset()
    env.scene.env_origins[:] = 0
    qpos, qvel = (
        env.sim.data.qpos[0].double().clone(),
        torch.randn(robot.model.nv, generator=random).double(),
    )
    qpos[:2], qpos[3:7] = torch.tensor([0.1, 0.3]), torch.tensor([1.0, 0.1, -0.05, 0.2])
    qpos[3:7] /= qpos[3:7].norm()
    qpos[7:] += 0.2 * torch.randn(len(qpos) - 7, generator=random)
    for g in (0, 1):
        env.sim.data.qpos[g] = robot.map_qpos(qpos, g).float()
        env.sim.data.qvel[g] = robot.map_qvel(qvel, g).float()
    env.sim.forward()

    command, wanted = env.command_manager.get_term("twist"), torch.tensor([0.7, 0.3, -0.4])
    for flags in (command.is_heading_env, command.is_standing_env):
        flags[:] = False
    command.time_left[:] = 100
    for _ in range(steps):
        command.vel_command_b[:] = torch.stack([wanted, wanted * torch.tensor([1.0, -1.0, -1.0])])
        action = 0.5 * torch.randn(symmetry["action"].dim, generator=random)
        obs, *_ = env.step(symmetry["action"].orbit(action))
    return obs


def terms_of(env, group: str, values: torch.Tensor):
    """The parts of a group, by name."""
    sizes = [int(torch.Size(shape).numel()) for shape in env.observation_manager.group_obs_term_dim[group]]
    return zip(env.observation_manager.active_terms[group], values.split(sizes, -1), strict=True)


def test_mirrored_robots_observe_images_of_each_other(humanoid):
    symmetry = mjlab.symmetry(humanoid, MIRROR)
    names = ["projected_gravity", "joint_pos", "actions"]
    assert symmetry.keys() == ["actor", "critic", "frames", *(("parts", name) for name in names), "action"]
    assert symmetry["frames"].event_shape == (2, 3 + 29 + 29)
    assert symmetry[("parts", "joint_pos")].event_shape == (4 * 29,)

    obs = mirrored_steps(humanoid, symmetry)
    for group in ("actor", "critic"):
        here, there = obs[group]
        image = dict(terms_of(humanoid, group, symmetry[group](here, "reflect-y")))
        itself = dict(terms_of(humanoid, group, here))
        for name, value in terms_of(humanoid, group, there):
            wrong = ((image[name] - value).abs() > CLOSE).float().mean()
            assert wrong <= (0.02 if name == "height_scan" else 0), (group, name)  # of rays at an edge
            quiet = {"foot_contact", "foot_air_time"}  # in which both feet do the same
            assert name in quiet or (itself[name] - value).abs().max() > 3 * CLOSE, (group, name)
    for key in ("frames", *(("parts", name) for name in names)):
        here, there = obs[key] if isinstance(key, str) else obs[key[0]][key[1]]
        assert (symmetry[key](here, "reflect-y") - there).abs().max() < CLOSE, key


def test_torchrl_and_rsl_rl_take_it(humanoid):
    symmetry = mjlab.symmetry(humanoid, MIRROR)
    observed = rl.RslRlVecEnvWrapper(humanoid).get_observations()
    images, actions = data_augmentation(symmetry)(None, observed, torch.zeros(2, 29))
    assert images.batch_size == (4,) and actions.shape == (4, 29)
    assert (images["parts", "actions"][:2] == observed["parts", "actions"]).all()
    assert mjlab.symmetry(rl.RslRlVecEnvWrapper(humanoid), MIRROR).keys() == symmetry.keys()
    wrapped = MJLabWrapper(humanoid)
    symmetry.check_specs(wrapped)
    assert mjlab.symmetry(wrapped, MIRROR).keys() == symmetry.keys()


def test_mirrored_robots_observe_images_through_torchrls_wrapper(humanoid):
    symmetry, wrapped = mjlab.symmetry(humanoid, MIRROR), MJLabWrapper(humanoid)
    mirrored_steps(humanoid, symmetry)
    action = symmetry["action"].orbit(0.5 * torch.randn(29))
    seen = wrapped.step(TensorDict(action=action, batch_size=[2]))["next"]
    for key in ("actor", "frames", ("parts", "joint_pos")):
        here, there = seen[key]
        assert (symmetry[key](here, "reflect-y") - there).abs().max() < CLOSE, key
        assert (here - there).abs().max() > 3 * CLOSE, key


def test_a_loss_takes_what_torchrls_wrapper_gives(humanoid):
    keys = {"actor_keys": ("actor",), "critic_keys": ("critic", "frames", ("parts", "joint_pos"))}
    assert_loss_takes_copies(MJLabWrapper(humanoid), mjlab.symmetry(humanoid, MIRROR), **keys)


def settings(env, group: str, name: str):
    return env.observation_manager.get_term_cfg(group, name)


def own_function(env):
    return env.scene["robot"].data.joint_pos


def test_terms_of_ones_own_are_named_and_can_be_given(humanoid, monkeypatch):
    for group in ("actor", "critic"):
        monkeypatch.setattr(settings(humanoid, group, "projected_gravity"), "func", own_function)
    with pytest.raises(KeyError) as error:
        mjlab.symmetry(humanoid, MIRROR)
    for words in (
        "got 2 that do not",
        "actor/projected_gravity: ",
        "own_function is not known",
        "critic/proj",
    ):
        assert words in error.value.args[0]

    terms = {"projected_gravity": polar(MIRROR), ("critic", "projected_gravity"): invariant(MIRROR, 3)}
    symmetry = mjlab.symmetry(humanoid, MIRROR, terms=terms)
    step = torch.ones(symmetry["critic"].dim)
    image = dict(terms_of(humanoid, "critic", symmetry["critic"](step, 1)))["projected_gravity"]
    assert image.tolist() == [1.0, 1.0, 1.0]


def test_joints_by_name_in_any_order(humanoid, monkeypatch):
    scene_entity = settings(humanoid, "critic", "joint_pos").params.get("asset_cfg")
    assert scene_entity is None  # so that the default is all joints
    names = humanoid.scene["robot"].joint_names
    knees = [i for i, name in enumerate(names) if "knee" in name or "hip_roll" in name][::-1]
    chosen = dataclasses.replace(entities.SceneEntityCfg("robot"), joint_ids=knees)
    monkeypatch.setattr(settings(humanoid, "critic", "joint_pos"), "params", {"asset_cfg": chosen})
    monkeypatch.setitem(humanoid.observation_manager.group_obs_term_dim, "critic", [
        (4,) if name == "joint_pos" else shape
        for name, shape in zip(
            humanoid.observation_manager.active_terms["critic"],
            humanoid.observation_manager.group_obs_term_dim["critic"],
            strict=True,
        )
    ])  # fmt: skip
    symmetry = mjlab.symmetry(humanoid, MIRROR)["critic"]
    image = symmetry(torch.arange(1.0, symmetry.dim + 1), 1)[9:13]
    assert image.tolist() == [12.0, -13.0, 10.0, -11.0]  # right and left knee, right and left roll


def test_one_sided_knees_are_refused(humanoid, monkeypatch):
    names = humanoid.scene["robot"].joint_names
    left = dataclasses.replace(entities.SceneEntityCfg("robot"), joint_ids=[names.index("left_knee_joint")])
    monkeypatch.setattr(settings(humanoid, "critic", "joint_vel"), "params", {"asset_cfg": left})
    with pytest.raises(KeyError, match=r"critic/joint_vel: .*right_knee_joint, which is not among"):
        mjlab.symmetry(humanoid, MIRROR)


def test_a_crooked_default_pose_is_refused(humanoid, monkeypatch):
    pose = humanoid.scene["robot"].data.default_joint_pos.clone()
    pose[:, humanoid.scene["robot"].joint_names.index("left_elbow_joint")] += 0.1
    monkeypatch.setattr(humanoid.scene["robot"].data, "default_joint_pos", pose)
    with pytest.raises(KeyError, match=r"critic/joint_pos: the default pose.*elbow_joint is off by 0.1"):
        mjlab.symmetry(humanoid, MIRROR)


def test_an_action_of_unequal_scales_is_refused(humanoid, monkeypatch):
    term = humanoid.action_manager.get_term("joint_pos")
    scale = term._scale.clone()
    scale[:, term.target_names.index("left_knee_joint")] *= 2
    monkeypatch.setattr(term, "_scale", scale)
    with pytest.raises(ValueError, match="action 'joint_pos': its scale does not commute with 'reflect-y'"):
        mjlab.symmetry(humanoid, MIRROR)
    assert mjlab.symmetry(humanoid, MIRROR, action=derive(humanoid.sim.mj_model, MIRROR).joints(
        [f"robot/{name}" for name in term.target_names]))  # fmt: skip


def test_a_scan_that_is_not_symmetric_is_refused(humanoid, monkeypatch):
    pattern = humanoid.scene["terrain_scan"].cfg.pattern
    monkeypatch.setattr(pattern, "direction", (0.0, 0.3, -1.0))
    with pytest.raises(KeyError, match=r"critic/height_scan: 'reflect-y' carries the ray from"):
        mjlab.symmetry(humanoid, MIRROR)


@pytest.mark.parametrize("sensor", ["feet_ground_contact", "foot_height_scan"])
def test_a_sensor_on_one_side_is_refused(humanoid, monkeypatch, sensor):
    cfg = humanoid.scene[sensor].cfg
    if sensor == "foot_height_scan":
        monkeypatch.setattr(cfg, "frame", cfg.frame[:1])
    else:
        monkeypatch.setattr(humanoid.scene[sensor], "_slots", humanoid.scene[sensor]._slots[:2])
    with pytest.raises(KeyError, match=r"carries robot/.* to one that is not among"):
        mjlab.symmetry(humanoid, MIRROR)


def test_forces_in_the_frame_of_a_contact_are_refused(humanoid, monkeypatch):
    monkeypatch.setattr(humanoid.scene["feet_ground_contact"].cfg, "reduce", "maxforce")
    with pytest.raises(KeyError, match="foot_contact_forces: forces in the frame of a contact"):
        mjlab.symmetry(humanoid, MIRROR)


def test_a_group_that_the_robot_does_not_have_is_refused(humanoid):
    with pytest.raises(SymmetryError, match="reflect-x"):
        mjlab.symmetry(humanoid, PointGroup.klein_four())


def test_a_sensor_beside_the_plane_is_named():
    """Go1's velocity sensor is 67 mm right of the plane: what it measures has no linear image."""
    env = make("Go1")
    with pytest.raises(KeyError, match="actor/base_lin_vel: sensor 'robot/imu_lin_vel' has no rep"):
        mjlab.symmetry(env, MIRROR)
    given = {"base_lin_vel": polar(MIRROR), "base_ang_vel": axial(MIRROR)}
    symmetry = mjlab.symmetry(env, MIRROR, terms=given)
    here, there = mirrored_steps(env, symmetry)["critic"]
    image = dict(terms_of(env, "critic", symmetry["critic"](here, "reflect-y")))
    for name, value in terms_of(env, "critic", there):
        wrong = ((image[name] - value).abs() > 3 * CLOSE).float().mean()
        expected = {"base_lin_vel": wrong > 0, "height_scan": wrong < 0.02}  # rays may hit an edge
        assert expected.get(name, wrong == 0), name
    env.close()


def run(script: str, *arguments: str) -> str:
    """What a script prints that trains with four robots."""
    environment = os.environ | {"PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, str(ROOT / script), "--num-envs", "4", "--device", "cpu", *arguments]
    result = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
    assert result.returncode == 0, result.stderr[-3000:]
    return result.stdout


def test_the_example_trains_and_keeps_the_symmetry(tmp_path):
    output = run("examples/mjlab_ppo.py", "--iterations", "1", "--out", str(tmp_path / "g1.json"))
    assert re.search(r"after 1 iterations: mirror error [\d.]+ of the mean action", output)
    assert Symmetry.load(tmp_path / "g1.json")["action"].dim == 29


def test_the_example_trains_with_torchrl(tmp_path):
    output = run("examples/mjlab_torchrl.py", "--iterations", "2", "--folder", str(tmp_path))
    assert re.search(r"iteration 2: return \S+, KL [\d.]+, mirror loss [\d.]+", output)
    assert (tmp_path / "checkpoint.pt").exists()
