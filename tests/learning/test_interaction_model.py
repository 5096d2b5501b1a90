"""What was learned as a thing: kept, loaded, run, extended; and what is refused, by name."""

import math
from pathlib import Path

import pytest
import safetensors.torch
import torch

from tests.conftest import interactions, small_primitive
from torch_ebip import (
    AcceleratingPhase,
    BSplineBasis,
    Demonstrations,
    DriftingPhase,
    GaussianBasis,
    InteractionModel,
    InteractionPrimitive,
    Layout,
    Modality,
    PhaseBank,
    PolynomialBasis,
    SigmoidBasis,
    StackedBasis,
    StudentT,
    bip,
    ebip,
    learn,
    load_model,
)
from torch_ebip.common.draws import seeded
from torch_ebip.interaction.basis import Basis
from torch_ebip.learning.model_file import KIND, VERSION, read_model_file, write_model_file
from torch_ebip.learning.report import Report

OPTIONS = {
    "closed form": {},
    "tuned": {"square_root": True, "weigh": True, "inflation": 1.01, "context": BSplineBasis(4), "sharpness": 7.0},
    "robust": {"robust": StudentT(3.0), "weight_noise": 0.1},
    "drifting": {"phase": DriftingPhase(0.7, overrun=0.1), "localise": True},
    "accelerating": {"phase": AcceleratingPhase(overrun=0.1), "square_root": True},
    "few": {"n_members": 9},
    "paced": {"square_root": True, "weigh": True, "pace": PhaseBank.of(small_primitive(), 15, 20, stop=0.7, go=2.0)},
}


def moved(filter, seed: int = 0):
    """Every number that can be learned is another one than at the start."""
    draws = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in filter.parameters():
            parameter.uniform_(-0.5, 0.5, generator=draws)
    return filter


def model_of(name: str = "tuned", dtype: torch.dtype = torch.float32) -> InteractionModel:
    primitive = small_primitive(dtype)
    return InteractionModel(moved(ebip(primitive, **OPTIONS[name])), primitive, Report({"verdict": "good"}))


def said(model: InteractionModel) -> list[torch.Tensor]:
    forecast = model.forecast(interactions(3, seed=5)[1].to(model.primitive.weights), [0.0, 0.3, math.inf])
    return [forecast.mean, forecast.variance, forecast.phase]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", list(OPTIONS))
def test_what_was_saved_says_the_same_to_the_bit(name: str, dtype: torch.dtype, tmp_path: Path) -> None:
    model = model_of(name, dtype)
    model.save(tmp_path / "model.safetensors")
    again = load_model(tmp_path / "model.safetensors")
    assert all(torch.equal(a, b) for a, b in zip(said(model), said(again), strict=True))
    assert repr(again.filter) == repr(model.filter)
    assert again.layout == model.layout
    assert again.rate == model.rate
    assert again.report.plain() == model.report.plain()
    for name, tensor in model.primitive.named_buffers():
        assert torch.equal(dict(again.primitive.named_buffers())[name], tensor), name


@pytest.mark.parametrize(
    "basis", [GaussianBasis(7, offset=True), GaussianBasis(6, width=0.123456789), SigmoidBasis(8), PolynomialBasis(5)]
)
def test_every_basis_of_the_library_is_kept_exactly(basis: Basis, tmp_path: Path) -> None:
    primitive = InteractionPrimitive.fit(interactions(), StackedBasis([basis] * 5))
    InteractionModel(ebip(primitive), primitive).save(tmp_path / "m")
    again = load_model(tmp_path / "m").primitive.basis
    phase = torch.linspace(-0.2, 1.2, 30, dtype=torch.float64)
    assert torch.equal(again.bases[0](phase), basis(phase))


def test_a_forecast_of_recorded_data_is_the_filter_step_by_step() -> None:
    """Sample by sample through predict and update, and each member at its own velocity."""
    model = model_of("tuned", torch.float64)
    values = interactions(3, seed=5)[1].double()
    mean, variance, _ = said(model)
    filter, draws = model.filter, seeded(0)
    state = filter.initial_state(generator=draws)
    sensors = ~model.layout.controlled
    with torch.no_grad():
        for step, sample in enumerate(values):
            if step:
                state = filter.predict(state, filter.dt, draws)
            state, _ = filter.update(state, sample, ~sample.isnan() & sensors, draws)
            forecast = filter.forecast(state, ahead=[0.0, 0.3, math.inf])
            torch.testing.assert_close(mean[step], forecast.mean, rtol=1e-6, atol=1e-9)
            torch.testing.assert_close(variance[step], forecast.variance, rtol=1e-5, atol=1e-12)


def test_a_long_recording_in_portions_is_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    model = model_of()
    whole = said(model)
    monkeypatch.setattr("torch_ebip.learning.recorded.PORTION", 1 << 17)
    for one, other in zip(whole, said(model), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-6)


