"""Augment a batch: every sample of a quadruped and its three symmetric copies.

A four-legged robot with equal legs is symmetric under the Klein four-group: front-back reflection,
left-right reflection, and their product, the half turn. Declare how each part of the observation
transforms, in the order of its entries, and `SymmetryAugment` makes the copies. For off-policy learning,
`SymmetryReplayBuffer` makes them of what it samples.
"""

import torch
from tensordict import TensorDict
from torchrl.data import LazyTensorStorage

from torchrl_sym import PointGroup, Symmetry, SymmetryAugment, SymmetryReplayBuffer
from torchrl_sym.representations import axial, height_map, polar, signed_permutation

LEGS = ("LF", "RF", "LH", "RH")  # left and right, front and hind
JOINTS = [f"{leg}_{joint}" for leg in LEGS for joint in ("HAA", "HFE", "KFE")]


def swap(a: str, b: str, flipped: tuple[str, ...]) -> dict[str, str]:
    """Letters a and b of a leg's name change places; the flipped joints change sign."""
    table = str.maketrans(a + b, b + a)
    return {
        name: ("-" if name.endswith(flipped) else "") + name[:2].translate(table) + name[2:]
        for name in JOINTS
    }


group = PointGroup.klein_four()
joints = signed_permutation(
    group, JOINTS, {"reflect-x": swap("F", "H", ("HFE", "KFE")), "reflect-y": swap("L", "R", ("HAA",))}
)
heights = height_map(group, x=torch.linspace(-1.0, 1.0, 21), y=torch.linspace(-0.5, 0.5, 11))
symmetry = Symmetry(
    group,
    {
        # base velocity, angular velocity, gravity; joint positions, velocities, last action; heights
        "observation": polar(group) + axial(group) + polar(group) + joints * 3 + heights,
        "action": joints,
    },
)

batch = TensorDict(
    observation=torch.randn(64, symmetry["observation"].dim),
    action=torch.randn(64, symmetry["action"].dim),
    action_log_prob=torch.randn(64),
    advantage=torch.randn(64, 1),
    batch_size=[64],
)
augmented = SymmetryAugment(symmetry)(batch)

print(f"{batch.batch_size[0]} samples become {augmented.batch_size[0]}: {', '.join(group.names)}")
copies = augmented.unflatten(0, (group.order, 64))
print("base velocity of sample 0 in each copy:")
for name, velocity in zip(group.names, copies["observation"][:, 0, :3], strict=True):
    print(f"  {name:10s} {velocity.numpy().round(2)}")
assert (copies["action_log_prob"] == batch["action_log_prob"]).all(), "copies share the log-probability"

buffer = SymmetryReplayBuffer(symmetry, storage=LazyTensorStorage(1000), batch_size=16)
buffer.extend(batch)
sample = buffer.sample()
print(f"the buffer has {len(buffer)} samples and gives {len(sample)}, {buffer.batch_size} of each element")
