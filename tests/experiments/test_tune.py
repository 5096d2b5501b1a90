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
from tests.conftest import interactions, small_primitive
from torch_ebip import (
    BSplineBasis,
    Demonstrations,
    InteractionPrimitive,
    Layout,
    Modality,
    RobotArm,
    load_model,
    select_basis,
)
from torch_ebip.learning.starts import Start, scaled, tunable
from torch_ebip.recordings import example

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
    assert {
        "config.json",
        "results.json",
        "results.png",
        "horizons.png",
        "forecasts.png",
        "noise.png",
        "checkpoint.pt",
    } <= names
    assert {"model.safetensors", "report.json", "learning.json", "basis.txt"} <= names
    assert list((finished / "tensorboard").glob("events*"))
    results = json.loads((finished / "results.json").read_text())
    assert results["experiment"] == "tune"
    methods = {row["method"] for row in results["rows"]}
    assert methods == {"mean", "nearest", "ebip", "ebip_scaled", "ebip_tuned"}
    assert {row["observed"] for row in results["rows"]} == {0.43, 0.82}
    assert {row["metric"] for row in results["rows"]} == {"mse", "mae", "coverage_95", "crps", "phase_error"}
    assert all(row["n"] == 6 for row in results["rows"] if "ahead" not in row)
    assert {row["ahead"] for row in results["rows"] if "ahead" in row} >= {0.1, 0.25, 0.5}


def test_a_finished_run_stops(finished: Path, recordings: str) -> None:
    with pytest.raises(SystemExit, match="finished run"):
        tune.main(["--data", recordings, *SMALL, "--out", str(finished)])


def test_a_run_folder_holds_the_model_of_its_table(finished: Path, recordings: str) -> None:
    demonstrations = Demonstrations.load(recordings)
    _, testing = split(30, 1, 0, 5)
    method = FilterMethod(load_model(finished).filter, 5)
    task = Task({"all": ["hand", "gaze"]}, (0.43, 0.82), [], ["arm"], {}, None)
    values = evaluate(task, {"ebip_tuned": method}, demonstrations.subset(testing))
    rows = json.loads((finished / "results.json").read_text())["rows"]
    rows = [row for row in rows if "ahead" not in row]
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
    assert all(row["n"] == 20 for row in whole["rows"] if "ahead" not in row)


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
    cell = next(c for c in values if tuple(c) == ("ball", 0.82, "mse", "robot", "rad^2", None))
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
    robot = answer.forecast.mean[:, 1, 0, 3:]
    truth = torch.stack([trajectory[-1, tests.layout.slice("robot")] for trajectory in tests])
    np.testing.assert_allclose(values[cell]["ebip_tuned"], (robot - truth)[:, :3].square().mean(-1), rtol=1e-4)
    tool = next(c for c in values if tuple(c) == ("ball", 0.82, "tool_error", None, "m", None))
    arm = task.arm[0]
    distance = (arm(robot)[:, :3, 3] - arm(truth)[:, :3, 3]).norm(dim=-1)
    np.testing.assert_allclose(values[tool]["ebip_tuned"], distance, rtol=1e-4)


def test_final_learns_from_all_recordings(recordings: str, tmp_path: Path) -> None:
    out = tmp_path / "run"
    tune.main(["--data", recordings, "--quick", "--steps", "1", "--final", "--out", str(out)])
    assert len(load_model(out).primitive) == 24
    model = load_model(out / "final")
    assert len(model.primitive) == model.report["demonstrations"] == 30


def test_a_folder_of_csv_with_an_arm_of_ones_own(tmp_path: Path) -> None:
    """Roles are given, joints are taken by name in whatever order, the tool's error is in the table."""
    made = example().subset(range(14))
    data = tmp_path / "data"
    data.mkdir()
    order = [*range(5), 10, 9, 8, 7, 6, 5]
    names = [made.layout.dofs[i] for i in order]
    text = ['rate = 30.0', *(
        f'[[modalities]]\nname = "{name}"\ndofs = {json.dumps(dofs)}\nunit = "{unit}"'
        for name, dofs, unit in (("hand", names[:3], "m"), ("gaze", names[3:5], "rad"), ("robot", names[5:], "rad"))
    )]  # fmt: skip
    (data / "layout.toml").write_text("\n".join(text))
    for i, trajectory in enumerate(made):
        rows = [",".join(names), *(",".join(f"{v:.6f}" for v in row) for row in trajectory[:, order].tolist())]
        (data / f"{i:02d}.csv").write_text("\n".join(rows))
    urdf = Path(tune.__file__).parents[1] / "torch_ebip" / "kinematics" / "ur5.urdf"
    arguments = ["--data", str(data), "--targets", "robot", "--sensors", "hand", "--steps", "1", "--quick"]
    arguments += ["--arm", str(urdf), "--tip", "flange", "--members", "8", "--out", str(tmp_path / "run")]
    tune.main(arguments)
    results = json.loads((tmp_path / "run" / "results.json").read_text())
    model = load_model(tmp_path / "run")
    assert model.sensors == ("hand",)
    assert model.layout.names == ("hand", "robot")
    assert model.filter.n_members == 8
    assert "tool" in model.report["stages"]["start"]
    rows = [row for row in results["rows"] if row["metric"] == "tool_error"]
    error = {(row["method"], row["observed"]): row["mean"] for row in rows}
    training, testing = split(14, 1, 0, 0)
    arm, joints = RobotArm.ur5(), made.layout.mask(["robot"])
    ends = torch.stack([trajectory[-1, joints] for trajectory in made])
    mean = InteractionPrimitive.fit(made.subset(training))
    basis = mean.basis.project(torch.ones(len(mean)), mean.weights).mean(0)[joints]
    there, here = arm(ends[testing])[:, :3, 3], arm(basis)[:3, 3]
    assert error["mean", 0.82] == pytest.approx(float((there - here).norm(dim=-1).mean()), rel=1e-3)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--data", "nowhere.npz"], "nowhere.npz"),
        (["--folds", "31"], "--folds must be between 1 and the 30"),
        (["--folds", "0"], "--folds must be between"),
        (["--demonstrations", "0"], "--demonstrations must be at least 1"),
        (["--members", "1"], "--members must be at least 2"),
        (["--targets", "leg"], "no modality 'leg'"),
        (["--sensors", "hand", "hand"], "sensors must be different names"),
        (["--sensors", "hand", "--subsets", "gaze"], "'gaze' is no sensor"),
        (["--arm", "nowhere.urdf", "--tip", "flange"], "nowhere.urdf"),
        (["--arm", "x.urdf"], "--arm needs --tip"),
    ],
)
def test_bad_arguments_are_named(arguments: list[str], message: str, recordings: str, tmp_path: Path) -> None:
    base = [] if "--data" in arguments else ["--data", recordings]
    with pytest.raises(SystemExit, match=message):
        tune.main([*base, *arguments, "--out", str(tmp_path / "run")])
    assert not (tmp_path / "run").exists()


def test_too_few_recordings_are_refused_before_any_work(tmp_path: Path) -> None:
    for count in (2, 3):
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
