"""A state dict of a module that means something else is refused by name, whole, whatever its shapes."""

from __future__ import annotations

import copy
import io
from collections.abc import Callable

import pytest
import torch
from torch import nn

from tests.conftest import interactions, layout
from torch_ebip import (
    AboveOne,
    BSplineBasis,
    Demonstrations,
    GaussianBasis,
    Huber,
    InteractionPrimitive,
    Layout,
    Modality,
    PolynomialBasis,
    Positive,
    RobotArm,
    StackedBasis,
    StudentT,
    bip,
    ebip,
    particle_filter,
)
from torch_ebip.common.meaning import MeaningError
from torch_ebip.learning.objective import ForecastObjective

BASIS = StackedBasis([BSplineBasis(6)] * 5)


def primitive(
    basis: StackedBasis = BASIS, names: str = "xy", unit: str = "m", rate: float = 30.0
) -> InteractionPrimitive:
    made = interactions(8)
    first, *rest = layout().modalities
    hand = Modality("hand", [f"hand.{name}" for name in names], unit)
    assert first.name == "hand"
    return InteractionPrimitive.fit(Demonstrations(Layout([hand, *rest]), list(made), rate), basis)


MEANINGS: dict[str, tuple[Callable[[], nn.Module], Callable[[], nn.Module], str]] = {
    "family of basis": (
        lambda: ebip(primitive()),
        lambda: ebip(primitive(StackedBasis([PolynomialBasis(5)] * 5))),
        r"unique.0 is BSplineBasis\(n_features=6, degree=3\) there and PolynomialBasis\(degree=5\) here",
    ),
    "order of bases": (
        lambda: ebip(primitive(StackedBasis([BSplineBasis(6), GaussianBasis(6)] * 2 + [BSplineBasis(6)]))),
        lambda: ebip(primitive(StackedBasis([BSplineBasis(6)] * 3 + [GaussianBasis(6)] * 2))),
        "bases=",
    ),
    "order of columns": (lambda: bip(primitive()), lambda: bip(primitive(names="yx")), r"hand\.x, hand\.y.*there"),
    "rate": (lambda: ebip(primitive()), lambda: ebip(primitive(rate=60.0)), "dt="),
    "tails": (
        lambda: ebip(primitive(), robust=StudentT(3.0)),
        lambda: ebip(primitive(), robust=Huber(3.0)),
        r"analysis.trust.0 is StudentT\(\) there and Huber\(\) here",
    ),
    "prior": (lambda: ebip(primitive()), lambda: bip(primitive()), "itself is InteractionEnsembleFilter"),
    "context": (
        lambda: ebip(primitive(), context=BSplineBasis(4)),
        lambda: ebip(primitive(), context=PolynomialBasis(3)),
        "model.measurement_noise.context",
    ),
    "primitive": (
        lambda: primitive(),
        lambda: primitive(StackedBasis([GaussianBasis(6)] * 5)),
        "another InteractionPrimitive",
    ),
    "unit": (lambda: primitive(), lambda: primitive(unit="N"), r"hand.x \[m\].*hand.x \[N\]"),
    "targets": (
        lambda: ForecastObjective(primitive(), layout().mask(["hand"])),
        lambda: ForecastObjective(primitive(), layout().mask(["arm"])),
        "targets=hand.x, hand.y",
    ),
    "arm": (
        lambda: RobotArm(PLANAR.format(1.0), "tip"),
        lambda: RobotArm(PLANAR.format(2.0), "tip"),
        "another RobotArm",
    ),
}
PLANAR = """<robot name="r"><link name="base"/><link name="tip"/><joint name="j" type="continuous">
<parent link="base"/><child link="tip"/><origin xyz="{} 0 0"/><axis xyz="0 0 1"/></joint></robot>"""


@pytest.mark.parametrize("kind", MEANINGS)
def test_another_meaning_is_refused_and_nothing_of_it_loaded(kind: str) -> None:
    make, make_other, message = MEANINGS[kind]
    source, target = make(), make_other()
    with torch.no_grad():
        for parameter in source.parameters():
            parameter.add_(1.0)
    before = copy.deepcopy(target.state_dict())
    for strict in (True, False):
        with pytest.raises(MeaningError, match=message):
            target.load_state_dict(source.state_dict(), strict=strict)
    # Inside of somebody else's module as well, and after a way through a file.
    holder, other = nn.ModuleDict({"a": nn.Linear(1, 1), "filter": target}), nn.ModuleDict()
    other.update({"a": nn.Linear(1, 1), "filter": source})
    stream = io.BytesIO()
    torch.save(other.state_dict(), stream)
    stream.seek(0)
    with pytest.raises(RuntimeError, match=message):
        holder.load_state_dict(torch.load(stream, weights_only=True))
    for name, value in target.state_dict().items():
        assert torch.equal(value, before[name]), name


@pytest.mark.parametrize("kind", MEANINGS)
def test_the_same_meaning_loads(kind: str) -> None:
    make, _, _ = MEANINGS[kind]
    source, target = make(), make()
    with torch.no_grad():
        for parameter in source.parameters():
            parameter.add_(1.0)
    state = {name: value.clone() for name, value in source.state_dict().items()}  # all of them are tensors
    assert str(target.load_state_dict(state)) == "<All keys matched successfully>"
    for name, parameter in source.named_parameters():
        assert torch.equal(parameter, dict(target.named_parameters())[name])


def test_how_a_filter_runs_is_no_meaning() -> None:
    """Other numbers of members, kinds of update, starts of what is learned."""
    tuned = ebip(primitive(), robust=StudentT(3.0))
    for other in (
        ebip(primitive(), 20, robust=StudentT(5.0)),
        ebip(primitive(), square_root=True, robust=StudentT()),
    ):
        state = {name: value for name, value in tuned.state_dict().items() if "prior" not in name}
        other.load_state_dict(state, strict=False)
        assert torch.equal(other.analysis.trust[0].scale.start, tuned.analysis.trust[0].scale.start)
    ours, theirs = particle_filter(primitive(), softness=0.1), particle_filter(primitive(), softness=0.2)
    assert str(ours.load_state_dict(theirs.state_dict())) == "<All keys matched successfully>"


def test_a_state_dict_from_before_loads_with_a_warning() -> None:
    made = ebip(primitive())
    old = {name: value.clone() for name, value in made.state_dict().items() if "_extra_state" not in name}
    old["model.measurement_noise.variance.raw"] += 0.5
    with pytest.warns(UserWarning, match="does not say what its InteractionEnsembleFilter means"):
        made.load_state_dict(old)
    assert (made.model.measurement_noise.variance.raw == 0.5).all()


@pytest.mark.parametrize("damage", [torch.zeros(3, dtype=torch.uint8), torch.ones(2), "text", None])
def test_a_meaning_that_is_damaged_is_refused(damage: object) -> None:
    made = ebip(primitive())
    with pytest.raises(MeaningError, match="does not say what its InteractionEnsembleFilter means"):
        made.load_state_dict({**made.state_dict(), "_extra_state": damage})


def test_constraints_are_part_of_it() -> None:
    """The same raw number means another value under another constraint."""

    def with_inflation(module: nn.Module) -> nn.Module:
        return ebip(primitive(), inflation=module)

    with pytest.raises(MeaningError, match=r"inflation.factor is AboveOne\(.*there and Positive\("):
        with_inflation(Positive(torch.tensor(1.1))).load_state_dict(
            with_inflation(AboveOne(torch.tensor(1.1))).state_dict()
        )
