"""The recipe: what it returns, on how little it works, how it goes on, and what it refuses."""

import json
import math
import os
import signal
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.conftest import interactions, small_primitive
from torch_ebip import (
    BSplineBasis,
    Demonstrations,
    InteractionPrimitive,
    Layout,
    Modality,
    RobotArm,
    StackedBasis,
    Tuner,
    TuningSettings,
    ebip,
    learn,
    select_basis,
)
from torch_ebip.learning.configuration import Task
from torch_ebip.learning.drawing import learn_drawing
from torch_ebip.learning.held_out import HeldOut
from torch_ebip.learning.horizons import AHEAD
from torch_ebip.learning.objective import ForecastObjective
from torch_ebip.learning.references import nearest
from torch_ebip.learning.remaining import remaining_error
from torch_ebip.learning.said import what_it_says
from torch_ebip.learning.stages import reference_scores, score
from torch_ebip.learning.starts import FACTORS, best_factor, best_start, scaled, tunable
from torch_ebip.recordings import actions, example

QUICK = {"steps": 4, "scan": 6, "batch_size": 4, "validate_every": 2}


@pytest.fixture(scope="module")
def model():
    return learn(interactions(20), **QUICK)


@pytest.mark.parametrize("shrink", [True, False])
def test_it_is_the_recipe_step_by_step(shrink: bool) -> None:
    """Written out again with the parts that it is made of."""
    known = interactions(20)
    model = learn(known, shrink=shrink, **QUICK)
    primitive = InteractionPrimitive.fit(known, select_basis(known))
    targets = known.layout.controlled
    task = Task(primitive, ForecastObjective(primitive, targets, ahead=AHEAD), targets, {"all": ~targets})
    settings = TuningSettings(steps=4, batch_size=4, validate_every=2, thinning=3)
    assert settings.thinning == model.report["settings"]["settings"]["thinning"]
    held_out = HeldOut(known, task, settings)
    factor = best_factor(held_out, scaled, 6, FACTORS)
    start = best_start(held_out, factor, 6)
    filter = tunable(primitive, start)
    order = torch.cat([held_out.partition.validating, held_out.partition.training])
    if shrink:
        with torch.no_grad():
            said = what_it_says(held_out, filter, order)
        filter.readout = learn_drawing(held_out, said, held_out.partition.validating).readout
    result = Tuner(filter, known, *task, settings).run()
    assert score(held_out, filter, held_out.partition.validating)["loss"] == pytest.approx(
        min(result.validation.values()), rel=1e-6
    )
    filter.readout = None
    assert model.report["factor"] == factor
    assert model.report["start"] == start._asdict()
    assert model.report["validation"] == {str(step): loss for step, loss in result.validation.items()}
    left = {name: scores["remaining"] for name, scores in model.report["stages"].items() if "remaining" in scores}
    assert model.report["chosen"] == min(left, key=left.get)
    assert left["gradient"] == remaining_error(held_out, filter, held_out.partition.validating)
    if model.report["chosen"] in ("start", "gradient"):
        expected = filter if model.report["chosen"] == "gradient" else tunable(primitive, start)
        for name, parameter in expected.named_parameters():
            torch.testing.assert_close(dict(model.filter.named_parameters())[name], parameter)


