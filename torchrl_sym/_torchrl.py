"""The private names of TorchRL that this package relies on, all in one place.

TorchRL may change them in any release; ``tests/test_torchrl_contracts.py`` says what we expect of each.
"""

from torchrl.envs import EnvBase, SerialEnv
from torchrl.objectives.ppo import (
    _broadcast_advantage_to_log_weight as broadcast_advantage_to_log_weight,
)
from torchrl.objectives.ppo import (
    _check_advantage_broadcast as check_advantage_broadcast,
)

__all__ = ["broadcast_advantage_to_log_weight", "check_advantage_broadcast", "serial_workers"]


def serial_workers(env: SerialEnv) -> list[EnvBase]:
    """The environments of a SerialEnv, one of each maker; they are made now, if they were not before."""
    if env.is_closed:
        env.start()
    makers = [id(maker) for maker in env.create_env_fn]
    return list(dict(zip(makers, env._envs, strict=True)).values())
