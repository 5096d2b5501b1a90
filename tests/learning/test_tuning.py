"""Tuning: honest ensembles, gradients that help, runs that resume to the same numbers."""

import math
import time
from collections.abc import Sequence
from pathlib import Path

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from tests.conftest import interactions, small_primitive
from torch_ebip import (
    AboveOne,
    BSplineBasis,
    Demonstrations,
    EnsembleFilter,
    InteractionPrimitive,
    Layout,
    Modality,
    PolynomialBasis,
    RobotArm,
    StackedBasis,
    Tuner,
    TuningSettings,
    ebip,
)
from torch_ebip.learning.checkpoint import load_checkpoint, save_checkpoint
from torch_ebip.learning.losses import ForwardKinematicsLoss
from torch_ebip.learning.monitor import Monitor
from torch_ebip.learning.objective import ForecastObjective, Weights
from torch_ebip.learning.partition import Partition
from torch_ebip.learning.ranks import Ranks

TARGETS = torch.tensor([False, False, False, True, True])
SUBSETS = {"hand": torch.tensor([True, True, False, False, False]), "both": ~TARGETS}
SMALL = TuningSettings(steps=12, batch_size=6, validate_every=4, folds=4, thinning=2, seed=3)


def filter_and_tuner(
    settings: TuningSettings = SMALL, factor: float = 1.0, **options
) -> tuple[EnsembleFilter, Tuner]:
    primitive = small_primitive()
    one, start = primitive.weights.new_tensor(1.01), factor * primitive.residual_variance
    arguments = {"context": BSplineBasis(4), "inflation": AboveOne(one), "residual_variance": start}
    made = ebip(primitive, **arguments, square_root=True, weigh=True)
    objective = ForecastObjective(primitive, TARGETS)
    return made, Tuner(made, interactions(), primitive, objective, TARGETS, SUBSETS, settings, **options)


def parameters(made: EnsembleFilter) -> dict[str, torch.Tensor]:
    return {name: p.detach().clone() for name, p in made.named_parameters()}


def test_no_ensemble_contains_its_interaction(monkeypatch: pytest.MonkeyPatch) -> None:
    _, tuner = filter_and_tuner()
    seen = []
    original = Partition.members

    def recording(self, picked, generator):
        members = original(self, picked, generator)
        seen.append((picked, members))
        return members

    monkeypatch.setattr(Partition, "members", recording)
    tuner.run()
    assert len(seen) > 12
    for picked, members in seen:
        assert not (members == picked[:, None]).any()
        assert all(len(set(row.tolist())) == len(row) for row in members)
    trained = torch.cat([picked for picked, _ in seen if len(picked) == 6])
    assert not set(trained.tolist()) & set(tuner.partition.validating.tolist())


@pytest.mark.parametrize("size", [5, 40])
def test_smaller_and_larger_ensembles(size: int) -> None:
    _, tuner = filter_and_tuner(TuningSettings(n_members=size, folds=4))
    members = tuner.partition.members(torch.arange(6), torch.Generator().manual_seed(0))
    assert members.shape == (6, size)
    assert not (members == torch.arange(6)[:, None]).any()
    known = tuner.partition.known(torch.arange(6))
    assert known.gather(1, members).all()
    assert not known[:, :6].diagonal().any()


def test_tuning_improves_the_validation_loss_and_moves_the_noise() -> None:
    """From a noise that is a thousand times too large, which shuts the measurements out."""
    settings = TuningSettings(
        steps=40, batch_size=8, validate_every=10, folds=4, thinning=2, learning_rate=0.3, pull=0
    )
    made, tuner = filter_and_tuner(settings, factor=1000.0)
    start = tuner.evaluate()["loss"]
    result = tuner.run()
    assert min(result.validation.values()) < 0.5 * start
    assert result.validation[0] == pytest.approx(start)
    assert tuner.evaluate()["loss"] == pytest.approx(result.validation[result.best_step])
    moved = parameters(made)
    assert moved["model.measurement_noise.variance.raw"][:3].max() < 0
    assert not moved["model.measurement_noise.variance.raw"][3:].any()  # never observed


