"""Quality of service per kind of topic.

| topics | reliability | durability | depth | why |
|---|---|---|---|---|
| poses in | best effort | volatile | 5 | as sensor data; matches every publisher, late poses are useless |
| commands in and out | reliable | volatile | 1 | only the newest counts; matches bases and teleoperation |
| target in | reliable | volatile | 1 | what RViz's goal button publishes |
| accepted target, scenario | reliable | transient local | 1 | late subscribers get the last one |
| diagnostics | reliable | volatile | 10 | what `diagnostic_updater` uses |
| markers | reliable | volatile | 1 | what RViz asks for |
"""

from rclpy.qos import QoSDurabilityPolicy, QoSHistoryPolicy, QoSProfile, QoSReliabilityPolicy


def _profile(reliable: bool, depth: int, latched: bool = False) -> QoSProfile:
    return QoSProfile(
        reliability=QoSReliabilityPolicy.RELIABLE if reliable else QoSReliabilityPolicy.BEST_EFFORT,
        durability=QoSDurabilityPolicy.TRANSIENT_LOCAL if latched else QoSDurabilityPolicy.VOLATILE,
        history=QoSHistoryPolicy.KEEP_LAST,
        depth=depth,
    )


POSES_IN = _profile(reliable=False, depth=5)
# Reliable, to match recorders and subscribers that require it.
POSES_OUT = _profile(reliable=True, depth=5)
COMMANDS = _profile(reliable=True, depth=1)
TARGET = _profile(reliable=True, depth=1)
LATCHED = _profile(reliable=True, depth=1, latched=True)
DIAGNOSTICS = _profile(reliable=True, depth=10)
# Matches the offered profiles, and loses nothing while the recorder is busy.
RECORDED = _profile(reliable=True, depth=200)
MARKERS = _profile(reliable=True, depth=1)
