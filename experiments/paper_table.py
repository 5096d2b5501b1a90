"""The numbers of the paper's Table I (Campbell et al., RSS 2019): from the authors' recordings, not from ours."""

from __future__ import annotations

from typing import Any

NOTE = (
    "Table I of Campbell, Stepputtis & Ben Amor (RSS 2019): 221 recorded tosses of the authors, 10 folds; not our "
    "data, so only orders and ratios can be compared. Joint error: MSE of the first three joints in rad^2; ball "
    "error: MAE in m."
)

_SUBSETS = ("ball", "shoe+imu", "shoe+imu+head", "shoe+imu+head+ball", "all")
_JOINTS: dict[tuple[str, float], tuple[float | None, ...]] = {
    ("bip", 0.43): (None, 3.91e15, 1.48e14, 9.56e14, 3.97e16),
    ("particle_filter", 0.43): (None, 0.37, 0.28, 0.28, 0.26),
    ("ebip_minus", 0.43): (None, 5.62e6, 9.98e6, 1.08e7, 6.00e7),
    ("ebip", 0.43): (None, 0.18, 0.19, 0.18, 0.14),
    ("bip", 0.82): (1.04e15, 1.59e17, 4.22e15, 3.66e15, 6.52e17),
    ("particle_filter", 0.82): (0.11, 0.37, 0.28, 0.28, 0.26),
    ("ebip_minus", 0.82): (10.52, 9.46e6, 1.36e7, 1.68e7, 7.66e7),
    ("ebip", 0.82): (0.05, 0.20, 0.19, 0.11, 0.09),
}
_BALL: dict[tuple[str, float], tuple[float | None, ...]] = {
    ("bip", 0.43): (None, None, None, 116.93, 1.35e3),
    ("particle_filter", 0.43): (None, None, None, 0.61, 0.61),
    ("ebip_minus", 0.43): (None, None, None, 7.11e3, 8.91e3),
    ("ebip", 0.43): (None, None, None, 0.61, 0.59),
    ("bip", 0.82): (6.67, None, None, 205.04, 2.74e3),
    ("particle_filter", 0.82): (0.20, None, None, 0.26, 0.28),
    ("ebip_minus", 0.82): (5.38, None, None, 8.44e3, 9.46e3),
    ("ebip", 0.82): (0.13, None, None, 0.23, 0.24),
}


def paper_rows() -> dict[str, Any]:
    """Note and rows, in the format of ``results.json``."""
    rows = []
    for table, metric, modality, unit in ((_JOINTS, "mse", "robot", "rad^2"), (_BALL, "mae", "ball", "m")):
        for (method, observed), means in table.items():
            for subset, mean in zip(_SUBSETS, means, strict=True):
                if mean is not None:
                    key = {"method": method, "subset": subset, "observed": observed}
                    rows.append({**key, "metric": metric, "modality": modality, "unit": unit, "mean": mean})
    return {"note": NOTE, "rows": rows}
