"""What the sensors read of one account of the throw: first exactly, then with noise, bias and dropouts.

All at 60 Hz, synchronised. Positions in the world frame (`geometry`), the inertial unit in its own frame (z
along the forearm towards the elbow), head orientation as a rotation vector against "facing the robot", which
stays well below pi.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from experiments.ball_catching import soles
from experiments.ball_catching.body import Body
from experiments.ball_catching.geometry import GRAVITY, Array
from experiments.ball_catching.motion import smoothstep
from experiments.ball_catching.thrower import Throw
from torch_ebip import Layout, Modality


def _axes(*names: str) -> list[str]:
    return [f"{name}.{axis}" for name in names for axis in "xyz"]


LAYOUT = Layout(
    [
        Modality("hands", _axes("right_hand", "left_hand"), "m"),
        Modality("feet", _axes("right_foot", "left_foot"), "m"),
        Modality("imu_acceleration", _axes("imu.force"), "m/s^2"),
        Modality("imu_gyro", _axes("imu.rate"), "rad/s"),
        Modality("shoe_left", [f"shoe_left.{cell}" for cell in soles.CELLS], "N"),
        Modality("shoe_right", [f"shoe_right.{cell}" for cell in soles.CELLS], "N"),
        Modality("head", _axes("head"), "rad"),
        Modality("ball", _axes("ball"), "m"),
        Modality(
            "robot",
            ["shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3"],
            "rad",
            controlled=True,
        ),
    ]
)

_SHOE_IMU = ("shoe_left", "shoe_right", "imu_acceleration", "imu_gyro")
SUBSETS: dict[str, tuple[str, ...]] = {
    "ball": ("ball",),
    "shoe+imu": _SHOE_IMU,
    "shoe+imu+head": (*_SHOE_IMU, "head"),
    "shoe+imu+head+ball": (*_SHOE_IMU, "head", "ball"),
    "all": tuple(modality.name for modality in LAYOUT.modalities if not modality.controlled),
}
"""The paper's sets of active sensors (its table I): names of the modalities that a filter gets to see."""

# Standard deviations of a sample's white noise and of a recording's bias; share of recordings with a gap; its
# length in samples.
NOISE: dict[str, tuple[float, float, float, tuple[int, int]]] = {
    "hands": (
        0.002,
        0.004,
        0.10,
        (3, 9),
    ),  # optical motion capture; the bias is how a marker sits, gaps are occlusions
    "feet": (0.002, 0.004, 0.05, (3, 9)),
    "imu_acceleration": (0.12, 0.06, 0.03, (1, 3)),  # consumer MEMS, lost radio packets
    "imu_gyro": (0.015, 0.01, 0.03, (1, 3)),
    "shoe_left": (2.0, 1.5, 0.03, (1, 3)),  # resistive insoles; their gain error is added below
    "shoe_right": (2.0, 1.5, 0.03, (1, 3)),
    "head": (0.010, 0.020, 0.02, (2, 6)),
    "ball": (0.008, 0.004, 0.15, (2, 6)),  # depth camera
    "robot": (0.0002, 0.0, 0.0, (1, 1)),  # encoders
}
GAIN = 0.03
"""Standard deviation of a pressure cell's gain in a recording."""
MOUNT = 0.05
"""Standard deviation of the angles at which the inertial unit is strapped on, rad."""


