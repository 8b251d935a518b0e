"""The private names of TorchRL that this package relies on, all in one place.

TorchRL may change them in any release; ``tests/test_torchrl_contracts.py`` says what we expect of each.
"""

from torchrl.objectives.ppo import (
    _broadcast_advantage_to_log_weight as broadcast_advantage_to_log_weight,
)
from torchrl.objectives.ppo import (
    _check_advantage_broadcast as check_advantage_broadcast,
)

__all__ = ["broadcast_advantage_to_log_weight", "check_advantage_broadcast"]
