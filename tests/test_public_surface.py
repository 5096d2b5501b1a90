"""The public names and their signatures: a change to them is a decision, and the design's are a contract."""

from __future__ import annotations

import ast
import dataclasses
import difflib
import inspect
from typing import Any

import pytest

import torch_ebip
from tests.public_surface import COMMAND, REVIEWED, surface
from torch_ebip import EnsembleState, GaussianState, ParticleState

# What other people's code calls (the design's section 3): these parameters, by these names and in this order, with
# these defaults. Further ones may follow if they can be left out.
CONTRACT = {
    "Modality": "name, dofs, unit, controlled=False",
    "Layout": "modalities",
    "Layout.slice": "name",
    "Layout.mask": "names",
    "Demonstrations": "layout, trajectories, rate",
    "Demonstrations.__len__": "",
    "Demonstrations.__getitem__": "index",
    "Demonstrations.subset": "indices",
    "Demonstrations.folds": "k, generator",
    "Demonstrations.pad": "",
    "Demonstrations.save": "path",
    "Demonstrations.load": "path",
    "GaussianBasis": "n_features, width=None",
    "PolynomialBasis": "degree",
    "SigmoidBasis": "n_features, width=None",
    "BSplineBasis": "n_features, degree=3",
    "Basis.forward": "phase",
    "Basis.derivative": "phase",
    "StackedBasis": "bases",
    "StackedBasis.project": "phase, weights",
    "StackedBasis.project_derivative": "phase, weights",
    "select_basis": "demonstrations, candidates=None",
    "InteractionPrimitive.fit": "demonstrations, basis=None",
    "ebip": "primitive",
    "ebip_minus": "primitive, n_members",
    "bip": "primitive",
    "particle_filter": "primitive",
    "functional.ensemble_update": "members, projections, y, noise_cholesky, perturbations, observed=None",
    "functional.systematic_resample": "log_weights, u",
    "RobotArm.ur5": "tool=None",
    "RobotArm.forward": "joints",
    "ForwardKinematicsLoss": "arm, rotation_weight",
    "ForwardKinematicsLoss.forward": "predicted_joints, target_joints",
}
FILTER = {
    "initial_state": "batch_shape=(), demonstrations=None, generator=None",
    "predict": "state, dt, generator=None",
    "update": "state, y, observed=None, generator=None",
    "forward": "y, observed=None, dt, state=None, generator=None",
}
CONTRACT |= {
    f"{kind}.{name}": parameters
    for kind in ("Filter", "EnsembleFilter", "ExtendedFilter", "ParticleFilter", "InteractionFilter")
    for name, parameters in FILTER.items()
}
CONTRACT["InteractionFilter.forecast"] = "state, phase=None"
PROPERTIES = {
    "Layout": ["dofs", "controlled"],
    "Demonstrations": ["durations"],
    "StackedBasis": ["n_weights"],
    "InteractionTrace": ["phase"],
}
FIELDS = {
    "Forecast": ["mean", "variance"],
}


def test_the_public_names_are_those_that_were_reviewed() -> None:
    reviewed, found = REVIEWED.read_text(encoding="utf-8").splitlines(), surface().splitlines()
    change = "\n".join(difflib.unified_diff(reviewed, found, "reviewed", "found", lineterm="", n=2))
    assert found == reviewed, f"the public surface changed:\n{change}\nIf that is meant, accept it: {COMMAND}"


def test_a_change_shows_in_the_listing(monkeypatch: pytest.MonkeyPatch) -> None:
    def forward(self: Any, batch_shape: tuple[int, ...] = (1,)) -> None: ...

    before = surface().splitlines()
    monkeypatch.setattr(torch_ebip.Layout, "colour", property(lambda self: "red"), raising=False)
    monkeypatch.setattr(torch_ebip.GaussianPrior, "forward", forward)
    monkeypatch.delattr(torch_ebip.Demonstrations, "pad")
    change = [line for line in difflib.ndiff(before, surface().splitlines()) if line[0] in "+-"]
    assert change == [
        "-     def forward(batch_shape: tuple[int, ...], n_members: int, chosen: Tensor | None = None, "
        "generator: Generators = None) -> Tensor",
        "+     def forward(batch_shape: tuple[int, ...] = (1,)) -> None",
        "-     def pad() -> tuple[Tensor, Tensor]",
        "+     colour: property -> not said",
    ]


@pytest.mark.parametrize("name", CONTRACT)
def test_the_designs_parameters_are_there(name: str) -> None:
    expected = _written(CONTRACT[name])
    found = [parameter for parameter in _parameters(_named(name)) if parameter.name != "self"]
    assert [parameter.name for parameter in found[: len(expected)]] == list(expected)
    for parameter, default in zip(found, expected.values(), strict=False):
        assert parameter.kind is parameter.POSITIONAL_OR_KEYWORD
        assert default is ... or parameter.default == default, parameter
    assert all(parameter.default is not parameter.empty for parameter in found[len(expected) :])


def test_the_designs_attributes_are_there(primitive: torch_ebip.InteractionPrimitive) -> None:
    for name, properties in PROPERTIES.items():
        for attribute in properties:
            assert isinstance(inspect.getattr_static(_named(name), attribute), property), (name, attribute)
    for name, fields in FIELDS.items():
        assert list(_named(name)._fields[: len(fields)]) == fields
    traced = {field.name for field in dataclasses.fields(torch_ebip.Trace)}
    assert {"state", "states", "log_likelihood", "projection"} <= traced
    for state in (EnsembleState, GaussianState, ParticleState):
        assert hasattr(state, "mean"), state
        assert hasattr(state, "covariance"), state
    for attribute in ("weights", "phase_velocity", "residual_variance", "layout", "basis"):
        assert hasattr(primitive, attribute), attribute


def _named(name: str) -> Any:
    thing: Any = torch_ebip
    for part in name.split("."):
        thing = getattr(thing, part)
    return thing


def _parameters(thing: Any) -> list[inspect.Parameter]:
    return list(inspect.signature(thing).parameters.values())


def _written(parameters: str) -> dict[str, Any]:
    """Names and defaults of a parameter list as it is written; ... where the design leaves the default open."""
    pairs = (part.partition("=") for part in parameters.split(", ") if part)
    return {name: ast.literal_eval(default) if default else ... for name, _, default in pairs}
