"""Boston Dynamics' Spot from MuJoCo Playground, with TorchRL: a symmetry from the model, tried out in JAX.

Playground's environments are functions in JAX, which observe what their authors wrote down: `infer` and
`verify` cannot step them. But each has its MuJoCo model, from which `derive` knows where every joint and
sensor goes; what is left is to name what is observed, in order. The declaration is then tried out: robots
in mirrored states that do mirrored actions must observe images of each other, and be rewarded alike.

    pip install playground "mujoco<4" "mujoco-mjx<4" "jax[cuda12]"
    python examples/playground.py --num-envs 1024 --device cuda:0

Playground downloads the robots' meshes at first. Run on the CPU (playground 0.2, JAX 0.10, 4 robots), where
compilation takes minutes; nobody has tried it on a GPU.
"""

import argparse

import jax
import jax.numpy as jp
import torch
from mujoco_playground import registry
from torchrl.envs import MujocoPlaygroundWrapper, StepCounter, TransformedEnv

from torchrl_sym import PointGroup, Symmetry
from torchrl_sym.mujoco import derive
from torchrl_sym.recipes import PPOConfig, train
from torchrl_sym.representations import planar, polar, pseudoscalar

TASK, FEET = "SpotFlatTerrainJoystick", ["FL", "FR", "HL", "HR"]
# MuJoCo Warp, the default, keeps the contacts of all robots in one array, which `_choose` cannot divide.
ENGINE = {"impl": "jax"}
QUIET = {"obs_noise.scales." + name: 0.0 for name in ("joint_pos", "gyro", "gravity")}
QUIET |= {"obs_noise.scales.feet_pos": [0.0, 0.0, 0.0]}


class Playground(MujocoPlaygroundWrapper):
    """Where an episode has ended, a new one begins; TorchRL's own class restarts all others with it.

    It does so behind their backs: what they observed stays, the state that they step from is another one.
    """

    def _reset(self, tensordict=None, **kwargs):
        before = getattr(self, "_current_state", None)
        ended = None if tensordict is None else tensordict.get("_reset", None)
        out = super()._reset(tensordict, **kwargs)
        if before is not None and ended is not None:
            self._current_state = _choose(ended.flatten().cpu().numpy(), self._current_state, before)
        return out


@jax.jit
def _choose(which, new, old):
    return jax.tree.map(lambda x, y: jp.where(which.reshape(-1, *[1] * (x.ndim - 1)), x, y), new, old)


def velocity(group):
    """How a command transforms: forwards, sideways, turning."""
    return planar(group) + pseudoscalar(group)


def declare(robot):
    """How what Spot observes transforms, in the order of `_get_obs` in Playground's spot/joystick.py."""

    def of_feet(quantity):
        return robot.sensors([f"{foot}_{quantity}" for foot in FEET])

    group, legs, drives = robot.group, robot.joint_positions, robot.actuators
    gyro, up = robot.sensors(["gyro"]), robot.sensors(["upvector"])
    state = gyro + up + legs + legs * 3 + of_feet("pos") + drives + velocity(group)

    base = gyro + robot.sensors(["accelerometer"]) + up + robot.sensors(["local_linvel", "global_angvel"])
    contact = of_feet("floor_found")  # and the time since: one number for every foot
    known = base + legs + of_feet("pos") + legs + drives
    known += contact + of_feet("global_linvel") + contact + polar(group)  # a push
    return Symmetry(group, {"state": state, "privileged_state": state + known, "action": drives})


def try_out(env, robot, symmetry, steps=5):
    """Step images of one robot; AssertionError unless they observe images, and are rewarded alike."""
    order, random = robot.group.order, torch.Generator().manual_seed(0)
    state = jax.jit(jax.vmap(env.reset))(jp.stack([jax.random.PRNGKey(0)] * order))  # of equal robots

    def images(values, map_):
        value = torch.tensor(jax.device_get(values[0])).double()
        return jp.stack([jp.asarray(map_(value, g).float().numpy()) for g in range(order)])

    pushed = state.data.qvel + 0.3 * torch.randn(robot.model.nv, generator=random).numpy()
    data = state.data.replace(
        qpos=images(state.data.qpos, robot.map_qpos),
        qvel=images(pushed, robot.map_qvel),
        qacc_warmstart=images(state.data.qacc_warmstart, robot.map_qvel),
    )
    state = state.replace(data=data)
    state.info["command"] = images(state.info["command"], velocity(robot.group))
    step = jax.jit(jax.vmap(env.step))
    for _ in range(steps):
        action = 0.5 * torch.randn(symmetry["action"].dim, generator=random)
        state = step(state, jp.asarray(symmetry["action"].orbit(action).numpy()))

    for key, values in state.obs.items():
        seen = torch.tensor(jax.device_get(values))
        image = symmetry[key].orbit(seen[0])
        torch.testing.assert_close(image, seen, rtol=1e-2, atol=1e-2, msg=(key + ": {}").format)
        print(
            f"{key}: mirrored robots differ by {(seen - seen[0]).abs().max():.3g}, images by "
            f"{(image - seen).abs().max():.1g} after {steps} steps"
        )
    assert jp.allclose(state.reward, state.reward[0], rtol=1e-2, atol=1e-4), state.reward


parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--iterations", type=int, default=300)
parser.add_argument("--num-envs", type=int, default=1024)
parser.add_argument("--device", default="cuda:0")
parser.add_argument("--folder", help="where checkpoints and metrics.csv go")
args = parser.parse_args()

quiet = registry.load(TASK, config_overrides=ENGINE | QUIET)
robot = derive(quiet.mj_model, PointGroup.reflection("y"))
symmetry = declare(robot)
try_out(quiet, robot, symmetry)

base = registry.load(TASK, config_overrides=ENGINE)
env = Playground(base, batch_size=[args.num_envs], device=args.device)
env = TransformedEnv(env, StepCounter(registry.get_default_config(TASK).episode_length))
config = PPOConfig(
    iterations=args.iterations,
    num_envs=args.num_envs,
    horizon=24,
    epochs=5,
    minibatches=4,
    gamma=0.97,  # as Playground trains Spot
    desired_kl=0.01,
    entropy_coeff=0.005,
    hidden=(512, 256, 128),
    normalize_observations=True,
    tie_std=True,
    actor_keys=("state",),
    critic_keys=("privileged_state",),
    device=args.device,
)
for metrics in train(config, lambda **_: env, symmetry, folder=args.folder):
    print(
        f"iteration {metrics['iteration']}: return {metrics['return']:.3f}, KL {metrics['kl']:.4f}, "
        f"mirror loss {metrics['mirror_loss']:.4f}, std {metrics['std']:.2f}"
    )
