"""Small robots of our own, one for every kind of model in the catalogue, with what is expected of each."""

from catalogue.expectations import Expectation

FLOOR = '<geom name="floor" type="plane" size="5 5 .1"/>'
SIDES = {"left": 1, "right": -1}


def mjcf(world: str, rest: str = "") -> str:
    return f"""<mujoco><compiler autolimits="true" angle="radian"/>
      <worldbody>{FLOOR}{world}</worldbody>{rest}</mujoco>"""


def capsule(end: str, radius: float, mass: float) -> str:
    return f'<geom type="capsule" fromto="0 0 0 {end}" size="{radius}" mass="{mass}"/>'


def leg(name: str, x: float, y: float, knee: str, mass: float = 0.5) -> str:
    return f"""
      <body name="{name}_hip" pos="{x} {y} 0"><joint name="{name}_hip" axis="1 0 0" range="-.8 .8"/>
        {capsule(f"0 {y / 5} 0", 0.03, 0.6)}
        <body name="{name}_shank" pos="0 {y / 5} 0"><joint name="{name}_knee" axis="0 1 0" range="{knee}"/>
          {capsule("0 0 -.3", 0.02, mass)}</body></body>"""


def quadruped(hind: str, mass: float = 0.5, knee: str = "-2.7 -.9") -> str:
    """Four legs; the range of the hind knees, and what differs at the right front one."""
    legs = leg("FL", 0.2, 0.1, "-2.7 -.9") + leg("FR", 0.2, -0.1, knee, mass)
    legs += leg("RL", -0.2, 0.1, hind) + leg("RR", -0.2, -0.1, hind)
    base = '<body name="base" pos="0 0 .35"><freejoint/><geom type="box" size=".25 .1 .05" mass="5"/>'
    motors = "".join(
        f'<position name="{side}_{part}" joint="{side}_{part}" kp="20" inheritrange="1"/>'
        for side in ("FL", "FR", "RL", "RR")
        for part in ("hip", "knee")
    )
    return mjcf(f"{base}{legs}</body>", f"<actuator>{motors}</actuator>")


def humanoid(parked: str = "") -> str:
    """Hips with mirrored axes, shoulders with equal ones; and what is parked far away."""
    limbs = ""
    for name, sign in SIDES.items():
        roll, pitch = ("-.3 1.2", "-1.5 .5") if sign > 0 else ("-1.2 .3", "-.5 1.5")
        limbs += f"""
          <body name="{name}_thigh" pos="0 {sign * 0.1} -.2">
            <joint name="{name}_hip_roll" axis="1 0 0" range="{roll}"/>
            <joint name="{name}_hip_pitch" axis="0 {sign} 0" range="{pitch}"/>
            {capsule("0 0 -.4", 0.05, 4)}</body>
          <body name="{name}_arm" pos="0 {sign * 0.2} .2">
            <joint name="{name}_shoulder" axis="0 1 0" range="-3 1"/>{capsule("0 0 -.3", 0.03, 1)}</body>"""
    return mjcf(f"""
      <body name="torso" pos="0 0 .7"><freejoint/><geom type="box" size=".1 .15 .25" mass="20"/>{limbs}
        <body name="head" pos="0 0 .3"><joint name="neck" axis="0 0 1" range="-1 1"/>
          <geom size=".1" mass="3"/></body></body>{parked}""")


def dummy(name: str) -> str:
    """A joint that a variant of a robot lacks, parked where it disturbs nothing."""
    return f"""<body name="{name}" pos="0 0 20"><joint name="{name}"/>
      <inertial pos="0 0 0" mass=".001" diaginertia="1e-3 1e-3 1e-3"/></body>"""


def gripper(opening: float) -> str:
    """An arm in its own plane; one finger is driven, an equality moves the other one."""
    fingers = "".join(
        f"""<body name="{name}_finger" pos="0 {sign * opening} .1">
              <joint name="{name}_finger" type="slide" axis="0 {sign} 0" range="0 .04" damping="1"/>
              <geom type="box" size=".01 .005 .03" pos="0 {sign * 0.01} 0" mass=".1"/></body>"""
        for name, sign in SIDES.items()
    )
    world = f"""
      <body name="arm" pos="0 0 .3"><joint name="pan" axis="0 0 1" range="-2 2"/>
        {capsule(".3 0 0", 0.03, 2)}
        <body name="hand" pos=".3 0 0"><joint name="tilt" axis="0 1 0" range="-1 1"/>
          <geom type="box" size=".02 .05 .03" mass=".5"/>{fingers}</body></body>"""
    rest = """
      <equality><joint joint1="left_finger" joint2="right_finger"/></equality>
      <actuator><motor name="pan" joint="pan" ctrlrange="-1 1"/>
        <position name="grip" joint="left_finger" kp="100"/></actuator>"""
    return mjcf(world, rest)