def test_references_against_plain_numpy() -> None:
    """The mean of the other folds' demonstrations, and the nearest of them, where they are so much later."""
    known = interactions(12, dtype=torch.float64)
    primitive = InteractionPrimitive.fit(known)
    targets = known.layout.controlled
    ahead = (0.25, 0.4, math.inf)
    task = Task(primitive, ForecastObjective(primitive, targets, ahead=ahead), targets, {"all": ~targets})
    held_out = HeldOut(known, task, TuningSettings(folds=3, thinning=1))
    some = torch.arange(12)
    mean, near = reference_scores(held_out, some)
    scale = task.objective.scale.numpy()
    members = held_out.partition.members(some, torch.Generator()).numpy()
    assert all(i not in members[i] for i in range(12))
    deviation = primitive.value_variance.sqrt().numpy()

    def at(j: int, seconds: float) -> np.ndarray:
        """Where a demonstration is, by its own regression."""
        phase = min(1.0, seconds * float(primitive.phase_velocity[j])) if math.isfinite(seconds) else 1.0
        one = torch.tensor(phase, dtype=torch.float64)
        return primitive.basis.project(one, primitive.weights[j])[targets].numpy()

    squares: dict[str, list[list[np.ndarray]]] = {"mean": [[], [], []], "near": [[], [], []]}
    for i in range(12):
        for share in held_out.shares.tolist():
            last = round(share * (len(known[i]) - 1))
            distances = []
            for j in members[i]:
                phase = torch.arange(last + 1, dtype=torch.float64) / known.rate * primitive.phase_velocity[j]
                path = primitive.basis.project(phase, primitive.weights[j].expand(last + 1, -1)).numpy()
                gap = ((path - known[i][: last + 1].numpy()) / deviation)[:, ~targets.numpy()]
                distances.append(np.nansum(gap**2))
            closest = members[i][np.argmin(distances)]
            for p, seconds in enumerate(ahead):
                step = last + seconds * known.rate
                if math.isfinite(seconds) and step > len(known[i]) - 1 + 1e-6:
                    continue  # behind its end
                low = min(int(step + 1e-6), len(known[i]) - 1) if math.isfinite(seconds) else -1
                part = step - low if math.isfinite(seconds) else 0.0
                truth = known[i][low].numpy() * (1 - part) + (known[i][low + 1].numpy() * part if part > 1e-6 else 0)
                time = last / known.rate + seconds
                mean_there = np.mean([at(j, time) for j in members[i]], 0)
                for name, value in (("mean", mean_there), ("near", at(closest, time))):
                    squares[name][p].append(((value - truth[targets.numpy()]) / scale[p]) ** 2)
    for name, scores in (("mean", mean), ("near", near)):
        each = [np.mean(values) for values in squares[name]]
        assert scores["error"] == pytest.approx(np.sqrt(np.mean(each)))
        for label, value in zip(("0.25 s", "0.4 s", "end"), each, strict=True):
            assert scores[f"error/{label}"] == pytest.approx(np.sqrt(value))
    assert nearest(
        primitive, known.pad()[0], known.pad()[1], (known.lengths - 1).unsqueeze(-1), 1 / known.rate
    ).flatten().tolist() == list(range(12))


def test_shrinkage_finds_what_sensors_do_not_tell() -> None:
    """A filter that sees noise only is drawn to the mean; one that sees the goal is left alone."""
    draws = torch.Generator().manual_seed(0)
    noise = Modality("noise", [f"n.{i}" for i in range(4)], "m")
    layout = Layout([noise, Modality("hand", ["h"], "m"), Modality("arm", ["a"], "rad", controlled=True)])
    paths = []
    for _ in range(40):
        phase, goal = torch.linspace(0, 1, 40).unsqueeze(-1), torch.randn((), generator=draws)
        drift = torch.randn(4, generator=draws) * phase + torch.randn(4, generator=draws) * phase**2
        path = torch.cat([drift, goal * phase, goal * phase**2], -1)
        paths.append(path + 0.01 * torch.randn(path.shape, generator=draws))
    known = Demonstrations(layout, paths, 20.0)
    primitive = InteractionPrimitive.fit(known)
    targets = layout.controlled
    some = torch.arange(40)
    found, gains = {}, {}
    for sensor in ("noise", "hand"):
        objective = ForecastObjective(primitive, targets, ahead=[0.1, 0.5, math.inf])
        task = Task(primitive, objective, targets, {sensor: layout.mask([sensor])})
        held_out = HeldOut(known, task, TuningSettings(thinning=2))
        filter = ebip(primitive, square_root=True, residual_variance=primitive.residual_variance)
        with torch.no_grad():
            drawn = learn_drawing(held_out, what_it_says(held_out, filter, some), some)
        mean, _ = reference_scores(held_out, some)
        before = score(held_out, filter, some)["error"]
        assert drawn.scores["error"] <= 1.02 * before  # shares of each fold are learned on the others
        assert drawn.scores["error"] <= 1.05 * mean["error"]
        assert 0.88 < drawn.scores["coverage_95"] <= 0.99
        gains[sensor] = drawn.gain
        found[sensor] = drawn.shares["arm"]["end"]
        assert drawn.readout.share[:5].eq(1).all()
        assert drawn.readout.widening[:5].eq(1).all()
        assert list(drawn.shares) == ["arm"]
    assert max(gains["noise"].values()) < 2.5 < min(gains["hand"].values())
    assert found["noise"] < 0.3
    assert found["hand"] > 0.8


def test_the_verdict_is_modest_where_sensors_say_nothing() -> None:
    """Hands and gazes of other hand-overs than the arm's: nothing can be better than the mean."""
    made = example()
    wrong = []
    for seed in range(3):
        order = torch.randperm(30, generator=torch.Generator().manual_seed(seed))[:12].tolist()
        paths = []
        for i, j in zip(order, [*order[1:], order[0]], strict=True):
            length = min(len(made[i]), len(made[j]))
            paths.append(torch.cat([made[i][:length, :5], made[j][-length:, 5:]], -1))
        model = learn(Demonstrations(made.layout, paths, made.rate), steps=0, scan=6)
        wrong.append("no better than the training mean" in model.report.verdict)
    assert all(wrong)
    assert "better than both" in learn(made.subset(range(12)), steps=0, scan=6).report.verdict


