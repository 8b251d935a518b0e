"""The symmetry of your own environment: audit the model, infer the representations, verify them.

The environment is dm_control's swing-up cart-pole. Its mirror plane sends the cart to the other side and
the pole with it. `infer` observes states and their images in the simulator and finds from these how every
entry transforms; `code()` is what one would have written by hand. `verify` steps the simulator from
mirrored states and says which entry is wrong, if one is: as in the declaration at the end.
"""

import warnings

from dm_control import suite
from torchrl.envs.libs.dm_control import DMControlWrapper

from torchrl_sym import PointGroup, Symmetry
from torchrl_sym.mujoco import audit, derive, infer, verify
from torchrl_sym.representations import scalar

warnings.filterwarnings("ignore", module="glfw")  # it looks for a display, which nothing here needs

env = suite.load("cartpole", "swingup")
model = env.physics.model.ptr
group = PointGroup.reflection("x")

robot = derive(model, group)
print(robot)  # where every joint and actuator goes, with its sign
print(f"\nthe model's symmetry is {audit(model, group).verdict}\n")

symmetry = infer(env, group)
print(symmetry)  # every entry, and what becomes it under each element
print(f"\n{symmetry.code()}")  # the same as a declaration, to be pasted and reviewed
symmetry.check_specs(DMControlWrapper(env))  # every observation is declared, sizes fit, boxes are symmetric
print(verify(env, symmetry))

wrong = Symmetry(
    group,
    {
        "position": robot.joints(["slider"]) + scalar(group) * 2,  # the pole's sine should change sign
        "velocity": symmetry["velocity"],
        "action": robot.actuators,
    },
)
print(f"\nwith one sign wrong: {verify(env, wrong).worst}")
