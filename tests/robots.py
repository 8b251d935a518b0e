"""Robots for the tests of torchrl_sym.mujoco: trees of limbs, written as MJCF with any body frames.

A limb is given in axes parallel to the world's at the reference pose. `model` expresses it in whatever body
frames it is asked for, so that a test can turn the frames, shuffle siblings and rename joints without
changing the robot.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import mujoco
import numpy as np

WORLD = np.eye(3)


@dataclass(frozen=True)
class Limb:
    """A body with at most one joint; vectors in world axes, relative to the parent's origin or its own."""

    name: str
    pos: np.ndarray
    joint: str | None = None  # hinge, slide, ball, free
    axis: np.ndarray = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    mass: float = 1.0
    com: np.ndarray = field(default_factory=lambda: np.zeros(3))
    inertia: np.ndarray = field(default_factory=lambda: 0.01 * np.eye(3))
    foot: np.ndarray | None = None  # centre of a contact sphere of radius 0.03
    range: tuple[float, float] | None = None
    children: tuple[Limb, ...] = ()

    def map(self, change: Callable[[Limb], Limb]) -> Limb:
        """Apply a change to this limb and everything on it."""
        return replace(change(self), children=tuple(child.map(change) for child in self.children))

    def image(self, matrix: np.ndarray, rename: Callable[[str], str], sign: float = 1.0) -> Limb:
        """The mirrored or turned limb; hinge axes may be written either way round (sign)."""

        def move(limb: Limb) -> Limb:
            return replace(
                limb,
                name=rename(limb.name),
                pos=matrix @ limb.pos,
                axis=sign * matrix @ limb.axis,
                com=matrix @ limb.com,
                inertia=matrix @ limb.inertia @ matrix.T,
                foot=None if limb.foot is None else matrix @ limb.foot,
            )

        return self.map(move)