@pytest.mark.parametrize("count", [3, 4, 7])
def test_few_demonstrations_give_a_model_without_a_gradient(count: int) -> None:
    model = learn(example().subset(range(count)), scan=count)
    report = model.report
    assert "gradient" not in report["stages"]
    assert f"no gradient: {count} demonstrations are too few" in report.verdict
    assert report["interactions"] == count
    assert set(report["stages"]) == {"mean", "nearest", "closed_form", "factor", "start", "shrinkage"}
    left = {name: scores["remaining"] for name, scores in report["stages"].items() if "remaining" in scores}
    assert report["chosen"] == min(left, key=left.get)
    assert model.forecast(example()[8], [0.5]).mean.isfinite().all()


def test_ten_demonstrations_are_tuned_with_a_stronger_pull() -> None:
    model = learn(interactions(10), **QUICK)
    settings = model.report["settings"]["settings"]
    assert "gradient" in model.report["stages"]
    assert settings["pull"] == pytest.approx(0.04)
    assert settings["folds"] == 5


def test_roles_are_chosen_and_the_rest_is_left_out() -> None:
    known = interactions(8)
    model = learn(known, targets=["gaze"], sensors=["hand"], scan=4)
    assert model.layout.names == ("hand", "gaze")
    assert model.layout["gaze"].controlled
    assert (model.targets, model.sensors) == (("gaze",), ("hand",))
    both = learn(known, targets=["arm", "gaze"], sensors=["hand", "gaze"], scan=4)
    assert both.sensors == ("hand", "gaze")
    assert both.targets == ("arm", "gaze")


def test_a_folder_goes_on_and_is_of_one_learning(tmp_path: Path) -> None:
    known = interactions(20)
    model = learn(known, folder=tmp_path, **QUICK)
    assert {"learning.json", "report.json", "model.safetensors", "checkpoint.pt", "basis.txt"} <= {
        path.name for path in tmp_path.iterdir()
    }
    assert list((tmp_path / "tensorboard").glob("events*"))
    told: list[str] = []
    again = learn(known, folder=tmp_path, progress=lambda progress: told.append(progress.stage), **QUICK)
    assert not told
    assert torch.equal(again.forecast(known[0], [0.3]).mean, model.forecast(known[0], [0.3]).mean)
    for options, named in (({**QUICK, "seed": 3}, "settings"), ({**QUICK, "targets": ["gaze"]}, "columns")):
        with pytest.raises(ValueError, match=f"another learning's folder: {named}"):
            learn(known, folder=tmp_path, **options)
    spoiled = [-trajectory for trajectory in known]
    for other in (
        Demonstrations(known.layout, spoiled, known.rate),
        known.subset(range(19, -1, -1)),
        known.to(dtype=torch.float64),
    ):
        with pytest.raises(ValueError, match="another learning's folder: values"):
            learn(other, folder=tmp_path, **QUICK)
    with pytest.raises(ValueError, match="another learning's folder: basis"):
        learn(known, folder=tmp_path, basis=StackedBasis([BSplineBasis(5)] * 5), **QUICK)
    (tmp_path / "model.safetensors").unlink()
    resumed = learn(known, folder=tmp_path, **QUICK)  # from the checkpoint
    assert torch.equal(resumed.forecast(known[0], [0.3]).mean, model.forecast(known[0], [0.3]).mean)


@pytest.mark.parametrize("name", ["model.safetensors", "checkpoint.pt", "scan_scaled.json"])
def test_a_folder_that_says_of_no_learning_what_it_holds_is_refused(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text("{}")
    with pytest.raises(ValueError, match=f"holds {name}, but not learning.json"):
        learn(interactions(12), folder=tmp_path, **QUICK)
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_progress_counts_to_the_end_and_never_back() -> None:
    seen = []
    learn(interactions(12), progress=seen.append, **QUICK)
    done = [progress.done for progress in seen]
    assert done == sorted(done)
    assert seen[-1].done == seen[-1].total
    assert [*dict.fromkeys(progress.stage for progress in seen)] == [
        "closed form", "factor", "start", "gradient", "read-out", "surprise"
    ]  # fmt: skip
    assert any("validation" in progress.text for progress in seen)


@pytest.fixture
def interruptible():
    """Ctrl-C interrupts, also where these tests are a background job of a shell, which ignores it."""
    former = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, former)