def two_arms(plane: float) -> str:
    """Two arms left and right of a plane that may not pass through the origin; a cube anywhere."""
    arms = "".join(
        f"""<body name="{name}/arm" pos="0 {plane + sign * 0.3} .2">
              <joint name="{name}/arm" axis="1 0 0" range="-1 1"/>{capsule(f".05 {-sign * 0.2} 0", 0.02, 1)}
            </body>"""
        for name, sign in SIDES.items()
    )
    cube = '<body name="cube" pos=".1 .2 .03"><freejoint/><geom type="box" size=".03 .03 .03"/></body>'
    return mjcf(arms + cube)


def drone(aside: float = 0.0) -> str:
    """Four rotors, two of them turning the other way; a payload, in the middle or aside."""
    corners = {"fl": (1, 1), "fr": (1, -1), "rl": (-1, 1), "rr": (-1, -1)}
    sites = "".join(f'<site name="{c}" pos="{0.1 * x} {0.15 * y} 0"/>' for c, (x, y) in corners.items())
    motors = "".join(
        f'<motor name="{c}" site="{c}" gear="0 0 1 0 0 {0.02 * x * y}" ctrlrange="0 5"/>'
        for c, (x, y) in corners.items()
    )
    frame = f"""
      <body name="frame" pos="0 0 1"><freejoint/><geom type="box" size=".1 .15 .02" mass="1"/>
        <geom type="sphere" size=".03" pos="0 {aside} .05" mass=".2"/>{sites}</body>"""
    return mjcf(frame, f"<actuator>{motors}</actuator>")


def hand() -> str:
    """Three chiral fingers, each the last one turned by 120 degrees: turns, and no mirror."""
    fingers = "".join(
        f"""<body euler="0 0 {i * 2.0943951023931953}"><body name="F{i}" pos=".1 0 0">
              <joint name="F{i}" axis="0 1 0" range="-.3 1"/>
              {capsule(".02 .05 .1", 0.01, 0.2)}</body></body>"""
        for i in range(3)
    )
    return mjcf(f'<body name="palm" pos="0 0 .5">{fingers}</body>')


def expect(
    sides: list[tuple[str, str]] | None = None, mirror: str = "reflect-y", **has: str
) -> Expectation:
    named = {element.replace("_", "-"): verdict for element, verdict in has.items()}
    return Expectation(("*",), "Tests", named, tuple(sides or ()), mirror)


FEET = [("FL", "FR"), ("RL", "RR")]
ROTORS = [("fl", "fr"), ("rl", "rr")]
LEFT = [("left", "right")]
BACKWARDS = "-2.7 -.9"
MODELS = {
    "knees all backwards": (quadruped(BACKWARDS), expect(FEET, reflect_y="exact")),
    "knees towards each other": (
        quadruped(".9 2.7"),
        expect(FEET, reflect_y="exact", reflect_x="exact", rot_180="exact"),
    ),
    "one shank is 4 % heavier": (quadruped(BACKWARDS, mass=0.52), expect(FEET, reflect_y="approximate")),
    "one knee opens farther": (
        quadruped(BACKWARDS, knee="-2.7 -.85"),
        expect(FEET, reflect_y="approximate"),
    ),
    "one knee bends the other way": (quadruped(BACKWARDS, knee=".9 2.7"), expect(FEET)),
    "humanoid": (humanoid(), expect(LEFT, reflect_y="exact")),
    "humanoid with parked dummies": (
        humanoid(dummy("right_wrist") + dummy("left_wrist")),
        expect(LEFT, reflect_y="exact"),
    ),
    "gripper, one finger driven": (gripper(0.03), expect(LEFT, reflect_y="exact|approximate")),
    "gripper, closed": (gripper(0.0), expect(LEFT, reflect_y="exact|approximate")),
    "two arms": (two_arms(0.0), expect(LEFT, reflect_y="exact")),
    "two arms about y = 0.5": (two_arms(0.5), expect(LEFT, reflect_y="exact")),
    "drone": (drone(), expect(ROTORS, reflect_x="exact", reflect_y="exact", rot_180="exact")),
    "drone with a payload aside": (drone(0.1), expect(ROTORS, reflect_x="exact")),
    "three fingers": (hand(), expect(rot_120="exact")),
}
