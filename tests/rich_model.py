"""A model with nearly every kind of element that MuJoCo knows, each with its image under reflect-y."""

import mujoco

# ruff: noqa: E501 (MJCF reads better in long lines)

_SIDES = (("left", 1), ("right", -1))


def _limb(side: str, s: int) -> str:
    return f"""
    <body name="{side}_arm" pos="0 {s * 0.2} 0" gravcomp=".3">
      <joint name="{side}_hinge" axis="{s} .3 0" range="-60 40" limited="true" damping=".4" stiffness="2"
        springref="10" armature=".02" frictionloss=".1" actuatorfrcrange="-30 25" actuatorfrclimited="true"
        margin=".01" solreflimit=".03 1.1" solimplimit=".8 .9 .01" solreffriction=".03 1.1"/>
      <geom name="{side}_upper" type="capsule" fromto="0 0 0 .02 {s * 0.05} -.25" size=".03" mass=".8"
        friction="1.1 .01 .001" solref=".03 1.2" solimp=".8 .9 .01" solmix="1.2" margin=".002" gap=".001"
        fluidshape="ellipsoid" fluidcoef=".5 .25 1.5 1 1"/>
      <site name="{side}_shoulder" pos=".06 {s * 0.02} -.02" size=".01"/>
      <body name="{side}_slide" pos=".02 {s * 0.05} -.3">
        <joint name="{side}_slide" type="slide" axis=".1 {s * 0.2} 1" range="-.1 .05" limited="true" damping="3"
          stiffness="20" springref=".01" armature=".05" frictionloss=".2"/>
        <geom name="{side}_box" type="box" size=".04 .03 .05" pos="0 {s * 0.01} 0" euler="{s * 10} 20 {s * 30}"
          mass=".4" condim="4" priority="1"/>
        <site name="{side}_tip" pos="0 {s * 0.02} -.08" euler="{s * 20} 10 0" size=".02"/>
        <site name="{side}_reference" pos=".03 {s * 0.02} 0" euler="{s * 15} 5 {s * 25}"/>
        <body name="{side}_hand" pos="0 0 -.15">
          <joint name="{side}_ball" type="ball" range="0 50" limited="true" damping=".2" stiffness=".5"
            armature=".01"/>
          <geom name="{side}_hand" type="ellipsoid" size=".05 .04 .03" pos=".01 {s * 0.02} -.03" mass=".3"/>
          <geom name="{side}_finger" type="sphere" size=".03" pos=".03 {s * 0.01} -.08" mass=".1" condim="6"/>
        </body>
      </body>
    </body>
    <body name="{side}_wheel" pos="-.25 {s * 0.2} -.1">
      <joint name="{side}_wheel" axis="0 {s} 0" damping=".1" armature=".01"/>
      <geom name="{side}_wheel" type="cylinder" size=".06 .02" euler="90 0 0" mass=".5"/>
      <body name="{side}_pad" pos="0 {s * 0.08} 0">
        <joint name="{side}_pad" axis="1 0 .4" damping=".2" stiffness="1"/>
        <geom name="{side}_pad" type="box" size=".03 .02 .02" mass=".2" contype="2" conaffinity="1"/>
      </body>
    </body>"""


def _objects(side: str, s: int) -> str:
    return f"""
    <body name="{side}_target" mocap="true" pos=".4 {s * 0.4} .8"><geom name="{side}_target" size=".02"
      contype="0" conaffinity="0"/></body>
    <body name="{side}_pendulum" pos="-.6 {s * 0.5} 1.2"><joint name="{side}_pendulum" axis="1 {s * 0.5} 0" damping=".05"/>
      <geom name="{side}_bob" type="sphere" size=".04" pos=".05 {s * 0.1} -.2" mass=".3"/>
      <site name="{side}_bob" pos=".05 {s * 0.1} -.2"/></body>
    <site name="{side}_hook" pos="-.5 {s * 0.45} 1.5"/><site name="{side}_aside" pos="-.52 {s * 0.6} 1.25"/>
    <geom name="{side}_pulley" type="cylinder" size=".05 .1" pos="-.5 {s * 0.5} 1.25" euler="{s * 5} 8 0" contype="0"
      conaffinity="0"/>
    <geom name="{side}_step" type="box" size=".3 .2 .02" pos="1.2 {s * 0.5} .02" friction=".7 .01 .001"/>"""


def _tendons(side: str, s: int) -> str:
    return f"""
    <fixed name="{side}_fixed" limited="true" range="-.5 .4" stiffness="5" damping=".3" frictionloss=".05"
      springlength="-.1 .1" armature=".01" margin=".01" solreflimit=".03 1" solreffriction=".03 1">
      <joint joint="{side}_hinge" coef=".5"/><joint joint="{side}_slide" coef="2"/></fixed>
    <spatial name="{side}_spatial" limited="true" range="0 .6" stiffness="40" damping="1" springlength=".1 .25"
      frictionloss=".02"><site site="{side}_hook"/>
      <geom geom="{side}_pulley" sidesite="{side}_aside"/><site site="{side}_bob"/></spatial>
    <spatial name="{side}_pulled" stiffness="10" springlength="0"><site site="{side}_shoulder"/><site site="{side}_tip"/>
      <pulley divisor="2"/><site site="{side}_shoulder"/><site site="{side}_reference"/></spatial>"""