@pytest.mark.usefixtures("interruptible")
@pytest.mark.parametrize("stage", ["factor", "gradient", "read-out", "surprise"])
def test_an_interrupt_keeps_the_best_so_far(stage: str, model, tmp_path: Path) -> None:
    """A signal as Ctrl-C sends it, in the middle of a stage; the folder then goes on to what a whole run gives."""
    known = interactions(20)
    sent = []

    def stop(progress) -> None:
        if progress.stage == stage and not sent and (stage != "gradient" or "validation" in progress.text):
            sent.append(progress)
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(0.05)

    assert threading.current_thread() is threading.main_thread()
    stopped = learn(known, folder=tmp_path, progress=stop, **QUICK)
    assert sent
    assert stopped.report["interrupted"]
    assert "interrupted, this is the best so far" in stopped.report.verdict
    assert stopped.forecast(known[0], [0.3]).mean.isfinite().all()
    assert not (tmp_path / "model.safetensors").exists()
    resumed = learn(known, folder=tmp_path, **QUICK)
    assert not resumed.report["interrupted"]
    assert torch.allclose(model.forecast(known[0], [0.3]).mean, resumed.forecast(known[0], [0.3]).mean)


def test_an_arm_is_part_of_what_is_minimised() -> None:
    known = example().subset(range(8))
    model = learn(known, arm=RobotArm.ur5(), scan=4)
    assert "tool" in model.report["stages"]["start"]
    assert "joints=shoulder_pan_joint" in model.report["settings"]["arm"]


def still(known: Demonstrations) -> Demonstrations:
    paths = [trajectory.clone() for trajectory in known]
    for path in paths:
        path[:, 4] = 0.5
    return Demonstrations(known.layout, paths, known.rate)


def in_metres(known: Demonstrations) -> Demonstrations:
    modalities = [
        Modality(m.name, m.dofs, "m" if m.controlled else m.unit, m.controlled) for m in known.layout.modalities
    ]
    return Demonstrations(Layout(modalities), list(known), known.rate)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: learn(interactions(2)), "at least 3 demonstrations, got 2"),
        (lambda: learn(interactions(8), targets=["leg"]), "no modality 'leg'"),
        (lambda: learn(interactions(8), sensors=[]), "no sensors"),
        (lambda: learn(interactions(8), sensors="hand"), "different names"),
        (lambda: learn(interactions(8), subsets={"a": []}), "no subset 'a'"),
        (lambda: learn(interactions(8), subsets={}), "subsets must be names"),
        (lambda: learn(interactions(8), subsets={"a": "hand"}), "subset 'a' must be different names"),
        (lambda: learn(interactions(8), joints="arm"), "joints='arm' without an arm"),
        (lambda: learn(interactions(8), subsets={"a": ["arm"]}), "subsets name arm; the sensors are hand, gaze"),
        (lambda: learn(interactions(8), pulll=1.0), "no setting pulll; there are batch_size"),
        (lambda: learn(interactions(8), ahead=[0.5, 0.1, math.inf]), "ahead must be increasing seconds"),
        (lambda: learn(interactions(8), ahead=[0.1, 0.5]), "the end.* the last"),
        (lambda: learn(interactions(8), memories=3), "memories must be 1 or 2, got 3"),
        (lambda: learn(interactions(8), steps=-1), "steps must be at least 0"),
        (lambda: learn(still(interactions(8))), r"differ in different demonstrations, got \['arm.2'\]"),
        (lambda: learn(interactions(8), arm=RobotArm.ur5()), "no target is the arm's 6 joints .*arm has 2 DoFs"),
        (lambda: learn(in_metres(example()), arm=RobotArm.ur5()), "'shoulder_pan_joint' is in 'rad', but .* 'm'"),
    ],
)  # fmt: skip
def test_mistakes_are_named_and_nothing_is_written(make, message: str, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ValueError, match=message):
        make()
    assert not list(tmp_path.iterdir())


def test_a_seed_reproduces(model) -> None:
    again = learn(interactions(20), **QUICK)
    one, other = (each.report.plain() for each in (model, again))
    for content in (one, other):
        del content["seconds"]
    assert json.dumps(one, sort_keys=True) == json.dumps(other, sort_keys=True)


def test_a_report_is_a_table_with_a_verdict_and_cannot_be_changed(model) -> None:
    text = str(model.report)
    assert text.splitlines()[-1] == model.report.verdict
    for stage in model.report["stages"]:
        assert stage in text
    model.report["stages"]["mean"]["error"] = 0.0
    assert model.report["stages"]["mean"]["error"] > 0
    with pytest.raises(TypeError):
        model.report["verdict"] = "perfect"
    json.dumps(model.report.plain(), allow_nan=False)


