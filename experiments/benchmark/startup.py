"""Start-up: what a process pays before it can forecast, each in new interpreters."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from statistics import median
from typing import Any

import torch

from torch_ebip import Demonstrations, Layout, Modality

SCRIPT = """
import time
began = time.perf_counter()
import torch
torch.set_num_threads(1)
torched = time.perf_counter()
import torch_ebip
imported = time.perf_counter()
demonstrations = torch_ebip.Demonstrations.load({path!r})
basis = torch_ebip.StackedBasis([torch_ebip.GaussianBasis(13)] * demonstrations.layout.n_dofs)
primitive = torch_ebip.InteractionPrimitive.fit(demonstrations, basis)
fitted = time.perf_counter()
sensors = ~demonstrations.layout.controlled
live = torch_ebip.LiveFilter(torch_ebip.ebip(primitive), sensors)
live.update(demonstrations[0][0], sensors)
live.forecast(torch.ones(1), ~sensors)
print(torched - began, imported - torched, fitted - imported, time.perf_counter() - fitted)
"""


def startup(folder: Path, repeats: int) -> dict[str, Any]:
    """Median seconds: import of torch, of this package on top, fitting 80 recordings, and to the first forecast."""
    path = folder / "startup.npz"
    _recordings(80).save(path)
    runs = []
    for _ in range(repeats):
        done = subprocess.run(
            [sys.executable, "-c", SCRIPT.format(path=str(path))], capture_output=True, text=True, check=True
        )
        runs.append([float(word) for word in done.stdout.split()])
    path.unlink()
    names = ("import_torch", "import_torch_ebip", "fit", "first_forecast")
    return dict(zip(names, (median(column) for column in zip(*runs, strict=True)), strict=True))


def _recordings(count: int) -> Demonstrations:
    """43 DoFs, 60 to 100 samples at 60 Hz."""
    generator = torch.Generator().manual_seed(0)
    layout = Layout(
        [
            Modality("sensors", [f"s{i}" for i in range(37)], "m"),
            Modality("robot", [f"r{i}" for i in range(6)], "rad", controlled=True),
        ]
    )
    trajectories = []
    for _ in range(count):
        length = int(torch.randint(60, 101, (), generator=generator))
        phase = torch.linspace(0, 1, length).unsqueeze(-1)
        a, b = torch.randn(2, 43, generator=generator)
        trajectories.append(
            a * phase + b * torch.sin(3 * phase) + 0.01 * torch.randn(length, 43, generator=generator)
        )
    return Demonstrations(layout, trajectories, 60.0)
