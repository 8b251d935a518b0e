"""Declare the symmetry of your own environment, and check the declaration against the simulator.

The environment here is dm_control's swing-up cart-pole, used through TorchRL's DMControlEnv. Its mirror
plane sends the cart to the other side and the pole with it: positions and velocities along x change
sign, so does the pole's angle (hence its sine, not its cosine) and the force.
"""

import torch
from tensordict import TensorDict
from torchrl.envs.libs.dm_control import DMControlEnv

from torchrl_sym import PointGroup, Symmetry
from torchrl_sym.representations import pseudoscalar, scalar

env = DMControlEnv("cartpole", "swingup")
group = PointGroup.reflection("x")
same, sign = scalar(group), pseudoscalar(group)
symmetry = Symmetry(
    group,
    {
        "position": sign + same + sign,  # cart x, cos and sin of the pole's angle
        "velocity": sign + sign,  # of cart and pole
        "action": sign,  # force on the cart
    },
)
symmetry.check_specs(env)  # every observation is declared, sizes fit, the action box is symmetric


def largest_error(symmetry: Symmetry, steps: int = 50) -> float:
    """Largest difference between the mirror image of a roll-out and the roll-out of its mirror image."""
    torch.manual_seed(0)
    actions = 2 * torch.rand(steps, 1, dtype=torch.float64) - 1
    position, velocity = torch.tensor([0.3, 0.5]), torch.tensor([-0.2, 0.4])  # of cart and pole

    def roll_out(g: int) -> TensorDict:
        env.reset()
        physics = env.physics
        with physics.reset_context():
            physics.data.qpos[:] = group.det[g] * position
            physics.data.qvel[:] = group.det[g] * velocity
        steps = [env.step(TensorDict(action=symmetry["action"](a, g)))["next"] for a in actions]
        return torch.stack([step.select("position", "velocity", "reward") for step in steps])

    difference = symmetry(roll_out(0), "reflect-x") - roll_out(1)
    return max(float(value.abs().max()) for value in difference.values())


print(f"declared as above:   error {largest_error(symmetry):.1e}")
wrong = Symmetry(group, {"position": sign + same + same, "velocity": sign + sign, "action": sign})
print(f"sine left unchanged: error {largest_error(wrong):.1e}")