def test_a_tuner_finds_out_itself_what_is_left_out() -> None:
    primitive = small_primitive()
    made = ebip(primitive, square_root=True)
    tuner = Tuner(made, interactions(), settings=TuningSettings(steps=1, folds=4, thinning=4, batch_size=4))
    assert tuner.targets.tolist() == [False, False, False, True, True]
    assert {name: mask.tolist() for name, mask in tuner.subsets.items()} == {"all": [True, True, True, False, False]}
    assert torch.equal(tuner.primitive.weights, primitive.weights)
    assert tuner.run().validation
    only = ForecastObjective(primitive, torch.tensor([False, False, False, True, False]))
    assert Tuner(made, interactions(), objective=only).targets.tolist() == [False, False, False, True, False]


def test_horizons_that_hardly_anybody_reaches_are_left_out_and_the_report_says_so(model) -> None:
    """The demonstrations last 1.2 to 2 s, of which 1 s is too much after the first fifth."""
    assert model.report["horizons"] == ["0.1 s", "0.25 s", "0.5 s", "1 s", "end"]
    far = learn(interactions(8), ahead=[0.25, 30.0, math.inf], scan=4)
    assert far.report["horizons"] == ["0.25 s", "end"]
    assert "hardly any demonstration goes on for so long: 30 s" in str(far.report)
    assert {key for key in far.report["stages"]["mean"] if key.startswith("error/")} == {"error/0.25 s", "error/end"}


def test_labels_are_recognised_and_reported() -> None:
    known = actions(24, 5)
    model = learn(known, **QUICK)
    said = model.report["recognition"]
    assert said["labels"] == {"lift": 6, "swing": 6, "circle": 6, "nod": 6}
    assert said["accuracy_by_share"]["0.4"] > 0.9
    assert model.labels == known.labels
    test = actions(4, 6)
    forecast = model.forecast(test[1], [0.1, math.inf])
    assert forecast.labels["swing"].shape == (len(test[1]),)
    assert float(forecast.labels["swing"][len(test[1]) // 2]) > 0.8
    total = torch.stack(list(forecast.labels.values())).sum(0)
    assert torch.allclose(total, torch.ones_like(total), atol=1e-5)


def test_a_label_with_one_demonstration_is_a_remark_and_half_of_them_an_error() -> None:
    known = actions(13, 5)
    lonely = known.labelled(["once", *known.labels[1:]])
    assert "label 'once' has one demonstration" in str(learn(lonely, **QUICK).report)
    with pytest.raises(ValueError, match="labels must be names, one for each"):
        known.labelled([*known.labels[:5], *[None] * 8])
    with pytest.raises(ValueError, match="'labels' has shape"):
        known.labelled(known.labels[:5])


def test_groups_that_nobody_named_are_found_and_grow() -> None:
    """Two ways of handing over that lie far apart."""
    made = interactions(24)
    paths = [path + (torch.tensor([2.0, 2.0, 0.0, 0.0, 0.0]) if i % 2 else 0) for i, path in enumerate(made)]
    known = Demonstrations(made.layout, paths, made.rate)
    model = learn(known.subset(range(20)), **QUICK)
    assert model.report["groups"] == {"group 1": 10, "group 2": 10}
    assert model.labels == tuple(f"group {i % 2 + 1}" for i in range(20))
    more = model.extend(known.subset([20, 21, 23]))
    assert more.labels[20:] == ("group 1", "group 2", "group 2")
    one = learn(made.subset(range(20)), **QUICK)
    assert one.report["groups"] == {}
    assert one.labels is None


def test_a_channel_that_is_always_zero_is_learned_around() -> None:
    """The spread of the demonstrations is 0 there, and its root has no gradient."""
    made = example().subset(range(12))
    paths = [path.clone() for path in made]
    for path in paths:
        path[:, 1] = 0.0
    known = Demonstrations(made.layout, paths, made.rate)
    model = learn(known, sensors=["hand"], scan=6, steps=2, batch_size=4)
    assert "gradient" in model.report["stages"]
    assert model.forecast(model.prepare(known)[0], [0.1, math.inf]).mean.isfinite().all()


def test_recordings_that_are_there_twice_are_named() -> None:
    """Whoever is left out is then known."""
    known = interactions(12)
    model = learn(known.subset([*range(12), 3, 3, 7]), steps=0, scan=4)
    named = [remark for remark in model.report["remarks"] if "are the same" in remark]
    assert [remark.split(" are")[0] for remark in named] == ["recordings 3, 12, 13", "recordings 7, 14"]