def turn(degrees: float) -> np.ndarray:
    """Rotation about the vertical."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    q = rng.standard_normal(4)
    out = np.zeros(9)
    mujoco.mju_quat2Mat(out, q / np.linalg.norm(q))
    return out.reshape(3, 3)


def model(*limbs: Limb, **options) -> mujoco.MjModel:
    """Compile what :func:`mjcf` writes."""
    return mujoco.MjModel.from_xml_string(mjcf(*limbs, **options))


def mjcf(
    *limbs: Limb,
    frames: np.random.Generator | None = None,
    actuated: bool = True,
    floor: bool = True,
    cone: str = "elliptic",
    objects: str = "",
    more: str = "",
) -> str:
    """Limbs that hang on the world; ``frames`` draws a random frame for every body.

    MJCF of ``objects`` goes beside them into the world, that of ``more`` beside the world.
    """
    joints = []

    def write(limb: Limb, parent: np.ndarray) -> str:
        own = WORLD if frames is None else random_rotation(frames)
        quat = np.zeros(4)
        mujoco.mju_mat2Quat(quat, (parent.T @ own).flatten())
        # principal moments and axes: the compiler of MuJoCo 3.11 finds them in a full inertia to 1e-7 only
        moments, axes = np.linalg.eigh(limb.inertia)
        axes[:, 0] *= np.linalg.det(axes)
        turn = np.zeros(4)
        mujoco.mju_mat2Quat(turn, (own.T @ axes).flatten())
        parts = [
            f'<inertial pos="{text(own.T @ limb.com)}" mass="{limb.mass!r}" '
            f'quat="{text(turn)}" diaginertia="{text(moments)}"/>'
        ]
        if limb.joint is not None:
            limits = f' range="{text(np.degrees(limb.range))}"' if limb.range else ""
            axis = f' axis="{text(own.T @ limb.axis)}"{limits}' if limb.joint in ("hinge", "slide") else ""
            parts.append(f'<joint name="{limb.name}" type="{limb.joint}"{axis}/>')
            if limb.joint in ("hinge", "slide"):
                joints.append(limb.name)
        if limb.foot is not None:
            parts.append(f'<geom type="sphere" size="0.03" pos="{text(own.T @ limb.foot)}"/>')
        parts += [write(child, own) for child in limb.children]
        place = f'pos="{text(parent.T @ limb.pos)}" quat="{text(quat)}"'
        return f'<body name="{limb.name}" {place}>{"".join(parts)}</body>'

    bodies = "".join(write(limb, WORLD) for limb in limbs)
    plane = '<geom type="plane" size="5 5 0.1"/>' if floor else ""
    motors = (
        "".join(f'<position name="{j}" joint="{j}" kp="80" kv="2"/>' for j in joints) if actuated else ""
    )
    return f"""<mujoco><option cone="{cone}" integrator="implicitfast" timestep="0.005"/>
        <worldbody>{plane}{bodies}{objects}</worldbody><actuator>{motors}</actuator>{more}</mujoco>"""


def text(values) -> str:
    return " ".join(repr(float(v)) for v in values)


def anymal(order: tuple[str, ...] = ("LF", "RF", "LH", "RH")) -> Limb:
    """ANYmal-C with symmetrised inertias and base-aligned joint axes (HAA +x, HFE and KFE +y)."""
    legs = []
    for leg in order:
        sx, sy = (1 if leg[1] == "F" else -1), (1 if leg[0] == "L" else -1)
        mirror = np.array([sx, sy, 1.0])
        x, y = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
        shank_inertia = np.array([[8.81e-3, 0, sx * 1.82e-3], [0, 1.016e-2, 0], [sx * 1.82e-3, 0, 1.55e-3]])
        shank = Limb(
            f"{leg}_KFE",
            mirror * (0.0, 0.1003, -0.285),
            "hinge",
            y,
            0.58842,
            mirror * (0.0613, 0.0055, -0.0807),
            shank_inertia,
            mirror * (0.08795, 0.01305, -0.31547),
        )
        thigh = Limb(
            f"{leg}_HFE",
            mirror * (0.0599, 0.08381, 0.0),
            "hinge",
            y,
            3.071,
            mirror * (0.0, 0.0308, -0.2457),
            np.diag([0.0299, 0.0296, 0.0049]),
            children=(shank,),
        )
        limits = (-0.72, 0.49) if sy > 0 else (-0.49, 0.72)
        hip = Limb(
            f"{leg}_HAA",
            mirror * (0.2999, 0.104, 0.0),
            "hinge",
            x,
            2.781,
            mirror * (0.0567, 0.0174, 0.0),
            np.diag([0.0033, 0.0049, 0.0058]),
            range=limits,
            children=(thigh,),
        )
        legs.append(hip)
    inertia = np.diag([0.2167, 1.7852, 1.8337])
    com = np.array([0.0, 0.0, 0.0085])
    return Limb(
        "base", np.array([0.0, 0.0, 0.62]), "free", WORLD[2], 26.373, com, inertia, children=tuple(legs)
    )


def trifinger() -> tuple[Limb, ...]:
    """The three fingers of a TriFinger Pro at yaw 0, -120 and -240 degrees, hanging on the world."""
    x, y = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
    lower = Limb(
        "2", np.array([0.05015, 0.0, -0.16]), "hinge", x, 0.08669, np.array([0.01728, 0.0, -0.08474]),
        np.diag([4.101e-4, 4.077e-4, 7.33e-6]), np.array([0.019, 0.0, -0.16]), (-2.7, 0.0),
    )  # fmt: skip
    middle = Limb(
        "1", np.array([0.01685, 0.0505, 0.0]), "hinge", x, 0.27163, np.array([0.03935, -0.00012, -0.08667]),
        np.diag([9.406e-4, 9.482e-4, 7.573e-5]), None, (0.0, 1.57), (lower,),
    )  # fmt: skip
    upper = Limb(
        "0", np.array([0.0, 0.0, 0.29]), "hinge", y, 0.26689, np.array([0.006, 0.122, 0.0]),
        np.diag([1.02362e-3, 6.45e-5, 1.02225e-3]), None, (-0.33, 1.0), (middle,),
    )  # fmt: skip
    return tuple(upper.image(turn(-120 * k), lambda name, k=k: f"finger{120 * k}_{name}") for k in range(3))
