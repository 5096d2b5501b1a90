"""Pressure cells under both soles: how the ground reaction is shared between the feet and within each.

The zero-moment point of the whole body (`body.Body.zero_moment_point`) says where the ground pushes back. The
load is shared so that within each foot it stays close to the middle of the sole; there the cells carry the
most even (maximum-entropy) distribution whose centre is the foot's centre of pressure, so cells never pull
and always add up.
"""

from __future__ import annotations

import numpy as np

from experiments.ball_catching.body import FOOT_LENGTH, FOOT_WIDTH
from experiments.ball_catching.geometry import Array
from experiments.ball_catching.motion import Motion, smoothstep

CELLS = (
    "heel_medial",
    "heel_lateral",
    "midfoot_lateral",
    "midfoot_medial",
    "metatarsal_1",
    "metatarsal_3",
    "metatarsal_5",
    "hallux",
    "toes",
)
# Position along the foot (share of its length, from the instep, forwards) and across (share of its width,
# outwards), and how much of an even load each carries (the arch hardly touches the ground).
_ALONG = np.array([-0.40, -0.40, -0.10, -0.10, 0.20, 0.24, 0.17, 0.42, 0.38])
_ACROSS = np.array([-0.25, 0.25, 0.35, -0.30, -0.38, 0.00, 0.40, -0.30, 0.15])
_SIZE = np.array([1.3, 1.3, 0.6, 0.15, 1.0, 1.0, 0.8, 0.7, 0.5])
TOE_OUT = 0.12
"""rad, by which each foot points outwards"""
_RADIUS = np.array([0.28, 0.17])
"""How far the centre of pressure gets from the middle of the sole, in foot lengths and widths: an ellipse
within the cells, since the flesh spreads the load even of somebody on tiptoe."""


def loads(
    point: Array, force: Array, feet: tuple[Motion, Motion], stature: Array, contact: Array
) -> tuple[Array, Array]:
    """Load of every cell of the left and of the right sole, [N, T, 9] N each.

    Args:
        point: zero-moment point [N, T, 2], m. Where it leaves the soles it is held at their edge: the
            remaining moment is what a real body takes up by bending.
        force: vertical ground reaction [N, T], N.
        feet: left and right foot, q [N, T, 3].
        stature: [N], m.
        contact: 1 where the left foot stands, 0 where it is in the air, [N, T].
    """
    left, right = feet[0].q[..., :2], feet[1].q[..., :2]
    between = left - right
    # The share that leaves the centres of pressure closest to the middle of the soles, longer than wide.
    size = np.array([FOOT_LENGTH * _RADIUS[0], FOOT_WIDTH * _RADIUS[1]])
    scaled = between / size
    share = ((point - right) / size * scaled).sum(-1) / (scaled**2).sum(-1)
    # Weight shifts smoothly onto one foot before the other is empty; a lifted foot carries nothing.
    share = contact * (0.5 + 0.5 * np.tanh(2.2 * (share - 0.5)))
    offset = point - (share[..., None] * left + (1 - share)[..., None] * right)
    result = []
    for side, weight in ((1.0, share), (-1.0, 1 - share)):
        angle = side * TOE_OUT
        forward, outward = (
            np.array([np.cos(angle), np.sin(angle)]),
            side * np.array([-np.sin(angle), np.cos(angle)]),
        )
        along = offset @ forward / (FOOT_LENGTH * stature)[:, None]
        across = offset @ outward / (FOOT_WIDTH * stature)[:, None]
        result.append((weight * force)[..., None] * distribute(along, across))
    return result[0], result[1]


def distribute(along: Array, across: Array) -> Array:
    """Shares [..., 9] of the cells, adding up to 1, whose mean position is (along, across) [...], in foot
    lengths and widths; a position beyond the outline is drawn back to it."""
    cells = np.stack([_ALONG, _ACROSS], axis=-1)
    centre = _SIZE @ cells / _SIZE.sum()
    wanted = np.stack([along, across], axis=-1) - centre
    # tanh rounds the corner at the outline.
    size = np.linalg.norm(wanted / _RADIUS, axis=-1, keepdims=True)
    wanted = wanted * np.where(size > 1e-9, np.tanh(size) / np.maximum(size, 1e-9), 1.0)
    tilt = np.zeros_like(wanted)
    weights: Array
    for _ in range(30):  # Newton on the convex dual: log sum_i size_i exp(tilt . r_i) - tilt . wanted
        logits = tilt @ (cells - centre).T + np.log(_SIZE)
        weights = np.exp(logits - logits.max(-1, keepdims=True))
        weights = weights / weights.sum(-1, keepdims=True)
        mean = weights @ (cells - centre)
        spread = np.einsum("...i,ia,ib->...ab", weights, cells - centre, cells - centre)
        spread = spread - mean[..., :, None] * mean[..., None, :] + 1e-5 * np.eye(2)
        step = np.linalg.solve(spread, (wanted - mean)[..., None])[..., 0]
        tilt = tilt + np.clip(step, -4.0, 4.0)
    return weights


def contact(t: Array, lift: Array, land: Array) -> Array:
    """1 where the left foot stands, 0 while it steps, smooth over 60 ms, [N, T] at times [N, T] s."""
    result: Array = 1.0 - smoothstep((t - lift[:, None] + 0.06) / 0.06) * smoothstep(
        (land[:, None] + 0.06 - t) / 0.06
    )
    return result
