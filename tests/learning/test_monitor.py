"""What TensorBoard shows, read back from the real server over HTTP."""

import json
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest
import torch

from tests.conftest import small_primitive
from tests.learning.test_tuning import filter_and_tuner
from tests.listening import addresses
from torch_ebip import StudentT, ebip
from torch_ebip.learning.monitor import Monitor, noise_scalars


def free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return int(listener.getsockname()[1])


@pytest.fixture
def served(tmp_path: Path) -> Iterator[str]:
    """A tuning run with everything a run reports, behind a TensorBoard server on the loopback address."""
    plt = pytest.importorskip("matplotlib.pyplot")
    with Monitor(tmp_path) as monitor:
        filter_and_tuner(monitor=monitor)[1].run()
        monitor.text("configuration", "- `seed`: 3")
        figure, axis = plt.subplots()
        axis.plot([0, 1])
        monitor.figure("forecast", figure, 0)
        monitor.hyperparameters({"seed": 3, "only": ("*",)}, {"final/mse": 0.5})
    port = free_port()
    command = [sys.executable, "-m", "tensorboard.main", "--logdir", str(tmp_path), "--port", str(port)]
    server = subprocess.Popen([*command, "--load_fast=false"], stderr=subprocess.PIPE)
    try:
        yield f"http://127.0.0.1:{port}/data"
    finally:
        server.terminate()
        server.wait(20)
        assert server.stderr is not None
        server.stderr.close()


def get(url: str, ready=bool) -> object:
    """JSON behind a URL, once the server is up and has read the events."""
    deadline = time.monotonic() + 90
    while True:
        try:
            with urllib.request.urlopen(url, timeout=10) as answer:
                content = json.load(answer)
            if ready(content):
                return content
        except OSError:
            pass
        if time.monotonic() > deadline:
            raise AssertionError(f"{url} did not answer in time")
        time.sleep(0.5)


def test_tags_read_back_over_http(served: str) -> None:
    tags = get(f"{served}/plugin/scalars/tags", lambda c: any("calibration/spread" in run for run in c.values()))
    names = {name for run in tags.values() for name in run}
    expected = {
        *("train/loss", "train/crps", "train/squared_error", "train/pull", "train_subset/hand", "train_subset/both"),
        *("validation/loss", "validation/crps", "validation/squared_error", "validation/subset/both"),
        *("R/hand", "R/gaze", "R_factor/hand.x", "R_phase/gaze/0.50", "Q/phase_acceleration", "inflation"),
        *("gradient/norm", "gradient/model.measurement_noise.variance.raw", "throughput/samples_per_second"),
        *("calibration/spread", "calibration/error", "calibration/spread_over_error", "weighting/sharpness"),
        "final/mse",
    }
    assert expected <= names, expected - names
    assert addresses(port=int(served.rsplit(":", 1)[1].split("/")[0])) == {"127.0.0.1"}  # unless it is told otherwise
    run = next(run for run, found in tags.items() if "validation/loss" in found)
    points = get(f"{served}/plugin/scalars/scalars?tag=validation%2Floss&run={urllib.request.quote(run)}")
    assert [step for _, step, _ in points] == [0, 4, 8, 12]
    images = get(f"{served}/plugin/images/tags")
    assert any("forecast" in found for found in images.values())
    texts = get(f"{served}/plugin/text/tags")
    assert any("configuration" in name for found in texts.values() for name in found)


def test_constrained_values_are_logged_not_raw_ones() -> None:
    made, tuner = filter_and_tuner()
    values = noise_scalars(made, tuner.layout)
    closed = tuner.primitive.residual_variance.sqrt()
    assert values["R/gaze"] == pytest.approx(float(closed[2]), rel=1e-4)
    assert values["R/hand"] == pytest.approx(float((closed[0] * closed[1]).sqrt()), rel=1e-4)
    assert values["inflation"] == pytest.approx(1.01)
    with torch.no_grad():
        made.model.measurement_noise.gates[-1, 1] = 1.0
        made.model.measurement_noise.variance.raw[2] = 2.0
    values = noise_scalars(made, tuner.layout)
    assert values["R_phase/gaze/1.00"] == pytest.approx(2.718, rel=1e-3)
    assert values["R_phase/gaze/0.00"] == pytest.approx(1.0)
    assert values["R/gaze"] == pytest.approx(float(closed[2]) * 2.718, rel=1e-3)


def test_the_tails_of_a_robust_filter_are_logged() -> None:
    _, tuner = filter_and_tuner()
    values = noise_scalars(ebip(tuner.primitive, robust=StudentT(3.0)), tuner.layout)
    assert values["R_robust/StudentT"] == pytest.approx(3.0)


def test_what_is_learned_beside_r_is_logged() -> None:
    primitive = small_primitive()
    made = ebip(primitive, localise=True, weight_noise=0.2)
    values = noise_scalars(made, primitive.layout)
    assert {name for name in values if name.startswith("Q/weights/")} == {
        f"Q/weights/{name}" for name in primitive.layout.names
    }
    assert values["Q/weights/arm"] == pytest.approx(0.2)
    matrix = made.analysis.localisation.matrix.detach()
    for i, j, name in ((0, 1, "hand~gaze"), (0, 2, "hand~arm"), (1, 2, "gaze~arm")):
        assert values[f"localisation/{name}"] == pytest.approx(float(matrix[i, j]))
    assert not any(name.startswith("R_phase") for name in values)  # R does not depend on phase here


def test_a_disk_that_fails_ends_the_record_and_not_the_tuning(tmp_path: Path) -> None:
    class Full:
        """A writer whose disk is full from the second point on."""

        points = 0

        def add_scalar(self, *_: object) -> None:
            self.points += 1
            if self.points > 1:
                raise OSError(28, "No space left on device")

    monitor = Monitor(tmp_path)
    monitor.close()
    monitor._writer = full = Full()
    monitor.scalars({"a": 1.0}, 0)
    with pytest.warns(UserWarning, match=r"what TensorBoard shows ends here: .*No space left"):
        monitor.scalars({"a": 1.0}, 1)
    monitor.scalars({"a": 1.0}, 2)
    monitor.close()
    assert full.points == 2
