"""Declare the symmetry of your own environment: derive the signs, audit the model, verify the declaration.

The environment is dm_control's swing-up cart-pole. Its mirror plane sends the cart to the other side and
the pole with it. `derive` reads from the model which joints change sign; the observation is declared with
that; `verify` steps the simulator from mirrored states and says which entry is wrong, if one is.
"""

import warnings

from dm_control import suite
from torchrl.envs.libs.dm_control import DMControlWrapper

from torchrl_sym import PointGroup, Symmetry
from torchrl_sym.mujoco import audit, derive, verify
from torchrl_sym.representations import pseudoscalar, scalar

warnings.filterwarnings("ignore", module="glfw")  # it looks for a display, which nothing here needs

env = suite.load("cartpole", "swingup")
model = env.physics.model.ptr
group = PointGroup.reflection("x")

robot = derive(model, group)
print(robot)  # where every joint and actuator goes, with its sign
print(f"\nthe model's symmetry is {audit(model, group).verdict}\n")

same, sign = scalar(group), pseudoscalar(group)
symmetry = Symmetry(
    group,
    {
        "position": robot.joints(["slider"]) + same + sign,  # cart x; cos and sin of the pole's angle
        "velocity": robot.joint_velocities,  # of cart and pole
        "action": robot.actuators,  # force on the cart
    },
)
symmetry.check_specs(DMControlWrapper(env))  # every observation is declared, sizes fit, boxes are symmetric
print(verify(env, symmetry))

wrong = Symmetry(
    group,
    {
        "position": robot.joints(["slider"]) + same + same,  # the sine should change sign
        "velocity": robot.joint_velocities,
        "action": robot.actuators,
    },
)
print(f"\nwith one sign wrong: {verify(env, wrong).worst}")
