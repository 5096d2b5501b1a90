"""One demonstration with all its sensors, drawn as recorded."""

from __future__ import annotations

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.ball_catching.geometry import BOX_WIDTH, DISTANCE, TABLE_HEIGHT, base_transform
from experiments.ball_catching.sensors import LAYOUT
from experiments.ball_catching.teacher import arm
from torch_ebip import Demonstrations

PANELS = ("hands", "feet", "imu_acceleration", "imu_gyro", "shoe_left", "shoe_right", "head", "ball", "robot")


def draw(demonstrations: Demonstrations, index: int = 0) -> Figure:
    """Side view, view from above, the load on the soles, and every modality against phase."""
    values = demonstrations[index].double()
    columns = demonstrations.columns
    phase = np.linspace(0.0, 1.0, len(values))
    release = float(columns["release_phase"][index])
    figure = Figure(figsize=(17, 13), layout="constrained")
    axes = figure.subplots(4, 3)
    _view(axes[0, 0], values, (0, 2), "x [m]", "z [m]", "side view")
    _view(axes[0, 1], values, (0, 1), "x [m]", "y [m]", "from above")
    _weight(axes[0, 2], values, phase)
    for axis, name in zip(axes.flat[3:], PANELS, strict=True):
        modality = LAYOUT[name]
        part = values[:, LAYOUT.slice(name)].numpy()
        for dof, column in zip(modality.dofs, part.T, strict=True):
            axis.plot(phase, column, lw=1.2, label=dof.removeprefix(f"{name}."))
        axis.set_title(name)
        axis.set_ylabel(modality.unit)
        axis.legend(fontsize=6, ncols=2, loc="upper left", framealpha=0.4)
    for axis in axes.flat[2:]:
        axis.axvline(release, color="0.6", ls="--", lw=0.8)
        axis.set_xlim(0.0, 1.0)
    for axis in axes[-1]:
        axis.set_xlabel("phase (dashed: release)")
    figure.suptitle(
        f"demonstration {index}: {columns['style'][index]}, person {columns['person'][index]}, "
        f"teacher {columns['teacher'][index]}, {demonstrations.durations[index]:.2f} s"
    )
    return figure


def _view(axis: Axes, values: torch.Tensor, plane: tuple[int, int], x: str, y: str, title: str) -> None:
    """Paths of hands, feet, ball, and the box as the recorded joints place it, in one plane of the world."""
    robot = arm()
    boxes = base_transform() @ robot(values[:, LAYOUT.slice("robot")])
    hands, feet = values[:, LAYOUT.slice("hands")], values[:, LAYOUT.slice("feet")]
    paths = {
        "right hand": (hands[:, :3], "C3"),
        "left hand": (hands[:, 3:], "C1"),
        "right foot": (feet[:, :3], "0.5"),
        "left foot": (feet[:, 3:], "0.7"),
        "ball": (values[:, LAYOUT.slice("ball")], "C0"),
        "box centre": (boxes[:, :3, 3], "C2"),
    }
    for label, (path, colour) in paths.items():
        axis.plot(path[:, plane[0]], path[:, plane[1]], ".-", ms=3, lw=0.8, color=colour, label=label)
    # The rim of the box at the catch, and the robot's base.
    half = BOX_WIDTH / 2
    rim = torch.tensor(
        [[-half, -half], [half, -half], [half, half], [-half, half], [-half, -half]], dtype=torch.float64
    )
    corners = torch.cat([rim, torch.full((5, 1), 0.12), torch.ones(5, 1)], dim=-1) @ boxes[-1].T
    axis.plot(corners[:, plane[0]], corners[:, plane[1]], "C2-", lw=1.5)
    axis.plot(DISTANCE, TABLE_HEIGHT if plane[1] == 2 else 0.0, "ks", ms=8)
    axis.set(xlabel=x, ylabel=y, title=title, aspect="equal")
    axis.legend(fontsize=6, ncols=2)


def _weight(axis: Axes, values: torch.Tensor, phase: np.ndarray) -> None:
    """Load on both soles and on each."""
    left = values[:, LAYOUT.slice("shoe_left")].sum(-1)
    right = values[:, LAYOUT.slice("shoe_right")].sum(-1)
    for load, label in ((left, "left"), (right, "right"), (left + right, "both")):
        axis.plot(phase, load, label=label)
    axis.set(title="load on the soles", ylabel="N")
    axis.legend(fontsize=6)