def _actuators(side: str, s: int) -> str:
    return f"""
    <motor name="{side}_motor" joint="{side}_hinge" gear="3" ctrlrange="-1 .8" ctrllimited="true" forcerange="-2 1.5"
      forcelimited="true"/>
    <position name="{side}_position" joint="{side}_slide" kp="30" kv="2" ctrlrange="-.1 .05" ctrllimited="true"/>
    <velocity name="{side}_velocity" joint="{side}_wheel" kv="1.5"/>
    <intvelocity name="{side}_intvelocity" joint="{side}_pad" kp="4" actrange="-.5 .5" actlimited="true"/>
    <damper name="{side}_damper" joint="{side}_slide" kv=".7" ctrlrange="0 1"/>
    <cylinder name="{side}_cylinder" joint="{side}_slide" diameter=".05" timeconst=".2" bias="-1 2 -3"/>
    <muscle name="{side}_muscle" tendon="{side}_spatial" ctrlrange="0 1" ctrllimited="true" lengthrange=".1 .6"
      force="5"/>
    <general name="{side}_general" tendon="{side}_fixed" dyntype="filterexact" dynprm=".1" gainprm="2"
      biastype="affine" biasprm=".1 -1 -.2" gear="1.5"/>
    <general name="{side}_site" site="{side}_tip" gear="1 {s * 0.5} 2 {s * 0.1} .2 {s * 0.3}" gainprm="1.2"/>
    <general name="{side}_ball" joint="{side}_ball" gear="{s * 0.2} .3 {s * 0.4}" dyntype="integrator" gainprm=".5"/>
    <adhesion name="{side}_adhesion" body="{side}_hand" ctrlrange="0 1" gain="3"/>
    <motor name="{side}_drive" joint="{side}_pendulum" gear=".4"/>"""


def _equalities(side: str, s: int) -> str:
    return f"""
    <connect name="{side}_connect" body1="{side}_pad" body2="trunk" anchor="0 {s * 0.03} .01" active="false"/>
    <weld name="{side}_weld" body1="{side}_hand" body2="{side}_target" torquescale=".7" solref=".5 1" active="true"
      relpose=".1 {s * 0.1} .1 1 {s * 0.1} .2 {s * 0.1}"/>
    <joint name="{side}_coupled" joint1="{side}_pad" joint2="{side}_wheel" polycoef="{s * 0.1} .3 {s * 0.05} .02 0" solref=".3 1"/>
    <tendon name="{side}_tied" tendon1="{side}_fixed" tendon2="{side}_pulled" polycoef=".1 .2 0 0 0" solref=".4 1"/>"""


def _contacts(side: str, s: int) -> str:
    return f"""
    <pair name="{side}_pair" geom1="{side}_hand" geom2="floor" condim="3" friction=".9 .8 .01 .001 .001"
      solref=".04 1" margin=".01"/>
    <exclude name="{side}_exclude" body1="{side}_arm" body2="{side}_wheel"/>"""


def _sensors(side: str, s: int) -> str:
    return f"""
    <jointpos joint="{side}_hinge"/><accelerometer site="{side}_tip"/><touch site="{side}_tip"/>
    <tendonpos tendon="{side}_fixed"/><actuatorfrc actuator="{side}_motor"/>
    <rangefinder site="{side}_reference"/>"""


def rich_model() -> mujoco.MjModel:
    """Compile it; exactly symmetric under reflect-y, with elliptic cones and the Newton solver."""
    parts = {
        what: "".join(make(side, s) for side, s in _SIDES)
        for what, make in (
            ("limbs", _limb),
            ("objects", _objects),
            ("tendons", _tendons),
            ("actuators", _actuators),
            ("equalities", _equalities),
            ("contacts", _contacts),
            ("sensors", _sensors),
        )
    }
    return mujoco.MjModel.from_xml_string(f"""<mujoco>
    <option cone="elliptic" solver="Newton" density="1.2" viscosity=".002" wind=".5 0 .1" timestep=".002"/>
    <worldbody><geom name="floor" type="plane" size="5 5 .1"/>
      <body name="trunk" pos="0 0 .55"><freejoint name="root"/>
        <geom name="trunk" type="box" size=".3 .15 .06" mass="4"/>{parts["limbs"]}
        <body name="head" pos=".25 0 .15"><joint name="nod" axis="0 1 0" range="-40 30" limited="true" damping=".3"/>
          <geom name="head" type="sphere" size=".08" mass=".7"/></body></body>{parts["objects"]}
    </worldbody>
    <tendon>{parts["tendons"]}</tendon><actuator>{parts["actuators"]}</actuator>
    <equality>{parts["equalities"]}</equality><contact>{parts["contacts"]}</contact>
    <sensor>{parts["sensors"]}</sensor></mujoco>""")
