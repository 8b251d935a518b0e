"""rsl_rl as a peer: the same simulation, networks and hyper-parameters, driven by its own PPO.

It is optional (`pip install --no-deps rsl-rl-lib==5.5.1`). A :class:`Peer` does what rsl_rl's runner
does in an iteration, without a log. Differences that remain: time-outs are bootstrapped with the value of
the state before the last step (ours: of the true last one), gradients of actor and critic are clipped
apart, one permutation serves all epochs, and with augmentation every minibatch computes the symmetry
metric, whether or not it is used (``metric=False`` leaves it out).
"""

from __future__ import annotations

import contextlib
import importlib.util
import io

import torch
from tensordict import TensorDict

from tasks.environment import BatchedEnv
from torchrl_sym.recipes import PPOConfig

INSTALLED = importlib.util.find_spec("rsl_rl") is not None


class Simulation:
    """A batched environment as rsl_rl's VecEnv: it resets itself, at no cost beyond the simulation's."""

    cfg: dict = {}  # noqa: RUF012

    def __init__(self, env: BatchedEnv) -> None:
        self.env, self.symmetry, self.device = env, env.symmetry, str(env.device or "cpu")
        (self.num_envs,), self.num_actions = env.batch_size, env.action_spec.shape[-1]
        self.max_episode_length = env.task.max_steps
        env.stagger()
        self.observations = env.reset().select("observation")

    def get_observations(self) -> TensorDict:
        return self.observations

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict]:
        out = self.env._step(TensorDict(action=actions, batch_size=self.env.batch_size))
        done, observation = out["done"], out["observation"]
        if done.any():
            start = self.env._reset(TensorDict(_reset=done, batch_size=self.env.batch_size))
            observation = start["observation"]
        self.observations = TensorDict(observation=observation, batch_size=self.env.batch_size)
        extras = {"time_outs": out["truncated"].squeeze(-1)}
        return self.observations, out["reward"].squeeze(-1), done.squeeze(-1), extras


class Peer:
    """rsl_rl's PPO of a configuration.

    Args:
        config: hyper-parameters.
        env: the simulation.
        metric: compute the symmetry metric in every minibatch with augmentation, as rsl_rl does.
    """

    def __init__(self, config: PPOConfig, env: BatchedEnv, *, metric: bool = True) -> None:
        from rsl_rl.algorithms import PPO  # pyright: ignore[reportMissingImports]

        self.horizon, self.simulation = config.horizon, Simulation(env)
        with contextlib.redirect_stdout(io.StringIO()):  # it prints its networks
            observations = self.simulation.get_observations()
            self.algorithm = PPO.construct_algorithm(
                observations, self.simulation, configuration(config), config.device
            )
        if not metric and self.algorithm.symmetry is not None:
            self.algorithm.symmetry.compute_loss = lambda *_: torch.zeros(())
        self.algorithm.train_mode()

    def collect(self) -> None:
        """Collect a batch and estimate its returns; the critic is evaluated meanwhile."""
        from rsl_rl.utils import check_nan  # pyright: ignore[reportMissingImports]

        observations = self.simulation.get_observations()
        with torch.inference_mode():
            for _ in range(self.horizon):
                actions = self.algorithm.act(observations)
                observations, rewards, dones, extras = self.simulation.step(actions)
                check_nan(observations, rewards, dones)
                self.algorithm.process_env_step(observations, rewards, dones, extras)
            self.algorithm.compute_returns(observations)

    def learn(self) -> None:
        """All epochs on the batch that was collected last; it is kept."""
        self.algorithm.update()

    def iterate(self) -> None:
        self.collect()
        self.learn()


def configuration(config: PPOConfig) -> dict:
    """A configuration in rsl_rl's terms."""
    network = {"class_name": "MLPModel", "hidden_dims": list(config.hidden), "activation": "elu"}
    gaussian = {"class_name": "GaussianDistribution", "init_std": config.initial_std, "std_type": "log"}
    symmetry = {
        "data_augmentation_func": augment,
        "use_data_augmentation": True,
        "use_mirror_loss": False,
        "mirror_loss_coeff": 0.0,
    }
    algorithm = {
        "class_name": "PPO",
        "num_learning_epochs": config.epochs,
        "num_mini_batches": config.minibatches,
        "clip_param": config.clip_epsilon,
        "use_clipped_value_loss": config.clip_value is not None,
        "gamma": config.gamma,
        "lam": config.lmbda,
        "value_loss_coef": config.critic_coeff,
        "entropy_coef": config.entropy_coeff,
        "learning_rate": config.learning_rate,
        "max_grad_norm": config.max_grad_norm,
        "desired_kl": config.desired_kl,
        "symmetry_cfg": symmetry if config.augmentation == "all" else None,
    }
    return {
        "algorithm": algorithm,
        "actor": network | {"distribution_cfg": gaussian},
        "critic": network,
        "obs_groups": {"actor": ["observation"], "critic": ["observation"]},
        "num_steps_per_env": config.horizon,
        "multi_gpu": None,
    }


def augment(
    env: Simulation, obs: TensorDict | None, actions: torch.Tensor | None
) -> tuple[TensorDict | None, torch.Tensor | None]:
    """All copies, group-major: rsl_rl's interface to the same representations."""
    if obs is not None:
        copies = env.symmetry["observation"].orbit(obs["observation"]).flatten(0, 1)
        obs = TensorDict(observation=copies, batch_size=[len(copies)])
    if actions is not None:
        actions = env.symmetry["action"].orbit(actions).flatten(0, 1)
    return obs, actions
