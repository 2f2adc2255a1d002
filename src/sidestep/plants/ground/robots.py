"""MuJoCo models of the robots: bodies, wheels, rollers and motors as MJCF, from the scenario's numbers.

They are laboratory robots of 2 to 4 kg. Only wheels, rollers and casters have contacts, and only with the
floor: capture and collision are distances between centres, as in the scenario. Contacts between bodies cannot
replace them: with the paper's numbers the pursuer's wheels are at the edge of its capture disc, which leaves
no room for an evader beside the axle.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from sidestep.plants.drawing import mjcf_colour, studio

BASES = ("servo", "omniwheels")
"""Kinds of evader: `servo` planar joints with velocity servos; `omniwheels` three wheels with rollers."""

EVADER_RADIUS, EVADER_MASS, YAW_INERTIA = 0.07, 2.5, 0.008
"""m, kg, kg m^2."""
WHEEL_RADIUS = 0.05
"""Radius of the pursuer's driven wheels, m."""
OMNIWHEEL_RADIUS, OMNIWHEEL_ARM = 0.04, 0.085
"""Radius of an omniwheel and its distance from the evader's centre, m."""
OMNIWHEEL_ROLLING = 0.9863
"""Driven distance over nominal distance of the wheels, less than 1 because rollers slip and loaded motors
droop. Calibrates the base; measured by driving straight at full speed."""
OMNIWHEEL_ANGLES = tuple(math.radians(angle) for angle in (60.0, 180.0, 300.0))
"""Directions of the omniwheels' axles from the evader's centre, rad from its x axis."""
_ROLLERS = 10
_ROLLER_RADIUS = 0.008
_CHASSIS_MASS, _WHEEL_MASS, _CASTER_RADIUS = 3.0, 0.15, 0.015
_MOTOR_ARMATURE = 0.001
_PURSUER_ACCELERATION = 4.0


def pursuer_body(index: int, half_axle: float, colour: str) -> str:
    """A differential drive: chassis, two driven wheels 2b apart, a ball caster in front and one behind.

    A wheel touches the floor at one point on its centre line, so the track is exactly 2b.
    """
    length, width = max(0.75 * half_axle, 0.05), max(half_axle - 0.025, 0.02)
    caster = 0.8 * length
    parts = []
    for side, y in (("left", half_axle), ("right", -half_axle)):
        name = f"pursuer{index}_{side}"
        parts.append(f"""
      <body name="{name}" pos="0 {y} 0">
        <joint name="{name}" type="hinge" axis="0 1 0" armature="{_MOTOR_ARMATURE}"/>
        <geom class="rolling" type="ellipsoid" size="{WHEEL_RADIUS} {WHEEL_RADIUS} 0.012" quat="1 1 0 0"
              mass="{_WHEEL_MASS}"/>
        <geom class="shown" type="cylinder" size="{WHEEL_RADIUS} 0.011" quat="1 1 0 0"
              rgba="0.13 0.13 0.13 1"/>
        <geom class="shown" type="box" size="0.038 0.0115 0.006" rgba="0.75 0.75 0.75 1"/>
      </body>""")
    for x in (caster, -caster):
        parts.append(f"""
      <geom class="gliding" type="sphere" size="{_CASTER_RADIUS}"
            pos="{x} 0 {_CASTER_RADIUS - WHEEL_RADIUS}"/>""")
    return f"""
    <body name="pursuer{index}" pos="0 0 {WHEEL_RADIUS}">
      <freejoint name="pursuer{index}"/>
      <geom class="shown" type="box" size="{length} {width} 0.025" pos="0 0 0.008" mass="{_CHASSIS_MASS}"
            rgba="{mjcf_colour(colour)}"/>
      <geom class="shown" type="box" size="{0.16 * length} {0.6 * width} 0.008" pos="{0.75 * length} 0 0.036"
            rgba="0.95 0.95 0.95 1"/>
      <geom class="shown" type="cylinder" size="{0.3 * width} 0.012" pos="0 0 0.042"
            rgba="0.2 0.2 0.2 1"/>{"".join(parts)}
    </body>"""