def test_the_gradient_of_a_step_is_that_of_finite_differences() -> None:
    """Through ensembles, thinning, masks, forecast and scores: the derivative along a random direction."""
    primitive = small_primitive(torch.float64)
    made = ebip(primitive, context=BSplineBasis(4), square_root=True, weigh=True, localise=True)
    objective = ForecastObjective(primitive, TARGETS, weights=Weights(1.0, 1.0, 0.0, 0.1))
    demonstrations = interactions(dtype=torch.float64)
    tuner = Tuner(made, demonstrations, primitive, objective, TARGETS, SUBSETS, SMALL)
    shares = torch.tensor([[0.3, 0.7]]).expand(4, 2)

    def loss() -> torch.Tensor:
        generator = torch.Generator().manual_seed(0)
        members = tuner.partition.members(torch.arange(4), generator)
        trial = tuner.held_out.filter(made, tuner.held_out.show(torch.arange(4), SUBSETS["both"], shares, members), 0)
        return torch.stack(list(trial.terms(objective).values())).sum()

    loss().backward()
    generator = torch.Generator().manual_seed(1)
    direction = {n: torch.randn(p.shape, generator=generator, dtype=p.dtype) for n, p in made.named_parameters()}
    slope = sum((p.grad * direction[n]).sum() for n, p in made.named_parameters() if p.grad is not None)
    values = []
    for sign in (1, -1):
        with torch.no_grad():
            for name, p in made.named_parameters():
                p.add_(sign * 1e-5 * direction[name])
            values.append(loss().item())
            for name, p in made.named_parameters():
                p.sub_(sign * 1e-5 * direction[name])
    assert slope.item() == pytest.approx((values[0] - values[1]) / 2e-5, rel=1e-5)


def test_an_interrupted_run_ends_in_the_same_numbers(tmp_path: Path) -> None:
    made, tuner = filter_and_tuner()
    uninterrupted = tuner.run()
    expected = parameters(made)

    class InterruptionError(Exception):
        pass

    def stop(step: int, *_: float) -> None:
        if step == 9:  # one step after the checkpoint at 8
            raise InterruptionError

    _, first = filter_and_tuner(checkpoint=tmp_path / "c.pt", progress=stop)
    with pytest.raises(InterruptionError):
        first.run()
    resumed, second = filter_and_tuner(checkpoint=tmp_path / "c.pt")
    result = second.run()
    assert result.validation == uninterrupted.validation
    for name, value in parameters(resumed).items():
        assert torch.equal(value, expected[name]), name
    again, third = filter_and_tuner(checkpoint=tmp_path / "c.pt")
    assert third.run().validation == uninterrupted.validation
    assert torch.equal(parameters(again)["analysis.inflation.factor.raw"], expected["analysis.inflation.factor.raw"])


WEIGHTS = ("analysis.weighting.*", "analysis.inflation*")


def test_only_the_named_parameters_are_tuned() -> None:
    settings = TuningSettings(steps=4, folds=4, validate_every=2, only=WEIGHTS)
    made, tuner = filter_and_tuner(settings, factor=300.0)  # from where validation improves at once
    tuner.run()
    moved = {name for name, value in parameters(made).items() if value.abs().max() > 0}
    assert moved
    assert all(name.startswith(("analysis.weighting", "analysis.inflation")) for name in moved)


def test_stops_early_when_validation_no_longer_improves() -> None:
    settings = TuningSettings(
        steps=400, learning_rate=1.0, batch_size=4, folds=4, validate_every=1, patience=3, clip=1e3
    )
    _, tuner = filter_and_tuner(settings)
    result = tuner.run()
    assert result.stopped_early
    assert max(result.validation) == result.best_step + 3


def test_a_strong_pull_keeps_parameters_at_the_start() -> None:
    near, _ = pair = filter_and_tuner(TuningSettings(steps=10, folds=4, pull=100.0))
    pair[1].run()
    far, tuner = filter_and_tuner(TuningSettings(steps=10, folds=4, pull=0.0))
    tuner.run()
    size = [sum(float(p.detach().square().sum()) for p in made.parameters()) for made in (near, far)]
    assert size[0] < 0.2 * size[1]


