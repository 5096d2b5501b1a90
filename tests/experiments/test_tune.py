"""The main job at a small size, through its command line: what it writes, resumes, refuses."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from experiments import tune
from experiments.data import load
from experiments.evaluate import FilterMethod, MeanMethod, NearestMethod, Task, evaluate
from experiments.folds import split
from experiments.methods import Problem, Start, best_factor, best_start, restore, scaled, tunable
from tests.conftest import interactions, small_primitive
from torch_ebip import BSplineBasis, Demonstrations, InteractionPrimitive, Layout, Modality, select_basis

SMALL = ["--steps", "3", "--quick", "--seed", "5"]


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("data") / "made.npz"
    interactions(30).save(path)
    return str(path)


@pytest.fixture(scope="module")
def finished(recordings: str, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "run"
    tune.main(["--data", recordings, *SMALL, "--out", str(out)])
    return out


def test_a_run_folder_is_complete(finished: Path) -> None:
    names = {path.name for path in finished.iterdir()}
    assert {"config.json", "results.json", "results.png", "forecasts.png", "noise.png", "checkpoint.pt"} <= names
    assert list((finished / "tensorboard").glob("events*"))
    results = json.loads((finished / "results.json").read_text())
    assert results["experiment"] == "tune"
    methods = {row["method"] for row in results["rows"]}
    assert methods == {"mean", "nearest", "ebip", "ebip_scaled", "ebip_tuned"}
    assert {row["observed"] for row in results["rows"]} == {0.43, 0.82}
    assert {row["metric"] for row in results["rows"]} == {"mse", "mae", "coverage_95", "crps", "phase_error"}
    assert all(row["n"] == 6 for row in results["rows"])


def test_a_finished_run_stops(finished: Path, recordings: str) -> None:
    with pytest.raises(SystemExit, match="finished run"):
        tune.main(["--data", recordings, *SMALL, "--out", str(finished)])


def test_the_tuned_filter_can_be_restored(finished: Path, recordings: str) -> None:
    demonstrations = Demonstrations.load(recordings)
    training, testing = split(30, 1, 0, 5)
    primitive = InteractionPrimitive.fit(demonstrations.subset(training))
    method = FilterMethod(restore(finished, primitive), 5)
    task = Task({"all": ["hand", "gaze"]}, (0.43, 0.82), [], ["arm"], {}, None)
    values = evaluate(task, {"ebip_tuned": method}, demonstrations.subset(testing))
    rows = json.loads((finished / "results.json").read_text())["rows"]
    for cell, methods in values.items():
        row = next(
            r for r in rows if (r["method"], r["metric"], r["observed"]) == ("ebip_tuned", cell.metric, cell.observed)
        )
        assert methods["ebip_tuned"].mean() == pytest.approx(row["mean"], rel=1e-3), cell


def test_two_runs_of_a_seed_agree(finished: Path, recordings: str, tmp_path: Path) -> None:
    tune.main(["--data", recordings, *SMALL, "--out", str(tmp_path / "again")])
    first, second = (json.loads((path / "results.json").read_text()) for path in (finished, tmp_path / "again"))
    assert [row["mean"] for row in first["rows"]] == pytest.approx([row["mean"] for row in second["rows"]], rel=1e-4)


def test_a_killed_run_resumes_to_the_same_table(tmp_path: Path) -> None:
    """Two folds in processes of their own; killed while the second is tuning, with its checkpoint written."""
    interactions(20).save(tmp_path / "made.npz")
    arguments = [
        "--data",
        str(tmp_path / "made.npz"),
        "--quick",
        "--steps",
        "10",
        "--folds",
        "2",
        "--workers",
        "1",
        "--out",
    ]
    command = [sys.executable, "-m", "experiments.tune", *arguments]
    root = Path(tune.__file__).parents[1]
    run = tmp_path / "killed"
    started = subprocess.Popen([*command, str(run)], cwd=root, start_new_session=True, stderr=subprocess.DEVNULL)
    deadline = time.monotonic() + 400
    while not (run / "fold-01" / "checkpoint.pt").exists() and time.monotonic() < deadline:
        time.sleep(0.01)
    os.killpg(started.pid, signal.SIGKILL)
    started.wait()
    assert not (run / "fold-01" / "values.json").exists()
    kept = (run / "fold-00" / "values.json").stat().st_mtime_ns
    subprocess.run([*command, str(run)], cwd=root, check=True, capture_output=True)
    assert (run / "fold-00" / "values.json").stat().st_mtime_ns == kept
    subprocess.run([*command, str(tmp_path / "whole")], cwd=root, check=True, capture_output=True)
    resumed, whole = (json.loads((path / "results.json").read_text()) for path in (run, tmp_path / "whole"))
    assert resumed["rows"] == whole["rows"]
    assert all(row["n"] == 20 for row in whole["rows"])


def test_test_interactions_are_seen_by_nobody() -> None:
    tests = []
    for fold in range(5):
        training, testing = split(31, 5, fold, 3)
        assert not set(training.tolist()) & set(testing.tolist())
        tests += testing.tolist()
    assert sorted(tests) == list(range(31))
    assert len(split(30, 1, 0, 3)[1]) == 6


def test_a_target_is_never_shown(recordings: str) -> None:
    """The controlled DoFs reach no method before phase 1: garbage there changes no answer."""
    made = interactions(6, seed=3)
    task = Task({"all": ["hand", "gaze"]}, (0.43, 0.82), [], ["arm"], {}, None)
    primitive = small_primitive()
    methods = {
        "ebip": FilterMethod(scaled(primitive, 10.0), 0),
        "nearest": NearestMethod(primitive),
        "mean": MeanMethod(primitive),
    }
    spoiled = [trajectory.clone() for trajectory in made]
    for trajectory in spoiled:
        trajectory[:-1, 3:] = 99.0
        trajectory[int(0.9 * len(trajectory)) :, :3] = 99.0  # nor is what comes after the fraction
    a = evaluate(task, methods, made)
    b = evaluate(task, methods, Demonstrations(made.layout, spoiled, made.rate))
    for cell, values in a.items():
        for name, array in values.items():
            np.testing.assert_array_equal(array, b[cell][name], err_msg=f"{cell} {name}")


def test_nearest_finds_the_same_interaction() -> None:
    made = interactions()
    task = Task({"all": ["hand", "gaze"]}, (0.82,), [], ["arm"], {}, None)
    values = evaluate(
        task, {"nearest": NearestMethod(small_primitive()), "mean": MeanMethod(small_primitive())}, made
    )
    mae = next(methods for cell, methods in values.items() if cell.metric == "mae")
    assert np.median(mae["nearest"]) < 0.05
    assert np.median(mae["mean"]) > 0.2


def test_the_best_factor_does_not_wander_when_asked_again(tmp_path: Path) -> None:
    primitive, made = small_primitive(), interactions()
    subsets = {"all": torch.tensor([True, True, True, False, False])}
    problem = Problem(made, primitive, ~subsets["all"], subsets, None)
    settings = tune.TuningSettings(folds=4, thinning=2)
    answers = [best_factor(problem, scaled, settings, 8, [1.0, 10.0], tmp_path / "scan.json") for _ in range(3)]
    assert len(set(answers)) == 1
    losses = {float(k): v for k, v in json.loads((tmp_path / "scan.json").read_text()).items()}
    assert len(losses) == 4
    assert answers[0] == min(losses, key=lambda factor: losses[factor])


def test_the_start_is_the_best_of_the_grid(tmp_path: Path) -> None:
    made = interactions(30)
    primitive = InteractionPrimitive.fit(made, select_basis(made, [BSplineBasis(6)]))
    layout = made.layout
    problem = Problem(made, primitive, layout.mask(["arm"]), {"all": layout.mask(["hand", "gaze"])}, None)
    settings = tune.TuningSettings(folds=4, thinning=2)
    start = best_start(problem, settings, 6, 100.0, tmp_path / "scan.json")
    losses = json.loads((tmp_path / "scan.json").read_text())
    assert len(losses) == 9
    best = min(losses, key=lambda entry: entry["loss"])
    assert start == Start(best["factor"], best["sharpness"])
    filter = tunable(primitive, start)
    assert filter.analysis.weighting.sharpness.value.item() == pytest.approx(start.sharpness)
    ratio = filter.model.measurement_noise.variance.value / primitive.residual_variance
    assert ratio.mean().item() == pytest.approx(start.factor, rel=1e-4)
    assert best_start(problem, settings, 6, 100.0, tmp_path / "scan.json") == start


def test_the_simulated_task_has_the_papers_nine_cells() -> None:
    demonstrations, task = load(None, 16, 0)
    primitive = InteractionPrimitive.fit(
        demonstrations.subset(range(12)), select_basis(demonstrations, [BSplineBasis(8)])
    )
    tests = demonstrations.subset(range(12, 16))
    values = evaluate(task, {"ebip_tuned": FilterMethod(tunable(primitive, Start(100.0, 10.0)), 0)}, tests)
    cells = {(cell.subset, cell.observed) for cell in values}
    assert len(cells) == 9
    assert ("ball", 0.43) not in cells
    metrics = {(cell.metric, cell.modality, cell.unit) for cell in values}
    assert {
        ("mse", "robot", "rad^2"),
        ("mae", "ball", "m"),
        ("tool_error", None, "m"),
        ("phase_error", None, "1"),
    } <= metrics
    # The squared error is of the first three joints, the tool's through forward kinematics.
    cell = next(c for c in values if (c.metric, c.modality, c.subset, c.observed) == ("mse", "robot", "ball", 0.82))
    method = FilterMethod(tunable(primitive, Start(100.0, 10.0)), 0)
    y, measured = tests.pad()
    steps = (tests.lengths * 0.82).round().long().unsqueeze(-1) - 1
    both = torch.cat([(tests.lengths * 0.43).round().long().unsqueeze(-1) - 1, steps], -1)
    length = int(steps.max()) + 1
    shown = (
        measured[:, :length]
        & tests.layout.mask(["ball"])
        & (torch.arange(length).view(1, -1, 1) <= steps.unsqueeze(-1))
    )
    answer = method(y[:, :length], shown, both, tests.layout.mask(task.targets))
    robot = answer.forecast.mean[:, 1, 3:]
    truth = torch.stack([trajectory[-1, tests.layout.slice("robot")] for trajectory in tests])
    np.testing.assert_allclose(values[cell]["ebip_tuned"], (robot - truth)[:, :3].square().mean(-1), rtol=1e-4)
    tool = next(c for c in values if (c.metric, c.subset, c.observed) == ("tool_error", "ball", 0.82))
    arm = task.arm[0]
    distance = (arm(robot)[:, :3, 3] - arm(truth)[:, :3, 3]).norm(dim=-1)
    np.testing.assert_allclose(values[tool]["ebip_tuned"], distance, rtol=1e-4)


def test_tuning_through_the_arm_reaches_the_noise() -> None:
    demonstrations, task = load(None, 16, 0)
    primitive = InteractionPrimitive.fit(demonstrations, select_basis(demonstrations, [BSplineBasis(8)]))
    layout = demonstrations.layout
    subsets = {name: layout.mask(names) for name, names in task.subsets.items()}
    problem = Problem(
        demonstrations, primitive, layout.mask(task.targets), subsets, (task.arm[0], layout.mask(["robot"]))
    )
    filter = tunable(primitive, Start(100.0, 10.0))
    settings = tune.TuningSettings(steps=2, batch_size=4, validate_every=1, folds=2)
    result = tune.tune(problem, filter, settings, None, None, None)
    assert set(result.validation) == {0, 1, 2}
    assert problem.objective().weights.tool == 1.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--data", "nowhere.npz"], "nowhere.npz"),
        (["--folds", "31"], "--folds must be between 1 and the 30"),
        (["--folds", "0"], "--folds must be between"),
        (["--demonstrations", "0"], "--demonstrations must be at least 1"),
    ],
)
def test_bad_arguments_are_named(arguments: list[str], message: str, recordings: str, tmp_path: Path) -> None:
    base = [] if "--data" in arguments else ["--data", recordings]
    with pytest.raises(SystemExit, match=message):
        tune.main([*base, *arguments, "--out", str(tmp_path / "run")])
    assert not (tmp_path / "run").exists()


def test_too_few_recordings_are_refused_before_any_work(tmp_path: Path) -> None:
    for count in (2, 6, 11):
        interactions(count).save(tmp_path / "few.npz")
        with pytest.raises(SystemExit, match=f"{count} demonstrations with . held out are too few"):
            tune.main(["--data", str(tmp_path / "few.npz"), "--out", str(tmp_path / "run")])
        assert not (tmp_path / "run").exists()


def test_recordings_without_a_controlled_modality_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "watch.npz"
    made = interactions(12)
    layout = Layout([Modality("hand", ["hand.x", "hand.y"], "m")])
    Demonstrations(layout, [trajectory[:, :2] for trajectory in made], 30.0).save(path)
    with pytest.raises(SystemExit, match="needs observed and controlled"):
        tune.main(["--data", str(path)])
