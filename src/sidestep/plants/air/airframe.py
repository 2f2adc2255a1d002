"""MuJoCo models of the quadrotor, the pursuing aircraft and the columns.

The quadrotor has the size of a Crazyflie 2. Mass, inertia and the ratio of a propeller's torque to its thrust
are those measured by Förster, "System identification of the Crazyflie 2.0 nano quadrocopter" (ETH Zurich,
2015). There are no contacts: capture and collision are distances between centres in the plane, as in the
scenario.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from sidestep._bounds import bounded, check
from sidestep.plants.drawing import mjcf_colour, studio
from sidestep.world.flyers import GRAVITY

ROTORS = ("front_left", "rear_left", "rear_right", "front_right")
"""Their directions of rotation alternate; the first is clockwise, seen from above."""


@dataclass(frozen=True)
class Airframe:
    """The parameters of a quadrotor.

    - `mass` kg; `inertia` kg m^2 about the body axes; `arm` m, from the centre to a rotor
    - `largest_thrust` N of one rotor; `rotor_torque` m, drag torque per thrust; `rotor_lag` s, the time
      constant of a rotor's thrust
    - `drag` N s/m, the drag of the rotors' blades
    """

    mass: float = bounded(0.028, above=0.0, unit="kg")
    inertia: tuple[float, float, float] = bounded((16.57e-6, 16.66e-6, 29.26e-6), shape=(3,), above=0.0)
    arm: float = bounded(0.046, above=0.0, unit="m")
    largest_thrust: float = bounded(0.15, above=0.0, unit="N")
    rotor_torque: float = bounded(0.00596, least=0.0, unit="m")
    rotor_lag: float = bounded(0.03, above=0.0, unit="s")
    drag: float = bounded(0.01, least=0.0, unit="N s/m")

    def __post_init__(self):
        check(self, title="airframe: ")
        if 4.0 * self.largest_thrust <= 1.1 * GRAVITY * self.mass:
            raise ValueError(
                f"airframe: four rotors of {self.largest_thrust:g} N cannot lift {self.mass:g} kg and steer"
            )

    @property
    def rotor_places(self) -> tuple[tuple[float, float], ...]:
        """x and y (m) of each rotor."""
        a = self.arm / math.sqrt(2.0)
        return ((a, a), (-a, a), (-a, -a), (a, -a))

    @property
    def rotor_senses(self) -> tuple[float, ...]:
        """Sign of each rotor's drag torque on the body: +1 counter-clockwise."""
        return (1.0, -1.0, 1.0, -1.0)


def _quadrotor(frame: Airframe, colour: str) -> str:
    rotors = []
    for index, (name, (x, y)) in enumerate(zip(ROTORS, frame.rotor_places, strict=True)):
        shade = mjcf_colour(colour, 0.55) if index in (0, 3) else "0.25 0.25 0.25 0.55"
        rotors.append(f"""
      <site name="{name}" pos="{x} {y} 0"/>
      <geom class="shown" type="capsule" fromto="0 0 0 {x} {y} 0" size="0.004" rgba="0.2 0.2 0.2 1"/>
      <geom class="shown" type="cylinder" pos="{x} {y} 0.010" size="0.0235 0.0012" rgba="{shade}"/>""")
    inertia = " ".join(map(str, frame.inertia))
    return f"""
    <body name="quadrotor">
      <freejoint name="quadrotor"/>
      <inertial pos="0 0 0" mass="{frame.mass}" diaginertia="{inertia}"/>
      <geom class="shown" type="box" size="0.016 0.011 0.009" rgba="{mjcf_colour(colour)}"/>
      <geom class="shown" type="box" size="0.005 0.004 0.003" pos="0.018 0 0.004" rgba="0.95 0.95 0.95 1"/>\
{"".join(rotors)}
    </body>"""


def _rotor_motors(frame: Airframe) -> str:
    return "".join(
        f"""
    <general name="{name}" site="{name}" gear="0 0 1 0 0 {sense * frame.rotor_torque}" dyntype="filterexact"
             dynprm="{frame.rotor_lag}" ctrllimited="true" ctrlrange="0 {frame.largest_thrust}"/>"""
        for name, sense in zip(ROTORS, frame.rotor_senses, strict=True)
    )


def _aircraft(index: int, colour: str) -> str:
    """Wings, fuselage and tail. The capture disc is drawn only."""
    body, dark = mjcf_colour(colour), "0.15 0.15 0.15 1"
    return f"""
    <body name="pursuer{index}" mocap="true">
      <geom class="shown" type="capsule" fromto="-0.075 0 0 0.085 0 0" size="0.014" rgba="{body}"/>
      <geom class="shown" type="box" size="0.022 0.125 0.0025" pos="0.015 0 0.008" rgba="{body}"/>
      <geom class="shown" type="box" size="0.013 0.045 0.002" pos="-0.07 0 0.004" rgba="{body}"/>
      <geom class="shown" type="box" size="0.013 0.002 0.02" pos="-0.072 0 0.022" rgba="{body}"/>
      <geom class="shown" type="ellipsoid" size="0.02 0.009 0.007" pos="0.04 0 0.013" rgba="{dark}"/>
      <geom class="shown" type="cylinder" size="0.032 0.001" pos="0.102 0 0" quat="0.7071 0 0.7071 0"
            rgba="0.15 0.15 0.15 0.35"/>
    </body>"""


def _column(index: int, radius: float, height: float, colour: str) -> str:
    return f"""
    <body name="obstacle{index}" mocap="true" pos="0 0 {height / 2.0}">
      <geom class="shown" type="cylinder" size="{radius} {height / 2.0}" rgba="{mjcf_colour(colour)}"/>
      <geom class="shown" type="cylinder" size="{radius + 0.004} 0.012" pos="0 0 {height / 2.0 - 0.05}"
            rgba="0.93 0.93 0.93 1"/>
    </body>"""


def scene_xml(
    frame: Airframe,
    pursuers: int,
    obstacles: int,
    *,
    physics_step: float,
    column_radius: float,
    column_height: float,
    colours: Sequence[str],
) -> str:
    """The whole scene as MJCF text.

    **Arguments:** `physics_step` in s; `column_radius`, `column_height` in m; `colours` of the quadrotor, the
    aircraft and the columns as `#rrggbb`.
    """
    evader, pursuer, obstacle = colours
    bodies = [_quadrotor(frame, evader)]
    bodies += [_aircraft(index, pursuer) for index in range(pursuers)]
    bodies += [_column(index, column_radius, column_height, obstacle) for index in range(obstacles)]
    return f"""<mujoco model="sidestep flight">
  <option timestep="{physics_step}" integrator="implicitfast" gravity="0 0 {-GRAVITY}"/>
  <statistic extent="6" center="1 0 0.5"/>
{studio(shadows=4096, view='shadowclip="1.2" znear="0.005"', tiles=2)}
  <default>
    <default class="shown"><geom contype="0" conaffinity="0" mass="0"/></default>
  </default>
  <worldbody>
    <light pos="1 -2 6" dir="-0.15 0.35 -1" diffuse="0.45 0.45 0.45" specular="0.1 0.1 0.1"
           directional="true"/>
    <geom name="floor" type="plane" size="0 0 1" material="floor" contype="0" conaffinity="0"/>\
{"".join(bodies)}
  </worldbody>
  <actuator>{_rotor_motors(frame)}
  </actuator>
</mujoco>
"""
