"""The update of the extended Kalman filter, as textbooks have it: dense matrices in numpy."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

STEP = 1e-6


def updated(
    mean: np.ndarray, covariance: np.ndarray, y: np.ndarray, R: np.ndarray, h: Callable[[np.ndarray], np.ndarray]
) -> tuple[np.ndarray, np.ndarray]:
    """Mean and covariance after a measurement, H by finite differences."""
    H = np.stack([(h(mean + STEP * e) - h(mean - STEP * e)) / (2 * STEP) for e in np.eye(len(mean))], -1)
    S = H @ covariance @ H.T + R
    K = covariance @ H.T @ np.linalg.inv(S)
    return mean + K @ (y - h(mean)), covariance - K @ S @ K.T