def test_what_is_controlled_is_not_looked_at_and_the_future_neither() -> None:
    model = model_of()
    values = interactions(3, seed=5)[1]
    spoiled = values.clone()
    spoiled[:, 3:] = torch.nan
    spoiled[20:, :3] = 99.0
    one, other = (model.forecast(each, [0.1]).mean for each in (values, spoiled))
    assert torch.equal(one[:20], other[:20])
    assert not torch.equal(one[20:], other[20:])


@pytest.mark.parametrize(
    ("values", "ahead", "message"),
    [
        (torch.zeros(4, 3), [0.1], r"values must be \[T, 5\], one column for each of hand.x"),
        (torch.zeros(0, 5), [0.1], r"got \[0, 5\]"),
        (torch.zeros(4, 5), [], "at least one number of seconds"),
        (torch.zeros(4, 5), [-1.0], "ahead must be seconds"),
        (torch.full((4, 5), math.inf), [1.0], "infin"),
    ],
)
def test_what_cannot_be_forecast_is_refused(values: torch.Tensor, ahead: list[float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        model_of().forecast(values, ahead)


def test_a_session_is_that_of_filter_and_primitive(tmp_path: Path) -> None:
    model = model_of()
    with model.session(sensors=["hand"], record=tmp_path / "log.jsonl", window=0.5) as session:
        assert session.settings.window == 0.5
        assert session.settings.start == "first sample"
        for step, sample in enumerate(interactions(3, seed=5)[1][:20]):
            session.push("hand", sample[:2], 1e9 + step / 30)
        assert session.forecast().mean.isfinite().all()
    assert (tmp_path / "log.jsonl").exists()
    with pytest.raises(TypeError, match="windoww"):
        model.session(windoww=1.0)


def test_new_members_change_nothing_else() -> None:
    model = model_of()
    new = interactions(30).subset(range(24, 30))
    more = model.extend(new)
    assert len(more.primitive) == more.filter.n_members == 30
    assert torch.equal(more.primitive.weights[:24], model.primitive.weights)
    expected = InteractionPrimitive.fit(new, model.primitive.basis)
    torch.testing.assert_close(more.primitive.weights[24:], expected.weights)
    for name, parameter in model.filter.named_parameters():
        assert torch.equal(dict(more.filter.named_parameters())[name], parameter), name
    for name in ("residual_variance", "value_variance"):
        assert torch.equal(getattr(more.primitive, name), getattr(model.primitive, name))
    assert more.report["extended_by"] == 6
    one = model.extend(new.subset([0]))
    torch.testing.assert_close(one.primitive.weights[24], expected.weights[0])
    assert model_of("few").extend(new).filter.n_members == 9


def test_labels_go_with_the_demonstrations(tmp_path: Path) -> None:
    made = interactions(8)
    labelled = Demonstrations(made.layout, list(made), made.rate, labels=["wave"] * 4 + ["point"] * 4)
    model = learn(labelled, scan=4)
    model.save(tmp_path / "m")
    assert load_model(tmp_path / "m").labels == labelled.labels
    assert model.extend(labelled.subset([5])).labels == (*labelled.labels, "point")
    with pytest.raises(ValueError, match="must both have them"):
        model.extend(made)
    labelled.save(tmp_path / "d.npz")
    assert Demonstrations.load(tmp_path / "d.npz").subset([0, 7]).labels == ("wave", "point")
    with pytest.raises(ValueError, match="labels must be names"):
        Demonstrations(made.layout, list(made), made.rate, labels="waves")
    with pytest.raises(ValueError, match="has shape"):
        Demonstrations(made.layout, list(made), made.rate, labels=["wave"])


def test_another_ensemble_and_another_trust() -> None:
    model = model_of()
    few = model.rebuilt(n_members=7)
    assert few.filter.n_members == 7
    robust = model.rebuilt(robust=StudentT(5.0))
    assert float(robust.filter.analysis.trust[0].scale.value) == pytest.approx(5.0)
    for name, parameter in model.filter.named_parameters():
        assert torch.equal(dict(robust.filter.named_parameters())[name], parameter), name
    assert all(torch.equal(a, b) for a, b in zip(said(model.rebuilt()), said(model), strict=True))


def relaid(change) -> Demonstrations:
    made = interactions(4)
    return Demonstrations(Layout([change(modality) for modality in made.layout.modalities]), list(made), made.rate)


def reordered() -> Demonstrations:
    made = interactions(4)
    layout = Layout([made.layout["gaze"], made.layout["hand"], made.layout["arm"]])
    return Demonstrations(layout, [trajectory[:, [2, 0, 1, 3, 4]] for trajectory in made], made.rate)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Demonstrations(interactions(4).layout, list(interactions(4)), 60.0), "60 samples a second, the "),
        (lambda: relaid(lambda m: Modality(m.name, m.dofs, "N" if m.name == "hand" else m.unit, m.controlled)),
         "hand is in 'N' in the recordings, in 'm' in the model"),
        (lambda: relaid(lambda m: Modality(m.name, m.dofs[::-1], m.unit, m.controlled)),
         "hand has the columns hand.y, hand.x in the recordings, hand.x, hand.y in the model"),
        (lambda: relaid(lambda m: Modality("face" if m.name == "gaze" else m.name, m.dofs, m.unit, m.controlled)),
         "the recordings lack gaze; they have hand, face, arm"),
        (reordered, "the modalities in the order gaze, hand, arm, the model hand, gaze, arm"),
    ],
)  # fmt: skip
def test_recordings_of_another_layout_are_refused_by_name(make, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        model_of().extend(make())


def test_parts_that_do_not_belong_together_are_refused() -> None:
    primitive = small_primitive()
    other = small_primitive(count=10)
    with pytest.raises(ValueError, match="not the demonstrations of this primitive"):
        InteractionModel(ebip(other), primitive)
    with pytest.raises(ValueError, match="must have one dtype"):
        InteractionModel(ebip(primitive).double(), primitive)
    with pytest.raises(ValueError, match="2 labels for 24"):
        InteractionModel(ebip(primitive), primitive, labels=("a", "b"))
    with pytest.raises(ValueError, match="no modality 'leg'"):
        InteractionModel(ebip(primitive), primitive, targets=("leg",))
    with pytest.raises(AttributeError):
        InteractionModel(ebip(primitive), primitive).filter = None


class OwnBasis(BSplineBasis):
    """Of a user."""


def test_what_a_file_cannot_keep_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    primitive = small_primitive()
    own = InteractionPrimitive.fit(interactions(), StackedBasis([OwnBasis(6)] * 5))
    strange = ebip(primitive, square_root=True)
    strange.analysis.inflation = torch.nn.Identity()
    weighed = ebip(primitive, weigh=True)
    weighed.analysis.weighting.defensive = 0.5
    cases = {
        "not InteractionExtendedFilter": InteractionModel(bip(primitive), primitive),
        "not OwnBasis": InteractionModel(ebip(own), own),
        "inflation": InteractionModel(strange, primitive),
        "settings that `ebip` does not give": InteractionModel(weighed, primitive),
    }
    for message, model in cases.items():
        with pytest.raises(TypeError, match=message):
            model.save(tmp_path / "m")
    assert not list(tmp_path.iterdir())


def test_foreign_cut_off_and_later_files_are_named(tmp_path: Path) -> None:
    path = tmp_path / "model.safetensors"
    model_of().save(path)
    content = path.read_bytes()
    safetensors.torch.save_file({"w": torch.ones(2)}, tmp_path / "foreign")
    (tmp_path / "cut").write_bytes(content[:-7])
    (tmp_path / "head").write_bytes(content[:100])
    (tmp_path / "pickle").write_bytes(b"\x80\x04" + content[2:])
    flipped = bytearray(content)
    flipped[-100] ^= 1
    (tmp_path / "flipped").write_bytes(bytes(flipped))
    (tmp_path / "later").write_bytes(content.replace(b'"version":"%d"' % VERSION, b'"version":"%d"' % (VERSION + 1)))
    messages = {
        "foreign": "tensors of something else",
        "cut": "cut off or damaged",
        "head": "cut off in its header",
        "pickle": "not a model",
        "flipped": "damaged model",
        "later": f"model format '{VERSION + 1}', this torch_ebip reads up to {VERSION}",
    }
    for name, message in messages.items():
        with pytest.raises(ValueError, match=f"{name}: .*{message}"):
            load_model(tmp_path / name)
    with pytest.raises(FileNotFoundError):
        load_model(tmp_path / "nowhere")
    with pytest.raises(ValueError, match="bytes, expected at most 10"):
        read_model_file(path, limit=10)


def test_a_folder_without_a_model_says_where_there_are_some(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no model\.safetensors in this folder$"):
        load_model(tmp_path)
    model_of().save(tmp_path / "fold-00" / "model.safetensors")
    with pytest.raises(FileNotFoundError, match="there is one in fold-00"):
        load_model(tmp_path)
    assert load_model(tmp_path / "fold-00").rate == 30.0


def test_a_description_of_something_else_is_refused_though_its_sum_is_right(tmp_path: Path) -> None:
    path = tmp_path / "m"
    model_of().save(path)
    description, tensors = read_model_file(path)
    for key, value in {"rate": "fast", "basis": {}, "filter": {}, "targets": ["leg"], "labels": ["a"]}.items():
        write_model_file(path, {**description, key: value}, tensors)
        with pytest.raises(ValueError, match="m: a model whose parts do not fit together"):
            load_model(path)
    assert (KIND, VERSION) == ("torch_ebip model", 8)


def test_a_filter_that_does_not_weigh_forecasts_labelled_interactions_too() -> None:
    made = interactions(8)
    labelled = Demonstrations(made.layout, list(made), made.rate, labels=["wave"] * 4 + ["point"] * 4)
    primitive = InteractionPrimitive.fit(labelled)
    said = InteractionModel(ebip(primitive), primitive).forecast(made[0], [0.1])
    assert said.mean.isfinite().all()
    assert said.labels is None