def pursuer_motors(index: int, lag: float) -> str:
    """Velocity servos of the wheels; `lag` (s) is the robot's time constant."""
    load = (0.5 * _CHASSIS_MASS + 1.5 * _WHEEL_MASS) * WHEEL_RADIUS**2 + _MOTOR_ARMATURE
    torque = _PURSUER_ACCELERATION * load / WHEEL_RADIUS
    return "".join(
        f"""
    <velocity name="pursuer{index}_{side}" joint="pursuer{index}_{side}" kv="{load / lag}"
              forcerange="{-torque} {torque}"/>"""
        for side in ("left", "right")
    )


def evader_body(base: str, colour: str) -> str:
    """The omnidirectional evader on planar joints or on omniwheels, see `BASES`."""
    top = f"""
      <geom class="shown" type="cylinder" size="{EVADER_RADIUS} 0.03" pos="0 0 {{deck}}"
            rgba="{mjcf_colour(colour)}"/>
      <geom class="shown" type="cylinder" size="{0.7 * EVADER_RADIUS} 0.006" pos="0 0 {{lid}}"
            rgba="0.95 0.95 0.95 1"/>
      <geom class="shown" type="box" size="0.018 0.005 0.007" pos="{0.5 * EVADER_RADIUS} 0 {{lid}}"
            rgba="0.13 0.13 0.13 1"/>"""
    if base == "servo":
        return f"""
    <body name="evader">
      <inertial pos="0 0 0.05" mass="{EVADER_MASS}" diaginertia="0.005 0.005 {YAW_INERTIA}"/>
      <joint name="evader_x" type="slide" axis="1 0 0"/>
      <joint name="evader_y" type="slide" axis="0 1 0"/>
      <joint name="evader_yaw" type="hinge" axis="0 0 1"/>{top.format(deck=0.045, lid=0.08)}
    </body>"""
    wheels = "".join(_omniwheel(index, angle) for index, angle in enumerate(OMNIWHEEL_ANGLES))
    return f"""
    <body name="evader" pos="0 0 {OMNIWHEEL_RADIUS}">
      <freejoint name="evader"/>
      <inertial pos="0 0 0.0" mass="{EVADER_MASS - 0.6}" diaginertia="0.005 0.005 {YAW_INERTIA}"/>\
{top.format(deck=0.06, lid=0.095)}{wheels}
    </body>"""


def _omniwheel(index: int, angle: float) -> str:
    """A wheel whose rim is made of passive barrel-shaped rollers, free to turn about the rim's tangent.

    An ellipsoid with half axes sqrt(c R) and c has the wheel's curvature 1/R at its outermost point.
    """
    radius, thin = OMNIWHEEL_RADIUS, _ROLLER_RADIUS
    barrel = math.sqrt(thin * radius)
    rollers = []
    for number in range(_ROLLERS):
        turn = 2.0 * math.pi * number / _ROLLERS
        y, z = (radius - thin) * math.cos(turn), (radius - thin) * math.sin(turn)
        half = turn / 2.0
        rollers.append(f"""
        <body pos="0 {y} {z}" quat="{math.cos(half)} {math.sin(half)} 0 0">
          <joint type="hinge" axis="0 0 1" armature="2e-6" damping="2e-6"/>
          <geom class="rolling" type="ellipsoid" size="{thin} {thin} {barrel}" mass="0.008"
                rgba="0.35 0.35 0.35 1"/>
        </body>""")
    x, y = OMNIWHEEL_ARM * math.cos(angle), OMNIWHEEL_ARM * math.sin(angle)
    return f"""
      <body name="evader_wheel{index}" pos="{x} {y} 0" quat="{math.cos(angle / 2)} 0 0 {math.sin(angle / 2)}">
        <joint name="evader_wheel{index}" type="hinge" axis="1 0 0" armature="{_MOTOR_ARMATURE}"/>
        <geom class="shown" type="cylinder" size="{radius - 2 * thin} 0.006" quat="1 0 1 0" mass="0.12"
              rgba="0.75 0.75 0.75 1"/>{"".join(rollers)}
      </body>"""