def test_checkpoints_of_another_configuration_and_damaged_ones_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "c.pt"
    _, tuner = filter_and_tuner(checkpoint=path)
    tuner.run()
    _, other = filter_and_tuner(TuningSettings(steps=12, folds=3, seed=3), checkpoint=path)
    with pytest.raises(
        ValueError, match="another configuration: batch_size: 6 there, 16 here; folds: 4 there, 3 here"
    ):
        other.run()
    content = path.read_bytes()
    for size in (0, 100, len(content) // 2, len(content) - 20):
        path.write_bytes(content[:size])
        with pytest.raises(ValueError, match=r"c\.pt: not a readable checkpoint"):
            filter_and_tuner(checkpoint=path)[1].run()
    assert [file.name for file in tmp_path.iterdir()] == ["c.pt"]


def test_a_checkpoint_of_another_start_is_refused(tmp_path: Path) -> None:
    filter_and_tuner(checkpoint=tmp_path / "c.pt")[1].run()
    _, other = filter_and_tuner(factor=1000.0, checkpoint=tmp_path / "c.pt")
    with pytest.raises(
        ValueError, match=r"another configuration: filter_buffers.*measurement_noise\.variance\.start"
    ):
        other.run()


def test_horizons_stay_inside_however_coarse_the_thinning(tmp_path: Path) -> None:
    made, tuner = filter_and_tuner(TuningSettings(folds=4, thinning=10, horizons=(0.9, 1.0)))
    shares = torch.tensor([[0.97, 1.0]]).expand(24, 2)
    members = tuner.partition.members(torch.arange(24), torch.Generator())
    trial = tuner.held_out.filter(made, tuner.held_out.show(torch.arange(24), SUBSETS["both"], shares, members), 0)
    assert trial.shown.now.max() <= 1
    assert trial.trace.kept is not None


def test_checkpoints_execute_nothing(tmp_path: Path) -> None:
    path, witness = tmp_path / "c.pt", tmp_path / "witness"

    class Bomb:
        def __reduce__(self):
            return (open, (str(witness), "w"))

    torch.save({"format": 1, "configuration": {}, "content": Bomb()}, path)
    with pytest.raises(ValueError, match="not a readable checkpoint"):
        load_checkpoint(path, {})
    assert not witness.exists()
    save_checkpoint(path, {"a": 1}, {"x": torch.ones(2)})
    assert load_checkpoint(path, {"a": 1})["x"].tolist() == [1, 1]
    with pytest.raises(FileNotFoundError):
        load_checkpoint(tmp_path / "none.pt", {})


def test_a_failed_write_leaves_the_old_checkpoint(tmp_path: Path) -> None:
    path = tmp_path / "c.pt"
    save_checkpoint(path, {}, {"x": 1})
    with pytest.raises(Exception, match=r"pickle|lambda|local"):
        save_checkpoint(path, {}, {"x": lambda: None})
    assert load_checkpoint(path, {})["x"] == 1
    assert [file.name for file in tmp_path.iterdir()] == ["c.pt"]


def test_the_tool_counts_through_the_arm() -> None:
    """Six joints observed through nothing but their mean: the gradient of the tool's distance reaches the noise."""
    primitive = small_primitive(torch.float64)
    six = torch.ones(5, dtype=torch.bool)
    with pytest.raises(ValueError, match="end differently"):
        ForecastObjective(primitive, ~six)
    with pytest.raises(ValueError, match="tool term needs an arm"):
        ForecastObjective(primitive, six, weights=Weights(tool=1.0))
    arm = ForwardKinematicsLoss(RobotArm.ur5().double())
    made = ebip(primitive, square_root=True).restrict(six)
    state = made.initial_state()
    state, _ = made.update(state, torch.zeros(5, dtype=torch.float64), SUBSETS["both"])
    ends = made.forecast(state, torch.ones(1)).mean[0]
    joints = torch.cat([ends, ends[:1]])
    arm(joints, torch.zeros(6, dtype=torch.float64)).backward()
    gradient = made.model.measurement_noise.whole.variance.raw.grad
    assert gradient[:3].abs().min() > 0


def test_bad_settings_are_named() -> None:
    with pytest.raises(ValueError, match="no parameter matches"):
        filter_and_tuner(TuningSettings(only=("nothing",)))
    with pytest.raises(ValueError, match="too few for 25 folds"):
        filter_and_tuner(TuningSettings(folds=25))
    primitive = small_primitive()
    objective = ForecastObjective(primitive, TARGETS)
    with pytest.raises(ValueError, match="horizons must be"):
        TuningSettings(horizons=(0.5, 1.5))
    with pytest.raises(ValueError, match="thinning must be at least 1"):
        TuningSettings(thinning=0)
    stranger = ebip(primitive.subset(torch.arange(23, -1, -1)))
    with pytest.raises(ValueError, match="prior does not hold"):
        Tuner(stranger, interactions(), primitive, objective, TARGETS, SUBSETS)
    with pytest.raises(ValueError, match="10 demonstrations, but the primitive has 24"):
        Tuner(ebip(primitive), interactions(10), primitive, objective, TARGETS, SUBSETS)


def test_an_objective_needs_states_and_computes_only_what_counts() -> None:
    primitive = small_primitive(torch.float64)
    made = ebip(primitive, square_root=True)
    y = interactions(dtype=torch.float64)[0][None, :20]
    now = torch.tensor([[0.4]], dtype=torch.float64)
    truth = torch.zeros(1, 1, 2, 2, dtype=torch.float64)
    objective = ForecastObjective(primitive, TARGETS, weights=Weights(0.0, 0.0, 0.0, 2.0))
    bare = made(y)
    with pytest.raises(ValueError, match="kept no states"):
        objective(made, bare, ~y.isnan(), truth, now, TARGETS)
    with pytest.raises(ValueError, match="kept no states"):
        objective.spread_and_error(made, bare, truth, TARGETS)
    trace = made(y, keep=torch.tensor([[19]]))
    terms = objective(made, trace, ~y.isnan(), truth, now, TARGETS)
    assert list(terms) == ["innovation"]
    expected = -2 * trace.log_likelihood.sum() / (~y.isnan()).sum()
    torch.testing.assert_close(terms["innovation"], expected)


def test_more_processes_than_interactions() -> None:
    with pytest.raises(ValueError, match="9 processes, but only"):
        filter_and_tuner(ranks=Ranks(0, 9))
    _, tuner = filter_and_tuner(ranks=Ranks(0, 2))
    with pytest.raises(ValueError, match="2 processes, but only 1 interactions"):
        tuner.evaluate(torch.tensor([0]))


def test_a_checkpoint_of_another_format(tmp_path: Path) -> None:
    path = tmp_path / "c.pt"
    torch.save({"format": 0, "configuration": {}, "content": {}}, path)
    with pytest.raises(ValueError, match="checkpoint format 0, this version reads 1"):
        load_checkpoint(path, {})


def test_a_resumed_run_shows_every_step_once(tmp_path: Path) -> None:
    """Whenever it was interrupted: before its first checkpoint, at one, or after."""

    class StoppedError(Exception):
        """Not an error: the test's way to interrupt."""

    settings = TuningSettings(steps=7, batch_size=2, validate_every=3, folds=3, thinning=2)

    def run(folder: Path, last: int | None) -> None:
        def progress(step: int, *_: float) -> None:
            if step == last:
                raise StoppedError

        with Monitor(folder / "tb") as monitor:
            _, tuner = filter_and_tuner(settings, checkpoint=folder / "c.pt", progress=progress, monitor=monitor)
            tuner.run()

    for last in (2, 3, 5):
        folder = tmp_path / str(last)
        with pytest.raises(StoppedError):
            run(folder, last)
        time.sleep(1.05)  # TensorBoard orders files by the second in their names
        run(folder, None)
        events = EventAccumulator(str(folder / "tb"))
        events.Reload()
        assert [event.step for event in events.Scalars("train/loss")] == [1, 2, 3, 4, 5, 6, 7]
        assert [event.step for event in events.Scalars("validation/loss")] == [0, 3, 6, 7]


def arm_primitive(
    names: Sequence[str], unit: str = "rad", factor: float = 1.0
) -> tuple[InteractionPrimitive, Layout]:
    """Of a hand and the UR5's joints in some order and unit."""
    generator = torch.Generator().manual_seed(0)
    layout = Layout([Modality("hand", ["x"], "m"), Modality("robot", names, unit, controlled=True)])
    joints = RobotArm.ur5().joint_names
    paths = []
    for _ in range(8):
        a, p = torch.randn(7, generator=generator), torch.linspace(0, 1, 30)[:, None]
        values = factor * a[1:] * p
        columns = [values[:, joints.index(name) if name in joints else i] for i, name in enumerate(names)]
        paths.append(torch.stack([a[0] * p[:, 0], *columns], -1))
    demonstrations = Demonstrations(layout, paths, 30.0)
    return InteractionPrimitive.fit(demonstrations, StackedBasis([PolynomialBasis(3)] * (1 + len(names)))), layout


def tool_term(names: Sequence[str], unit: str = "rad", factor: float = 1.0) -> float:
    primitive, layout = arm_primitive(names, unit, factor)
    made = ebip(primitive, square_root=True)
    objective = ForecastObjective(
        primitive,
        layout.controlled,
        weights=Weights(0.0, 0.0, 1.0, 0.0),
        arm=ForwardKinematicsLoss(RobotArm.ur5()),
        arm_dofs=layout.controlled,
    )
    now = torch.tensor([[0.5]])
    y = torch.full((1, 16, 7), torch.nan)
    y[0, :, 0] = 0.3 * torch.linspace(0, 0.5, 16)
    trace = made(y, keep=torch.tensor([[15]]), generator=torch.Generator().manual_seed(0))
    ends = primitive.basis.project(objective.phases_ahead(now), primitive.weights[0][None, None, None])
    terms = objective(made, trace, ~y.isnan(), ends[..., layout.controlled], now, layout.controlled)
    return float(terms["tool"].detach())


def test_joints_are_taken_by_their_names() -> None:
    """In whatever order a driver publishes them; by place where they have names of their own."""
    joints = list(RobotArm.ur5().joint_names)
    right = tool_term(joints)
    assert right > 0.01
    assert tool_term([joints[i] for i in (2, 1, 0, 3, 4, 5)]) == pytest.approx(right, rel=1e-3)
    assert tool_term([f"robot.{i}" for i in range(6)]) == pytest.approx(right, rel=1e-3)
    assert tool_term(joints, "deg", 180 / math.pi) == pytest.approx(right, rel=1e-3)
    with pytest.raises(ValueError, match=r"joint 'shoulder_pan_joint' is in 'rad', but .* in 'm'"):
        tool_term(joints, "m")
    with pytest.raises(ValueError, match=r"named after the arm's joints .* elbow are not"):
        tool_term([*joints[:2], "elbow", *joints[3:]])
    primitive, layout = arm_primitive(joints[:5])
    loss = ForwardKinematicsLoss(RobotArm.ur5())
    with pytest.raises(ValueError, match="the arm has 6 joints"):
        ForecastObjective(primitive, layout.controlled, arm=loss, arm_dofs=layout.controlled)
    with pytest.raises(ValueError, match=r"the arm's joints must be targets, which shoulder_pan_joint"):
        ForecastObjective(primitive, layout.mask(["x"]), arm=loss, arm_dofs=layout.controlled)


def test_what_a_tuner_is_given_must_belong_together() -> None:
    made, primitive = interactions(), small_primitive()
    hand, *rest = made.layout.modalities
    swapped = Layout([Modality("hand", hand.dofs[::-1], "m"), *rest])
    objective = ForecastObjective(primitive, TARGETS)
    for demonstrations, filter, targets, subsets, message in (
        (Demonstrations(swapped, list(made), 30.0), ebip(primitive), TARGETS, SUBSETS, "another layout or rate"),
        (Demonstrations(made.layout, list(made), 60.0), ebip(primitive), TARGETS, SUBSETS, "another layout or rate"),
        (made, ebip(primitive), ~TARGETS, SUBSETS, "which are not the targets"),
        (made, ebip(primitive), TARGETS, {}, "at least one set of sensors"),
        (made, ebip(primitive), TARGETS, {"a": torch.tensor([0, 1])}, r"subset 'a' must be bool \[5\]"),
    ):
        with pytest.raises(ValueError, match=message):
            Tuner(filter, demonstrations, primitive, objective, targets, subsets, SMALL)