def head_turn(rng: np.random.Generator, throw: Throw, t: Array, eyes: Array, ball: Array) -> Array:
    """Rotation vectors [N, T, 3] of the head: towards the ball in the hand, the target, then the flying ball.

    Part of a gaze shift is done by the eyes (Freedman, Exp. Brain Res. 190, 2008), which differs between
    people.

    Args:
        t: times [N, T]; eyes, ball: their positions [N, T, 3]. Pursuit of the ball sets in 120 ms after the
            release; it is predictive, so that it then lags by no more than 30 ms.
    """
    n = len(t)
    onset, delay = 0.12, 0.03

    def direction(goal: Array) -> Array:
        ray = goal - eyes
        return np.stack(
            [np.arctan2(ray[..., 1], ray[..., 0]), -np.arctan2(ray[..., 2], np.hypot(*ray[..., :2].T).T)], -1
        )

    late = np.stack([[np.interp(ti - delay, ti, b[:, c]) for c in range(3)] for ti, b in zip(t, ball, strict=True)])
    to_ball = direction(late.transpose(0, 2, 1))
    # Looking a little beside the spot that the arm aims at, and at the robot rather than over it.
    spot = throw.aim[:, None] + rng.normal(0.0, 0.08, (n, 1, 3))
    to_target = direction(np.broadcast_to(spot, eyes.shape))
    idle = np.stack([rng.normal(0.0, 0.08, n), rng.normal(0.25, 0.08, n)], axis=-1)[:, None]
    look = smoothstep((t - throw.look[:, None]) / 0.28)[..., None]
    follow = smoothstep((t - throw.release[:, None] - onset) / 0.22)[..., None] * throw.sighted
    gain = throw.gaze[:, None, None] * np.array([1.0, 0.75])  # heads pitch less readily than they turn
    angles = (1 - look) * idle + look * (1 - follow) * gain * to_target + look * follow * gain * to_ball
    phase, speed = rng.uniform(0, 2 * np.pi, (2, n, 1)), rng.uniform(1.5, 5.0, (2, n, 1))
    roll = 0.03 * np.sin(speed[0] * t + phase[0]) + rng.normal(0.0, 0.03, (n, 1))
    yaw = angles[..., 0] + 0.015 * np.sin(speed[1] * t + phase[1])
    euler = np.stack([yaw, angles[..., 1], roll], axis=-1)
    return np.asarray(Rotation.from_euler("ZYX", euler.reshape(-1, 3)).as_rotvec()).reshape(euler.shape)


def exact(rng: np.random.Generator, throw: Throw, t: Array, ball: Array, robot: Array) -> Array:
    """Noise-free readings [N, T, 48] at times [N, T]; `ball` [N, T, 3] m, `robot` [N, T, 6] rad."""
    body, feet = throw.body(t), throw.feet(t)
    _, force, rate = inertial(body)
    mount = Rotation.from_rotvec(rng.normal(0.0, MOUNT, (len(t), 3))).as_matrix()
    standing = soles.contact(t, throw.lift, throw.land)
    left, right = soles.loads(*body.zero_moment_point(), feet, throw.stature, standing)
    columns = {
        "hands": np.concatenate([body.right_hand.p, body.left_hand.p], axis=-1),
        "feet": np.concatenate([feet[1].q, feet[0].q], axis=-1),
        "imu_acceleration": np.einsum("nji,ntj->nti", mount, force),
        "imu_gyro": np.einsum("nji,ntj->nti", mount, rate),
        "shoe_left": left,
        "shoe_right": right,
        "head": head_turn(rng, throw, t, body.head, ball),
        "ball": ball,
        "robot": robot,
    }
    return np.concatenate([columns[name] for name in LAYOUT.names], axis=-1)


def inertial(body: Body) -> tuple[Array, Array, Array]:
    """Orientation [N, T, 3, 3] of the inertial unit and, in its own frame, specific force (m/s^2) and angular
    rate (rad/s), [N, T, 3] each. At rest it reads 9.81 m/s^2 upwards: it feels the support, not gravity."""
    support = body.imu.a + np.array([0.0, 0.0, GRAVITY])
    R = body.imu.R
    return R, np.einsum("ntji,ntj->nti", R, support), np.einsum("ntji,ntj->nti", R, body.imu.w)


def measure(rng: np.random.Generator, truth: Array, hidden: int) -> Array:
    """One recording [T, 48] as the sensors deliver it; NaN = not measured.

    Args:
        truth: `exact` readings [T, 48] of the recording.
        hidden: how many leading samples have the ball in the hand, where the camera does not see it.
    """
    values = truth.copy()
    length = len(values)
    for name, (noise, bias, gaps, (shortest, longest)) in NOISE.items():
        columns = LAYOUT.slice(name)
        part = values[:, columns]
        if name.startswith("shoe"):
            part = part * (1.0 + rng.normal(0.0, GAIN, part.shape[1]))
        part = part + rng.normal(0.0, bias, part.shape[1]) + rng.normal(0.0, noise, part.shape)
        if name.startswith("shoe"):
            part = np.maximum(part, 0.0)  # a cell cannot be pulled
        if rng.random() < gaps:
            # One object loses sight: a hand or a foot of the two, or the sensor as a whole. The catch itself,
            # the last samples, is always in view: it is what the recordings are made for.
            width = 3 if name in ("hands", "feet") else part.shape[1]
            object_ = int(rng.integers(part.shape[1] // width))
            first = int(rng.integers(hidden if name == "ball" else 0, length - 5))
            last = min(first + int(rng.integers(shortest, longest + 1)), length - 3)
            part[first:last, object_ * width : (object_ + 1) * width] = np.nan
        values[:, columns] = part
    values[:hidden, LAYOUT.slice("ball")] = np.nan
    return values
