"""Small interactions with a known structure, for tests that need recordings."""

from __future__ import annotations

import math
import os
from pathlib import Path

import pytest

# One thread a process, here and in what is started from here: as many tests run side by side as there are cores, and
# threads that wait for each other take ten times as long.
os.environ.setdefault("OMP_NUM_THREADS", "1")
import torch
from hypothesis import settings

from torch_ebip import BSplineBasis, Demonstrations, InteractionPrimitive, Layout, Modality, StackedBasis

torch.set_num_threads(1)
# The same examples each time; HYPOTHESIS_PROFILE=random looks for new ones.
settings.register_profile("fixed", derandomize=True, deadline=None)
settings.register_profile("random", deadline=None)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "fixed"))
LONG = (
    "test_ranks.py",
    "test_tune.py",
    "test_soak.py",
    "test_catch.py",
    "test_rerun.py",
    "test_full_disk.py",
    "test_kill.py",
    "test_compare.py",
    "test_interrupts.py",
    "test_faults.py",
    "test_fuzz.py",
    "test_tuning.py",
    "test_session.py",
)
"""What takes longest, which is begun first: otherwise one core would work on it at the end, and the other wait."""
SHARED = Path(__file__).parents[2] / "shared" / "data" / "handover.npz"


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files that take long first; the others in their order."""
    items.sort(key=lambda item: next((i for i, name in enumerate(LONG) if name in item.nodeid), len(LONG)))


def layout() -> Layout:
    """Two observed modalities and a controlled one."""
    return Layout(
        [
            Modality("hand", ["hand.x", "hand.y"], "m"),
            Modality("gaze", ["gaze.yaw"], "rad"),
            Modality("arm", ["arm.1", "arm.2"], "rad", controlled=True),
        ]
    )


def interactions(count: int = 24, seed: int = 0, dtype: torch.dtype = torch.float32) -> Demonstrations:
    """Smooth trajectories of two hidden causes, a few of them with gaps, 30 to 50 samples at 30 Hz."""
    generator = torch.Generator().manual_seed(seed)
    trajectories = []
    for index in range(count):
        length = int(torch.randint(30, 51, (), generator=generator))
        phase = torch.linspace(0, 1, length, dtype=torch.float64)
        a, b = torch.randn(2, generator=generator, dtype=torch.float64)
        columns = [
            a * phase + 0.1 * torch.sin(math.pi * phase),
            (1 + 0.3 * b) * torch.cos(math.pi * phase),
            0.5 * a * torch.sin(math.pi * phase / 2),
            (a + 0.3 * b) * phase.square(),
            1 + 0.5 * b * phase.pow(3),
        ]
        values = torch.stack(columns, -1)
        values = values + 0.01 * torch.randn(values.shape, generator=generator, dtype=torch.float64)
        if index % 5 == 0:
            values[5:9, 0] = math.nan
        trajectories.append(values.to(dtype))
    return Demonstrations(layout(), trajectories, 30.0)


@pytest.fixture
def demonstrations() -> Demonstrations:
    return interactions()


@pytest.fixture
def primitive() -> InteractionPrimitive:
    return small_primitive()


def small_primitive(dtype: torch.dtype = torch.float32, count: int = 24) -> InteractionPrimitive:
    """A primitive with six B-splines a DoF."""
    return InteractionPrimitive.fit(interactions(count, dtype=dtype), StackedBasis([BSplineBasis(6)] * 5))


@pytest.fixture
def handover() -> Demonstrations:
    if not SHARED.exists():
        pytest.skip("the real recordings are not here")
    return Demonstrations.load(SHARED)
