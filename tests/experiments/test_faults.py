"""Faults do what they say, and the study tells what they cost."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from experiments.evaluate import FilterMethod, Task
from experiments.faults import __main__ as study
from experiments.faults.faults import (
    GROUPS,
    Fault,
    catalogue,
    drift,
    dropouts,
    frozen,
    jitter,
    lost,
    spikes,
    suffer,
    swapped,
)
from experiments.faults.jobs import _answers
from experiments.faults.table import summarise, verdicts
from experiments.results import Cell
from tests.conftest import interactions, small_primitive
from torch_ebip import Demonstrations, Layout, Modality, StudentT, ebip

LAYOUT = Layout(
    [
        Modality("left", ["l1", "l2"], "N"),
        Modality("right", ["r1", "r2"], "N"),
        Modality("arm", ["a1"], "rad", controlled=True),
    ]
)
SENSORS = ("left", "right")
DEVIATION = torch.tensor([1.0, 2.0, 3.0, 4.0, 5.0])


def recording(length: int = 100) -> Tensor:
    """Every value says where it stands: 1000 x column + row."""
    return torch.arange(length).unsqueeze(-1) + 1000.0 * torch.arange(5)


def said(damage, trajectory: Tensor | None = None, seed: int = 0) -> Tensor:
    """What sensors make of one recording at 60 Hz."""
    tests = Demonstrations(LAYOUT, [recording() if trajectory is None else trajectory], 60.0)
    fault = Fault("it", "group", None, damage)
    return suffer(fault, tests, SENSORS, DEVIATION, [7], seed)[0]


def test_a_lost_sensor_is_silent_for_its_share_only() -> None:
    found = said(lost("left", 0.2, 0.6))
    gone = torch.zeros(100, 5, dtype=torch.bool)
    gone[20:60, :2] = True
    assert torch.equal(found.isnan(), gone)
    assert torch.equal(found[~gone], recording()[~gone])


def test_a_frozen_sensor_repeats_its_last_values() -> None:
    trajectory = recording()
    trajectory[48:60, 0] = math.nan
    found = said(frozen("left", 0.5), trajectory)
    assert (found[50:, 0] == 47).all()
    assert (found[50:, 1] == 1050).all()
    assert torch.equal(found[:50, 1:], trajectory[:50, 1:])
    trajectory[:60, 0] = math.nan
    assert said(frozen("left", 0.5), trajectory)[:, 0].isnan().all()  # it never had one


def test_spikes_are_as_many_and_as_large_as_asked() -> None:
    clean = recording(4000)
    found = said(spikes(10.0, 0.1), clean)
    off = (found - clean) / DEVIATION
    assert set(off[:, :4].unique().tolist()) == {-10.0, 0.0, 10.0}
    assert (off[:, 4] == 0).all()  # the arm is no sensor
    hit = off[:, :4] != 0
    assert torch.equal(hit[:, 0], hit[:, 1])
    assert 0.085 < hit[:, 0].float().mean() < 0.115
    assert not torch.equal(hit[:, 0], hit[:, 2])
    assert torch.equal(found, said(spikes(10.0, 0.1), clean))
    assert not torch.equal(found, said(spikes(10.0, 0.1), clean, seed=1))


def test_a_drift_grows_to_its_size() -> None:
    off = (said(drift("right", 2.0)) - recording()) / DEVIATION
    assert (off[:, :2] == 0).all()
    torch.testing.assert_close(off[-1, 2:4].square().mean().sqrt(), torch.tensor(2.0), rtol=1e-4, atol=0)
    torch.testing.assert_close(off[50, 2:4], off[-1, 2:4] * 50 / 99, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("length", [1, 10])
def test_dropouts_are_as_long_and_as_many_as_asked(length: int) -> None:
    gone = said(dropouts(0.2, length), recording(6000)).isnan()
    assert 0.17 < gone[:, 0].float().mean() < 0.23
    assert not gone[:, 4].any()
    runs = "".join(map(str, gone[:, 0].int().tolist())).strip("1").split("0")
    assert min(len(run) for run in runs if run) == length


def test_late_samples_are_older_ones() -> None:
    clean = recording()
    late = clean - said(jitter(0.1), clean)
    assert set(late[10:, :4].unique().tolist()) == {0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0}
    assert torch.equal(late[:, 0], late[:, 1])
    assert (late[:, 4] == 0).all()


def test_swapped_sensors_are_exchanged() -> None:
    assert said(swapped("left", "right"))[0].tolist() == [2000.0, 3000.0, 0.0, 1000.0, 4000.0]


def test_every_fault_is_in_the_catalogue_once() -> None:
    faults = catalogue(LAYOUT, SENSORS, (0.2, 0.43, 0.6))
    assert len({fault.name for fault in faults}) == len(faults)
    counts = {group: sum(fault.group == group for fault in faults) for group in GROUPS}
    expected = {"clean": 1, "without": 2, "lost": 6, "back": 2, "frozen": 2, "spikes": 4, "drift": 2, "missing": 2}
    assert counts == {**expected, "jitter": 1, "swapped": 0}


def test_costs_are_paired_ratios_of_means() -> None:
    rng = np.random.default_rng(0)
    base = rng.exponential(size=40)
    faults = [
        Fault(name, group, sensor, lost("left", 0))
        for name, group, sensor in (
            ("clean", "clean", None),
            ("without left", "without", "left"),
            ("left lost at 20%", "lost", "left"),
            ("spikes", "spikes", None),
        )
    ]
    errors = {"clean": base, "without left": 2 * base, "left lost at 20%": 2.2 * base, "spikes": np.full(40, np.inf)}
    values = {Cell(name, 0.8, "mse", "arm", "rad^2"): {"it": array} for name, array in errors.items()}
    results = summarise(values, faults, "arm", 0)
    costs = {cost["fault"]: cost for cost in results["costs"]}
    assert costs["without left"]["cost"] == pytest.approx(1.0)
    assert costs["left lost at 20%"]["cost"] == pytest.approx(0.1)
    assert costs["left lost at 20%"]["against"] == "without left"
    assert costs["left lost at 20%"]["low"] == pytest.approx(0.1)  # pairs do not vary
    assert costs["spikes"]["gave_up"] == 40
    assert costs["spikes"]["cost"] is None
    assert "it gives up on 40 interactions (spikes)" in "\n".join(verdicts(results))
    assert next(row for row in results["rows"] if row["subset"] == "spikes")["gave_up"] == 40
    assert "+10 %" in "\n".join(verdicts(results))


def test_a_filter_that_gives_up_on_one_interaction_answers_the_others() -> None:
    """1e30 where a metre was expected: the plain filter's error names it, the robust one goes on."""
    tests = interactions(3, seed=7)
    values = [trajectory.clone() for trajectory in tests]
    values[1][3:9, :3] = 1e30
    shown = Demonstrations(tests.layout, values, tests.rate)
    task = Task({"human": ("hand", "gaze")}, (0.8,), [], ("arm",), {}, None)
    for robust, failing in ((None, [1]), (StudentT(), [])):
        method = FilterMethod(ebip(small_primitive(), robust=robust), 0, dtype=torch.float32)
        found = _answers(task, method, tests, shown, range(3))
        cell = next(cell for cell in found if cell.metric == "mse")
        assert np.flatnonzero(~np.isfinite(found[cell])).tolist() == failing


def test_the_study_end_to_end(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "run"
    arguments = ["--quick", "--demonstrations", "30", "--faults", "spikes", "--members", "20", "--workers", "1"]
    study.main([*arguments, "--methods", "ebip", "ebip_student", "bip", "--out", str(out)])
    assert "spikes, worst against clean" in capsys.readouterr().out
    results = json.loads((out / "results.json").read_text())
    assert [fault["group"] for fault in results["faults"]] == ["clean", *["spikes"] * 4]
    joints = [row for row in results["rows"] if (row["metric"], row["modality"]) == ("mse", "robot")]
    rows = {(row["subset"], row["method"]): row for row in joints}
    assert rows["clean", "ebip"]["n"] == 2
    assert rows["clean", "bip"]["n"] == 2
    assert (out / "faults.png").stat().st_size > 10_000
    assert "spikes of 1000 sd, 10%" in (out / "results.md").read_text()
