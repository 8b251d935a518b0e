"""What the tests of the engine on mujoco_warp share: a model with contacts, controls, short runs.

Kernels are compiled on first use and then kept (WARP_CACHE_PATH names another folder for them). To compile
few, all tests use two models: CartPole, and this one.
"""

import torch

from tasks.warp_simulation import WarpSimulation

# A body on three feet that slides, hops and tips, a mocap body, an actuator with a state, a limited joint.
MODEL = """
<mujoco>
  <option timestep="0.005" integrator="implicitfast" cone="elliptic" iterations="20" ls_iterations="20"/>
  <worldbody>
    <geom name="ground" type="plane" size="0 0 1"/>
    <body name="target" mocap="true" pos="1 2 3"/>
    <body name="body" pos="0 0 0.149">
      <joint name="slide" type="slide" axis="1 0 0"/>
      <joint type="slide" axis="0 0 1"/>
      <joint name="hinge" type="hinge" axis="0 1 0" range="-90 90"/>
      <geom size=".05" mass="1" pos="-.2 0 -.1"/>
      <geom size=".05" mass="1" pos=".2 0 -.1"/>
      <geom size=".05" mass="1" pos=".2 .1 -.1"/>
    </body>
  </worldbody>
  <actuator>
    <general joint="slide" dyntype="filter" dynprm="0.05" gainprm="60"/>
    <motor joint="hinge" gear="5"/>
  </actuator>
</mujoco>
"""


def warp(model, num_envs, **kwargs):
    return WarpSimulation(model, num_envs, "cpu", **kwargs)


def controls(steps, n, nu=2, seed=0):
    return torch.rand(steps, n, nu, generator=torch.Generator().manual_seed(seed)) * 2 - 1


def run(simulation, ctrl, substeps=2):
    for u in ctrl:
        simulation.step(u, substeps)
    return simulation.save()["rows"]


def state(simulation):
    return torch.cat([simulation.qpos, simulation.qvel], dim=-1).double()


def relative(x, y):
    """Largest difference of every row, relative to the row's largest number or 1."""
    return ((x - y).abs().amax(-1) / y.abs().amax(-1).clamp(min=1.0)).max().item()
