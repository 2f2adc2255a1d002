"""The scenario `paper` as a user of Stable-Baselines3 would write it: one world at a time, NumPy and math.

It follows `sidestep.world` and the `turn-then-drive` pursuer; tests/benchmarks compares the two step by step.
It knows one pursuer, at most one obstacle, the target frame and the velocity action, and no shield.
"""

import math
from itertools import pairwise
from typing import Any

import numpy as np


class PeerTask:
    """One world. `constants` are the values of a scenario; `hold` control periods per action."""

    def __init__(self, constants: dict[str, Any], hold: int, seed: int = 0):
        self.c = constants
        self.hold = hold
        self.random = np.random.default_rng(seed)
        self.observation_size = 7 + 5 * constants["obstacle_count"]
        self.usable = math.acos(min(constants["evader_speed"] / constants["pursuer_speed"], 1.0))

    def reset(self) -> np.ndarray:
        """A legal random start."""
        c, half = self.c, self.c["arena_side"] / 2
        while True:
            evader, pursuer, obstacle, target = self.random.uniform(-half, half, (4, 2)).tolist()
            heading = self.random.uniform(-math.pi, math.pi)
            self.place(evader, [*pursuer, heading], obstacle if c["obstacle_count"] else None, target)
            ahead, left = self._evader_seen()
            near = math.hypot(ahead, left)
            sine, cosine = math.sin(self.usable), math.cos(self.usable)
            if abs(left) * cosine < abs(ahead) * sine:
                escape = abs(ahead) * cosine + abs(left) * sine
            else:
                escape = near
            good = (
                escape > c["capture_distance"]
                and near >= c["initial_separation"]
                and math.dist(evader, target) >= c["target_separation"]
            )
            if self.obstacle is not None:
                good = good and (
                    math.dist(evader, obstacle) >= max(c["obstacle_separation"], c["collision_distance"])
                    and math.dist(target, obstacle) > c["collision_distance"]
                )
            if good:
                return self.observe()

    def place(self, evader: Any, pursuer: Any, obstacle: Any, target: Any) -> None:
        """Put everybody somewhere, at time zero."""
        self.evader, self.target = tuple(evader), tuple(target)
        self.pursuer = tuple(pursuer)
        self.obstacle = None if obstacle is None else tuple(obstacle[:2])
        self.periods = 0

    def _evader_seen(self) -> tuple[float, float]:
        x, y, heading = self.pursuer
        dx, dy = self.evader[0] - x, self.evader[1] - y
        cosine, sine = math.cos(heading), math.sin(heading)
        return cosine * dx + sine * dy, cosine * dy - sine * dx

    def _axes(self) -> tuple[float, float]:
        dx, dy = self.target[0] - self.evader[0], self.target[1] - self.evader[1]
        far = math.hypot(dx, dy)
        return (dx / far, dy / far) if far > 0.0 else (1.0, 0.0)

    def observe(self) -> np.ndarray:
        """What `sidestep.world.observe` gives."""
        c, (ax, ay) = self.c, self._axes()
        far = math.dist(self.target, self.evader)
        entries = [math.tanh(far / 2.0), math.exp(-far / 0.25)]

        def block(place: Any, along: tuple[float, float], contact: float) -> None:
            dx, dy = place[0] - self.evader[0], place[1] - self.evader[1]
            distance = math.hypot(dx, dy)
            squash = 1.0 / (1.0 + distance)
            entries.extend(
                (
                    (ax * dx + ay * dy) * squash,
                    (ax * dy - ay * dx) * squash,
                    ax * along[0] + ay * along[1],
                    ax * along[1] - ay * along[0],
                    math.exp(-max(distance - contact, 0.0) / 0.2),
                )
            )

        heading = self.pursuer[2]
        block(self.pursuer, (math.cos(heading), math.sin(heading)), c["capture_distance"])
        if self.obstacle is not None:
            vx, vy = (v / c["evader_speed"] for v in c["obstacle_velocity"])
            block(self.obstacle, (vx, vy), c["collision_distance"])
        return np.array(entries, np.float32)

    def act(self, action: Any) -> tuple[np.ndarray, float, bool, bool]:
        """Hold one action for `hold` periods: observation, reward, terminated, truncated."""
        ax, ay = self._axes()
        forward, sideways = float(action[0]), float(action[1])
        scale = self.c["evader_speed"] / max(math.hypot(forward, sideways), 1.0)
        velocity = ((forward * ax - sideways * ay) * scale, (forward * ay + sideways * ax) * scale)
        total = 0.0
        for _ in range(self.hold):
            reward, terminated, truncated = self.period(velocity, self.turn_then_drive())
            total += reward
            if terminated or truncated:
                return self.observe(), total, terminated, truncated
        return self.observe(), total, False, False

    def turn_then_drive(self) -> tuple[float, float]:
        """Speed and turn rate of a pursuer that turns in place until it faces the evader, then drives."""
        c = self.c
        ahead, left = self._evader_seen()
        fastest = c["pursuer_speed"] / c["pursuer_half_axle"]
        turn_rate = min(max(math.atan2(left, ahead) / c["control_period"], -fastest), fastest)
        return c["pursuer_speed"] - c["pursuer_half_axle"] * abs(turn_rate), turn_rate

    def period(self, velocity: tuple[float, float], body: tuple[float, float]) -> tuple[float, bool, bool]:
        """One control period: reward, terminated, truncated."""
        c = self.c
        period = c["control_period"]
        (ex, ey), (vx, vy), (px, py, heading) = self.evader, velocity, self.pursuer
        gap = self._approach_driving(velocity, body)
        captured = gap <= c["capture_distance"]
        collided = False
        if self.obstacle is not None:
            ox, oy = self.obstacle
            wx, wy = c["obstacle_velocity"]
            collided = _approach(ex - ox, ey - oy, vx - wx, vy - wy, period) <= c["collision_distance"]
            self.obstacle = (ox + wx * period, oy + wy * period)
        to_target = _approach(ex - self.target[0], ey - self.target[1], vx, vy, period)
        reached = to_target <= c["reach_distance"] and not captured and not collided

        self.evader = (ex + vx * period, ey + vy * period)
        dx, dy = _along_arc(heading, body, period)
        turned = (heading + body[1] * period + math.pi) % (2 * math.pi) - math.pi
        self.pursuer = (px + dx, py + dy, turned)
        self.periods += 1
        terminated = captured or collided or reached
        truncated = self.periods >= c["episode_steps"] and not terminated
        far = math.dist(self.evader, self.target)
        return (c["reach_reward"] if reached else -c["distance_cost"] * far), terminated, truncated

    def _approach_driving(self, velocity: tuple[float, float], body: tuple[float, float]) -> float:
        """Smallest distance to the pursuer within a period: four chords, then Newton's method."""
        period = self.c["control_period"]
        (vx, vy), (speed, turn_rate), heading = velocity, body, self.pursuer[2]
        dx, dy = self.evader[0] - self.pursuer[0], self.evader[1] - self.pursuer[1]

        def apart(when: float) -> tuple[float, float]:
            ax, ay = _along_arc(heading, body, when)
            return dx + vx * when - ax, dy + vy * when - ay

        knots = [apart(period * i / 4) for i in range(5)]
        best, low, when = math.inf, 0.0, 0.0
        for i, ((x0, y0), (x1, y1)) in enumerate(pairwise(knots)):
            cx, cy = x1 - x0, y1 - y0
            squared = cx * cx + cy * cy
            share = min(max(-(x0 * cx + y0 * cy) / squared, 0.0), 1.0) if squared > 0.0 else 0.0
            distance = math.hypot(x0 + share * cx, y0 + share * cy)
            if distance < best:
                best, low, when = distance, period * i / 4, period * (i + share) / 4
        for _ in range(2):
            ahead = heading + turn_rate * when
            cosine, sine = math.cos(ahead), math.sin(ahead)
            qx, qy = apart(when)
            rx, ry = vx - speed * cosine, vy - speed * sine
            slope = rx * rx + ry * ry + speed * turn_rate * (qx * sine - qy * cosine)
            if slope > 0.0:
                when = min(max(when - (qx * rx + qy * ry) / slope, low), low + period / 4)
        return min(math.hypot(*apart(when)), math.hypot(*knots[0]), math.hypot(*knots[-1]))


def _along_arc(heading: float, body: tuple[float, float], duration: float) -> tuple[float, float]:
    half_turn = body[1] * duration / 2
    chord = body[0] * duration * (math.sin(half_turn) / half_turn if half_turn else 1.0)
    return chord * math.cos(heading + half_turn), chord * math.sin(heading + half_turn)


def _approach(x: float, y: float, vx: float, vy: float, duration: float) -> float:
    squared = vx * vx + vy * vy
    when = min(max(-(x * vx + y * vy) / squared, 0.0), duration) if squared > 0.0 else 0.0
    return math.hypot(x + vx * when, y + vy * when)
