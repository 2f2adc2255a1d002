"""Where a differential-drive pursuer can be after some time, whatever it does with its wheels meanwhile.

Along a unit vector n the pursuer's displacement is the integral of v n.e(heading), and |v| + b |omega| <= V
lets it spend V t on driving and turning together. So a pursuer that must end turned by theta does best, along
n, to turn to the heading nearest to n (or to -n, and reverse), drive there all the way, and turn to theta:
turn, drive, turn. That is the support function of the positions it can reach for each final heading, and it
is all that a worst case over *every* motion needs: nothing here enumerates motions.

Arrays are NumPy's, in double precision: what is computed here is meant as a proof.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

Reals = Float[np.ndarray, "..."]


def closest_alignment(angle: Reals, turn: Reals) -> Reals:
    """max |cos| of the angle between n and the headings on the way: how well driving can be aimed along n.

    `angle` of n in the pursuer's final frame, `turn` theta from first to final heading, both rad: in the
    first frame n is at angle + turn, and all angles between the two are passed without detour.
    """
    first, last = angle + turn, angle
    passes = np.floor(np.maximum(first, last) / np.pi) > np.floor(np.minimum(first, last) / np.pi)
    return np.where(passes, 1.0, np.maximum(np.abs(np.cos(first)), np.abs(np.cos(last))))


def advance(budget: Reals, alignment: Reals, half_axle: float) -> Reals:
    """The farthest the pursuer can come along n, m: an upper bound, exact where no detour in heading pays.

    `budget` s = V t - b |theta|, m, is left for driving and `alignment` C is from `closest_alignment`. A
    detour by eta costs 2 b eta: max over eta of (s - 2 b eta) cos(gamma - eta), with cos gamma = C, is at
    most (s - 2 b eta)(C + eta) at its own maximum,

        s C  for s <= 2 b C,  else (s + 2 b C)^2 / (8 b),

    continuously differentiable, and convex in s. For b = 0 it is s: turning costs nothing.
    """
    detour = budget > 2.0 * half_axle * alignment
    if half_axle <= 0.0:
        return np.where(detour, budget, budget * alignment)
    squared = (budget + 2.0 * half_axle * alignment) ** 2 / (8.0 * half_axle)
    return np.where(detour, squared, budget * alignment)


def turn_nodes(time: float, rim_speed: float, half_axle: float, cells: int) -> Float[np.ndarray, "n"]:
    """Final headings (rad) from one extreme to the other, 0 among them: 2 `cells` equal cells."""
    largest = np.pi if half_axle * np.pi <= rim_speed * time else rim_speed * time / half_axle
    return np.linspace(-largest, largest, 2 * cells + 1)


def bending(budget: float, half_axle: float, sine: Reals, detour: Bool[np.ndarray, "..."]) -> Reals:
    """Largest second derivative of -`advance` in the final heading theta, m, at a budget of up to V t.

    Between n and the headings on the way lie angles of sine at most `sine`. Driving first, (s) cos(angle +
    theta) with s falling at b per rad: at most 2 b |sin| + s. Where a `detour` may pay, its square bends by
    (2 (3 b)^2 + 2 (s + 2 b) 2 b)/(8 b) at most.
    """
    return np.where(detour, 3.25 * half_axle + 0.5 * budget, 2.0 * half_axle * sine) + budget


def wheel_motions(
    segments: Float[np.ndarray, "n k 2"], durations: Float[np.ndarray, "n k"], half_axle: float
) -> Float[np.ndarray, "n 3"]:
    """Exact poses (x, y, heading) from the origin after n sequences of k held wheel speeds (left, right).

    For checking the bounds above against real motions.
    """
    pose = np.zeros((len(segments), 3))
    for index in range(segments.shape[1]):
        left, right = segments[:, index].T
        time = durations[:, index]
        half_turn = (right - left) / (2.0 * half_axle) * time / 2.0
        chord = 0.5 * (left + right) * time * np.sinc(half_turn / np.pi)
        along = pose[:, 2] + half_turn
        pose[:, 0] += chord * np.cos(along)
        pose[:, 1] += chord * np.sin(along)
        pose[:, 2] += 2.0 * half_turn
    return pose


def turn_drive_turn(
    period: float, rim_speed: float, half_axle: float, turns: int = 6
) -> Float[np.ndarray, "n 3"]:
    """Poses after turning, driving and turning again at full wheel speed, the extremes of every motion.

    Both ways of driving, `turns` shares of the period for each turn and each way of turning, and all of the
    period used.
    """
    share = np.linspace(-1.0, 1.0, 2 * turns - 1)
    first, last, way = (
        axis.ravel() for axis in np.meshgrid(share, share, np.array([-1.0, 1.0]), indexing="ij")
    )
    fits = np.abs(first) + np.abs(last) <= 1.0 + 1e-12
    first, last, way = first[fits], last[fits], way[fits]
    one = np.ones_like(first)
    segments = rim_speed * np.stack(
        [
            np.stack([-np.sign(first), np.sign(first)], -1),
            np.stack([way, way * one], -1),
            np.stack([-np.sign(last), np.sign(last)], -1),
        ],
        axis=1,
    )
    driving = np.maximum(1.0 - np.abs(first) - np.abs(last), 0.0)
    durations = period * np.stack([np.abs(first), driving, np.abs(last)], -1)
    return wheel_motions(segments, durations, half_axle)


def seen_from(
    points: Float[np.ndarray, "*#n 2"], poses: Float[np.ndarray, "*#n 3"]
) -> Float[np.ndarray, "... 2"]:
    """R(-theta)(p - position): points in the frames of poses, with NumPy's broadcasting."""
    offset = points - poses[..., :2]
    cosine, sine = np.cos(poses[..., 2]), np.sin(poses[..., 2])
    return np.stack(
        [cosine * offset[..., 0] + sine * offset[..., 1], cosine * offset[..., 1] - sine * offset[..., 0]], -1
    )


def side_value(
    z: Float[np.ndarray, "*#n 2"], angle: float, side: Float[np.ndarray, "*#n"] | float
) -> Float[np.ndarray, "..."]:
    """g_s(z) = max of n.z over unit normals n on side s at least `angle` from the pursuer's axis, m.

    On the evader's own side it is r cos((S' - beta')+), the barrier of the capture game (plus l) where
    `angle` is its S; on the other side it is the tangent line followed beyond the axis.
    """
    ahead, across = np.abs(z[..., 0]), side * z[..., 1]
    tangent = ahead * np.cos(angle) + across * np.sin(angle)
    beside: Bool[np.ndarray, "..."] = across * np.cos(angle) >= ahead * np.sin(angle)
    return np.where(beside & (across >= 0.0), np.hypot(ahead, across), tangent)
