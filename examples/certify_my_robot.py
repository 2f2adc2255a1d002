"""Is my robot safe against that pursuer at 20 Hz, and if not, what must change?"""

import sidestep
from sidestep.safety import certify

# What the robots can do; position error, delay and control period are those of our robot.
scenario = sidestep.load_scenario(
    "paper",
    evader_speed=0.3,  # m/s
    pursuer_speed=0.4,  # m/s, of a wheel
    pursuer_half_axle=0.1,  # m
    capture_distance=0.1,  # m
    control_period=0.05,  # s
    obstacle_count=0,
)
verdict = certify(scenario, position_error=0.002, delay=0.02, check_shield=False)

print(f"never nearer than {verdict.guaranteed_clearance:.4f} m, 0.1 m wanted: {verdict.reason}")
for part, cost in verdict.budget.items():
    print(f"  {part:>9}: {1e3 * cost:7.2f} mm")
for change in verdict.nearest_changes:
    if change.needed is not None:
        print(f"  it would hold with {change.parameter} = {change.needed:.4g} {change.unit}")
