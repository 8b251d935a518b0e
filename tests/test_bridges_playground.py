"""MuJoCo Playground's Spot through TorchRL's wrapper: its example, and what the example makes up for.

Playground needs JAX: pip install playground "mujoco<4" "mujoco-mjx<4" "jax[cpu]". It compiles for minutes.
"""

import runpy
import sys
from pathlib import Path

import pytest
import torch
from torchrl.envs import MujocoPlaygroundWrapper

from tests.foreign import assert_loss_takes_copies

registry = pytest.importorskip("mujoco_playground", reason="pip install playground").registry
jax = pytest.importorskip("jax")
pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def example(tmp_path_factory):
    """What the names of the example stand for, once it has run."""
    jax.config.update("jax_compilation_cache_dir", str(tmp_path_factory.mktemp("compiled")))
    with pytest.MonkeyPatch.context() as patch:
        tiny = ["--iterations", "2", "--num-envs", "4", "--device", "cpu"]
        patch.setattr(sys, "argv", ["playground.py", *tiny])
        return runpy.run_path(str(ROOT / "examples/playground.py"))


def test_the_example_trains(example):
    metrics = example["metrics"]
    assert metrics["iteration"] == 2 and metrics["frames"] == 2 * 24 * 4
    assert metrics["loss_critic"] > 0 and metrics["mirror_loss"] > 0


def test_a_wrong_declaration_is_found(example):
    """Angular velocities are no vectors: the roll of a mirrored robot is the other way round."""
    robot = example["robot"]

    class Mistaken:
        group, joint_positions, actuators = robot.group, robot.joint_positions, robot.actuators

        def sensors(self, names):
            return robot.sensors(["upvector"] if names == ["gyro"] else names)

    with pytest.raises(AssertionError, match="state: Tensor-likes are not close"):
        example["try_out"](example["quiet"], robot, example["declare"](Mistaken()))


def test_a_loss_takes_what_it_gives(example):
    torch.manual_seed(0)
    keys = {"actor_keys": ("state",), "critic_keys": ("privileged_state",)}
    assert_loss_takes_copies(example["env"], example["symmetry"], **keys)


@pytest.mark.parametrize("others", [True, False])
def test_episodes_go_on_where_another_ends(example, others):
    """TorchRL's own class begins them anew: once it does not, the example's is not needed."""
    base = registry.load("CartpoleBalance", config_overrides={"impl": "jax"})
    env = (example["Playground"] if others else MujocoPlaygroundWrapper)(base, batch_size=[3], device="cpu")
    td = env.rollout(5)[:, -1]["next"].clone()
    ended = td["_reset"] = torch.tensor([[True], [False], [False]])
    begun = env.reset(td.clone())["observation"]
    assert ((begun != td["observation"]).any(-1, keepdim=True) == ended).all()
    state = torch.tensor(jax.device_get(env._current_state.obs))
    assert (state == begun).all() == others