def evader_motors(base: str, lag: float, acceleration: float) -> str:
    """Velocity servos with force limits. `lag` (s) is their time constant; `acceleration` (m/s^2) the limit
    along each axis (`servo`), or in the direction of least wheel force (`omniwheels`)."""
    if base == "servo":
        gain, force = EVADER_MASS / lag, EVADER_MASS * acceleration
        turn, torque = YAW_INERTIA / lag, YAW_INERTIA * acceleration / EVADER_RADIUS
        return f"""
    <velocity name="evader_x" joint="evader_x" kv="{gain}" forcerange="{-force} {force}"/>
    <velocity name="evader_y" joint="evader_y" kv="{gain}" forcerange="{-force} {force}"/>
    <velocity name="evader_yaw" joint="evader_yaw" kv="{turn}" forcerange="{-torque} {torque}"/>"""
    # Three wheels at 120 degrees apply 3/2 of one wheel's force to the mass.
    load = EVADER_MASS / 1.5 * OMNIWHEEL_RADIUS**2 + _MOTOR_ARMATURE
    torque = acceleration * load / OMNIWHEEL_RADIUS * 1.5 / math.sqrt(3.0)
    return "".join(
        f"""
    <velocity name="evader_wheel{index}" joint="evader_wheel{index}" kv="{load / lag}"
              forcerange="{-torque} {torque}"/>"""
        for index in range(len(OMNIWHEEL_ANGLES))
    )


def obstacle_body(index: int, colour: str) -> str:
    """A post on planar joints that drifts at the commanded velocity."""
    return f"""
    <body name="obstacle{index}">
      <inertial pos="0 0 0.06" mass="2" diaginertia="0.01 0.01 0.01"/>
      <joint name="obstacle{index}_x" type="slide" axis="1 0 0"/>
      <joint name="obstacle{index}_y" type="slide" axis="0 1 0"/>
      <geom class="shown" type="cylinder" size="0.06 0.06" pos="0 0 0.06" rgba="{mjcf_colour(colour)}"/>
      <geom class="shown" type="cylinder" size="0.061 0.008" pos="0 0 0.095" rgba="0.93 0.93 0.93 1"/>
    </body>"""


def obstacle_motors(index: int) -> str:
    """Velocity servos that hold the obstacle's drift."""
    return "".join(
        f"""
    <velocity name="obstacle{index}_{axis}" joint="obstacle{index}_{axis}" kv="100"/>"""
        for axis in "xy"
    )


def scene_xml(
    base: str,
    half_axle: float,
    pursuers: int,
    obstacles: int,
    *,
    physics_step: float,
    lag: float,
    pursuer_lag: float,
    acceleration: float,
    colours: Sequence[str],
) -> str:
    """The whole scene as MJCF text: a floor, one evader, the pursuers and the obstacles.

    **Arguments:** `half_axle` b (m); `physics_step`, `lag` and `pursuer_lag` (the time constants of the
    evader's and the pursuers' servos) in s; `acceleration` (m/s^2) of the evader; `colours` of evader,
    pursuers and obstacles as `#rrggbb`.
    """
    evader, pursuer, obstacle = colours
    bodies = [evader_body(base, evader)]
    bodies += [pursuer_body(index, half_axle, pursuer) for index in range(pursuers)]
    bodies += [obstacle_body(index, obstacle) for index in range(obstacles)]
    motors = [evader_motors(base, lag, acceleration)]
    motors += [pursuer_motors(index, pursuer_lag) for index in range(pursuers)]
    motors += [obstacle_motors(index) for index in range(obstacles)]
    return f"""<mujoco model="sidestep twin">
  <option timestep="{physics_step}" integrator="implicitfast" cone="elliptic" impratio="10"/>
  <statistic extent="3" center="1 0 0"/>
{studio(shadows=2048, view='shadowclip="1.5"', tiles=4)}
  <default>
    <default class="shown"><geom contype="0" conaffinity="0" mass="0"/></default>
    <default class="rolling"><geom contype="0" conaffinity="1" condim="3" friction="0.9"/></default>
    <default class="gliding">
      <geom contype="0" conaffinity="1" condim="1" mass="0.02" rgba="0.3 0.3 0.3 1"/>
    </default>
  </default>
  <worldbody>
    <light pos="1 -2 5" dir="-0.15 0.35 -1" diffuse="0.45 0.45 0.45" specular="0.1 0.1 0.1"
           directional="true"/>
    <geom name="floor" type="plane" size="0 0 1" material="floor" contype="1" conaffinity="0" condim="1"
          friction="0.9"/>{"".join(bodies)}
  </worldbody>
  <actuator>{"".join(motors)}
  </actuator>
</mujoco>
"""
