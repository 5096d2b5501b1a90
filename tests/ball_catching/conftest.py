"""One simulated session and one data set, shared by all tests of the simulation."""

import time

import numpy as np
import pytest

from experiments.ball_catching import generate, teacher
from experiments.ball_catching.dataset import Session, simulate
from torch_ebip import Demonstrations


@pytest.fixture(scope="session")
def session() -> Session:
    return simulate(np.random.default_rng(7), teacher.arm())


@pytest.fixture(scope="session")
def timed_demonstrations() -> tuple[Demonstrations, float]:
    start = time.process_time()
    demonstrations = generate()
    return demonstrations, time.process_time() - start


@pytest.fixture(scope="session")
def demonstrations(timed_demonstrations: tuple[Demonstrations, float]) -> Demonstrations:
    return timed_demonstrations[0]
