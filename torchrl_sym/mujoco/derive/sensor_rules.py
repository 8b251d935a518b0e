"""Images of sensors: which sensor measures the mirror image of what another one measures, and how.

With R the isometry, d its determinant and X_o the world rotation of object o at the reference pose, a
reading in the frame of o becomes one in the frame of its image o' by V = X_o'^T R X_o (V = R in the world
frame). Polar vectors (velocities, forces, displacements) become V v, axial ones (angular velocity, torque,
angular momentum) d V w, scalars stay, joint-like readings take the sign of their joint. The direction of a
local axis e_m is polar, if the image measures e_k with V e_m = +-e_k. A quaternion of o relative to r
becomes q_r q q_o^-1 with lifts q_o = x_o'^-1 q_R x_o, in which the unknown sign of q_R cancels.
"""

from __future__ import annotations

from torchrl_sym.mujoco.model.types import mj

TYPES = {int(value): name.removeprefix("mjSENS_") for name, value in mj.mjtSensor.__members__.items()}
OBJECTS = {int(value): name.removeprefix("mjOBJ_") for name, value in mj.mjtObj.__members__.items()}


# What an image must have in common with a sensor, how the reading transforms, and the types it is true of.
RULES = {
    kind: (where, measures)
    for where, measures, kinds in (
        ("place", "polar", "ACCELEROMETER VELOCIMETER"),
        ("link", "axial", "GYRO"),
        ("body link", "polar", "FORCE"),
        ("body place", "axial", "TORQUE"),
        ("body volume", "scalar", "TOUCH"),
        ("body place", "ray", "RANGEFINDER"),
        ("link", "magnetic", "MAGNETOMETER"),
        ("place", "scalar", "INSIDESITE"),
        ("joint", "signed", "JOINTPOS JOINTVEL JOINTACTFRC"),
        ("joint", "scalar", "JOINTLIMITPOS JOINTLIMITVEL JOINTLIMITFRC"),
        ("joint", "ball", "BALLQUAT BALLANGVEL"),
        ("tendon", "signed", "TENDONPOS TENDONVEL TENDONACTFRC"),
        ("tendon", "scalar", "TENDONLIMITPOS TENDONLIMITVEL TENDONLIMITFRC"),
        ("actuator", "signed", "ACTUATORPOS ACTUATORVEL ACTUATORFRC"),
        ("place", "world polar", "FRAMEPOS FRAMELINVEL FRAMELINACC"),
        ("link", "world axial", "FRAMEANGVEL FRAMEANGACC"),
        ("link", "axis", "FRAMEXAXIS FRAMEYAXIS FRAMEZAXIS"),
        ("link", "quaternion", "FRAMEQUAT"),
        ("body", "world polar", "SUBTREECOM SUBTREELINVEL"),
        ("body", "world axial", "SUBTREEANGMOM"),
        ("contact", "contact", "CONTACT"),
        ("pair", "pair", "GEOMDIST GEOMNORMAL GEOMFROMTO"),
        ("model", "scalar", "CLOCK E_POTENTIAL E_KINETIC"),
    )
    for kind in kinds.split()
}
UNSUPPORTED = {
    "USER": "its reading comes from a callback, which cannot be looked into",
    "PLUGIN": "its reading comes from a plugin, which cannot be looked into",
    "CAMPROJECTION": "pixel coordinates are not linear in the image's ones",
    "TACTILE": "the vertices of its mesh are not matched",
}
AXES = ("FRAMEXAXIS", "FRAMEYAXIS", "FRAMEZAXIS")
RAY_FIELDS = (1, 3, 3, 3, 3, 1)  # dist; dir, origin, point, normal in the world frame; depth
POSES = {
    "XBODY": ("xpos", "xmat"),
    "BODY": ("xipos", "ximat"),
    "GEOM": ("geom_xpos", "geom_xmat"),
    "SITE": ("site_xpos", "site_xmat"),
    "CAMERA": ("cam_xpos", "cam_xmat"),
}
