"""The private names of TorchRL that this package relies on, all in one place.

TorchRL may change them in any release; ``tests/test_torchrl_contracts.py`` says what we expect of each.
"""

from typing import Any

from tensordict import NestedKey
from torchrl.data import ReplayBuffer, TensorDictReplayBuffer
from torchrl.data.replay_buffers import SampleUnit, SliceSampler, Storage
from torchrl.envs import EnvBase, SerialEnv, Transform, VecNormV2
from torchrl.objectives import ClipPPOLoss, LossModule
from torchrl.objectives.ppo import (
    _broadcast_advantage_to_log_weight as broadcast_advantage_to_log_weight,
)
from torchrl.objectives.ppo import (
    _check_advantage_broadcast as check_advantage_broadcast,
)

__all__ = [
    "INHERITED",
    "broadcast_advantage_to_log_weight",
    "buffers_sampling_by",
    "check_advantage_broadcast",
    "cuts_by",
    "serial_workers",
    "wrapped_env",
    "wrappers_of",
]

# What our subclasses take from their parents or put in their place, by parent, with its arguments.
INHERITED: dict[type, dict[str, list[str] | None]] = {
    ClipPPOLoss: {
        "_cached_critic_network_params_detached": None,
        "_clear_weakrefs": ["tds"],
        "_clip_bounds": None,
        "_critic_loss_inputs": ["target_return", "state_value", "old_state_value"],
        "_get_entropy": ["dist", "adv_shape"],
        "_log_weight": ["tensordict", "adv_shape"],
        "_loss_mask_keys": [],
        "_maybe_normalize_advantage": ["advantage", "tensordict", "update_norm"],
        "_reduce_loss": ["loss", "tensordict", "mask", "reduction", "weights"],
        "_weighted_loss_entropy": ["entropy"],
    },
    LossModule: {
        "_clear_weakrefs": ["tds"],
        "_forward_value_estimator_keys": ["kwargs"],
        "_loss_mask_keys": [],
        "_reduce_loss": ["loss", "tensordict", "mask", "reduction", "weights"],
    },
    TensorDictReplayBuffer: {"_sample": ["args", "kwargs"]},
    Transform: {"_inv_call": ["tensordict"]},
    VecNormV2: {
        "_get_loc_scale": ["loc_only"],
        "_maybe_stateful_init": ["data"],
        "_norm": ["data", "loc", "var", "count"],
        "_stateful_norm": ["data"],
        "_stateful_update": ["data"],
    },
}


def serial_workers(env: SerialEnv) -> list[EnvBase]:
    """The environments of a SerialEnv, one of each maker; they are made now, if they were not before."""
    if env.is_closed:
        env.start()
    makers = [id(maker) for maker in env.create_env_fn]
    return list(dict(zip(makers, env._envs, strict=True)).values())


def wrappers_of(env: EnvBase) -> list[object]:
    """What another library has put around the simulation inside an environment, the outermost first."""
    found, inner = [], vars(env).get("_env")  # batched environments would ask their workers
    while inner is not None and inner not in found:
        found.append(inner)
        inner = getattr(inner, "env", None)
    return found


def buffers_sampling_by(unit: SampleUnit, storage: Storage) -> list[ReplayBuffer]:
    """The replay buffers of a storage that have a sample unit."""
    return [buffer for buffer in storage._attached_entities if buffer._sample_unit is unit]


def cuts_by(sampler: SliceSampler, key: NestedKey) -> bool:
    """Whether a sampler takes slices between changes of this entry, wherever the storage has it."""
    return sampler.traj_key == key or getattr(sampler, "_traj_key_auto", False)


def wrapped_env(env: EnvBase) -> Any:
    """What a GymEnv, a DMControlEnv, ... wraps; the environment itself if it is TorchRL's own."""
    return next(iter(wrappers_of(env)), env)
