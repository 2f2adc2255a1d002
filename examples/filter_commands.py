"""The shield in your own control loop: poses and a nominal velocity in, a safe velocity out."""

import math

from sidestep import load_scenario
from sidestep.robot import Onboard, OnboardSettings
from sidestep.safety import Budget

scenario = load_scenario("paper", capture_distance=0.15)
settings = OnboardSettings(budget=Budget(position_error=0.003), position_noise=0.001)
onboard = Onboard(scenario, "game", settings=settings)
onboard.warm_up()

# Stands for the robots: the nominal velocity points straight at a pursuer that drives straight at the evader.
evader, pursuer, period = [0.0, 0.0], [1.2, 0.0], float(scenario.control_period)
for count in range(120):
    now = count * period
    onboard.see("evader", now, (*evader, 0.0))
    onboard.see("pursuer", now, (*pursuer, math.pi))
    onboard.see("obstacle", now, (0.0, 2.0))
    onboard.nominal(now, (0.15, 0.0))
    decision = onboard.decide(now)
    if count % 20 == 0:
        x, y = decision.velocity
        apart = math.hypot(pursuer[0] - evader[0], pursuer[1] - evader[1])
        print(f"{now:4.1f} s: {apart:.3f} m apart, commanded ({x:+.3f}, {y:+.3f}) m/s, {decision.level}")
    evader = [evader[0] + period * decision.velocity[0], evader[1] + period * decision.velocity[1]]
    pursuer[0] -= period * 0.2
