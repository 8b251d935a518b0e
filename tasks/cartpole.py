"""CartPole swing-up: the smallest task on which a symmetric policy is worth something.

A cart on an endless rail carries a pole that starts lying flat, to the right or to the left, and
has to be swung up and held. Mirroring left and right (x -> -x) maps one start onto the other, so
both are equally hard; plain PPO nevertheless often learns one side only. The paper's Table I
measures this by the difference between the returns of the two starts.

The angle is wrapped by theta - 2 pi round(theta / 2 pi), which is an odd function in floating-point
arithmetic too: wrapping commutes with the reflection exactly. The price is the closed interval
[-pi, pi] instead of the paper's half-open one, which no reflection can preserve: a pole hanging at
exactly theta = pi keeps its sign, and its mirror image is observed at -pi. That state has
probability zero.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from tasks.base import Task, register
from tasks.draws import draws
from tasks.observation import Entry
from tasks.state import State
from torchrl_sym import PointGroup, checks

# Desired cart velocity at full action, m/s. The paper gives no limit.
MAX_CART_VELOCITY = 3.0
# What the observation is divided by, so that its entries are about 1: the velocities of cart (m/s)
# and pole (rad/s), and the pole's angle (rad).
CART_RANGE, POLE_RANGE, ANGLE_RANGE = 3.0, 10.0, math.pi
# The pole starts flat: angle from upright, rad.
START_ANGLE = math.pi / 2
# Half-width of the uniform noise on the start angle (rad) and on both velocities (m/s, rad/s).
START_NOISE = 0.1
# Density of the air that a wind moves, kg/m^3; without wind there is none, and no drag.
AIR_DENSITY = 1.2


@register
class CartPole(Task):
    """Swing up a pole that starts flat on either side, by commanding the cart's velocity.

    State: cart position x [m] and pole angle theta [rad] from upright, positive to the right (+x).
    Group: C2, the reflection x -> -x, which flips the sign of everything. Reward per step:
    ``-|theta| dt``, the L1 distance from upright integrated over time [rad s].

    Args:
        episode_seconds: length of an episode, s; None for 4 s.
        motor_bias: velocity of the cart that is added to every command, m/s, for studies of asymmetry: the
            task is no longer symmetric, though its observations and actions still transform as declared.
        rail_tilt: by which the rail falls towards +x, degrees, for such studies.
        wind: velocity of the air towards +x, m/s, for such studies; it has drag then.

    Example:
        >>> import torch
        >>> task = CartPole()
        >>> start = task.sample_goal_state(2, torch.Generator().manual_seed(0))
        >>> mirrored = task.transform_state(start, "reflect-x")
        >>> bool((task.observe(mirrored) == -task.observe(start)).all())
        True
    """

    name = "cartpole"
    asset = "cartpole.xml"
    control_timestep = 0.02
    episode_seconds = 4.0
    goal_names = ("right", "left")
    task_terms = ("angle",)

    def __init__(
        self,
        *,
        episode_seconds: float | None = None,
        motor_bias: float = 0.0,
        rail_tilt: float = 0.0,
        wind: float = 0.0,
    ) -> None:
        self.motor_bias = checks.real("motor_bias", motor_bias, -MAX_CART_VELOCITY, MAX_CART_VELOCITY)
        slope = math.radians(checks.real("rail_tilt", rail_tilt, -45.0, 45.0))
        wind = checks.real("wind", wind, -50.0, 50.0)
        super().__init__(PointGroup.reflection("x"), episode_seconds=episode_seconds)

        # asymmetries come after the symmetry has been derived, from the model that designers have in mind
        option = self.model.opt
        if slope:
            weight = -option.gravity[2]
            option.gravity[:] = weight * math.sin(slope), 0.0, -weight * math.cos(slope)
        if wind:
            option.wind[:], option.density = (wind, 0.0, 0.0), AIR_DENSITY

    def layout(self) -> tuple[Entry, ...]:
        """Cart velocity, pole angle, pole velocity.

        The cart's position is left out: the rail has no end, so nothing depends on it.
        """
        cart, pole = (self.robot.joints([name]) for name in ("slide", "hinge"))
        joint = "sign of its joint"
        return (
            Entry(
                "cart velocity", lambda state: state.qvel[:, :1],
                cart, "m/s", "world", joint, divisor=CART_RANGE,
            ),
            Entry(
                "pole angle from upright", lambda state: _angle(state)[:, None],
                pole, "rad", "world", joint, divisor=ANGLE_RANGE,
            ),
            Entry(
                "pole velocity", lambda state: state.qvel[:, 1:],
                pole, "rad/s", "world", joint, divisor=POLE_RANGE,
            ),
        )  # fmt: skip

    def sample_goal_state(self, n: int, generator: torch.Generator | None) -> State:
        """The pole lies flat to the right; noise on its angle and on both velocities."""
        noise = draws(n, 3, generator) * 2 - 1
        noise *= START_NOISE
        qpos = noise.new_zeros(len(noise), 2)
        qpos[:, 1] = START_ANGLE + noise[:, 0]
        return State(qpos=qpos, qvel=noise[:, 1:])

    def control(self, action: Tensor, state: State) -> Tensor:
        """Desired cart velocity, m/s."""
        return action.clamp(-1.0, 1.0).mul_(MAX_CART_VELOCITY).add_(self.motor_bias)

    def reward_terms(self, state: State, action: Tensor) -> dict[str, Tensor]:
        """Minus the pole's distance from upright, over the time of the step, rad s."""
        return {"angle": _angle(state).abs().mul_(-self.control_timestep)}


def _angle(state: State) -> Tensor:
    """Pole angle from upright, in [-pi, pi], ``(n,)``, rad."""
    return state.shared("angle", lambda: _wrap(state.qpos[:, 1]))


def _wrap(angle: Tensor) -> Tensor:
    """Same angle in [-pi, pi]; an odd function in floating-point arithmetic too (see above)."""
    turns = (angle * (0.5 / math.pi)).round_()
    return angle.sub(turns, alpha=2 * math.pi)
