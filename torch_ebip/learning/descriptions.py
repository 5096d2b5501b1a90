"""How a model is put together, in plain values: what its tensors alone do not say.

Nothing is looked up by a name that a file chooses: every family that can be built is in a table here.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from torch_ebip.filtering.noise.constraints import AboveOne, Positive
from torch_ebip.filtering.updates.cauchy import Cauchy
from torch_ebip.filtering.updates.gate import Gate
from torch_ebip.filtering.updates.huber import Huber
from torch_ebip.filtering.updates.inflation import Inflation
from torch_ebip.filtering.updates.rules import SquareRoot
from torch_ebip.filtering.updates.student_t import StudentT
from torch_ebip.filtering.updates.trust import RobustWeights
from torch_ebip.interaction.basis.base import Basis
from torch_ebip.interaction.basis.bspline import BSplineBasis
from torch_ebip.interaction.basis.gaussian import GaussianBasis
from torch_ebip.interaction.basis.periodic import FourierBasis, PeriodicBSplineBasis
from torch_ebip.interaction.basis.polynomial import PolynomialBasis
from torch_ebip.interaction.basis.sigmoid import SigmoidBasis
from torch_ebip.interaction.basis.stacked import StackedBasis
from torch_ebip.interaction.evidence import EvidenceWeighting
from torch_ebip.interaction.filter_kinds import InteractionEnsembleFilter
from torch_ebip.interaction.filters import InteractionFilter
from torch_ebip.interaction.gated_noise import PhaseGatedNoise
from torch_ebip.interaction.noise import InteractionNoise
from torch_ebip.interaction.phases.accelerating import AcceleratingPhase
from torch_ebip.interaction.phases.constant_velocity import ConstantVelocityPhase
from torch_ebip.interaction.phases.cyclic import CyclicPhase
from torch_ebip.interaction.phases.drifting import DriftingPhase
from torch_ebip.interaction.phases.phase import PhaseModel
from torch_ebip.interaction.present import recent_of
from torch_ebip.interaction.presets import ebip
from torch_ebip.interaction.primitive import InteractionPrimitive
from torch_ebip.interaction.recognition import PHASES, Recognition
from torch_ebip.learning.caution import describe_caution, give_caution
from torch_ebip.learning.pacing import describe_pace, pace_of
from torch_ebip.learning.readout_descriptions import describe_readout, readout_of
from torch_ebip.recordings.layout import Layout, Modality

BASES: dict[str, type[Basis]] = {
    family.__name__: family
    for family in (BSplineBasis, FourierBasis, GaussianBasis, PeriodicBSplineBasis, PolynomialBasis, SigmoidBasis)
}
TRUST: dict[str, Callable[[], RobustWeights]] = {"Cauchy": Cauchy, "Gate": Gate, "Huber": Huber, "StudentT": StudentT}
OPTIONS = (
    "n_members",
    "square_root",
    "weigh",
    "forgetting",
    "primacy",
    "slope",
    "relative",
    "localise",
    "weight_noise",
    "context",
    "robust",
    "inflation",
    "phase",
)
"""Of `ebip`."""

Description = dict[str, Any]


def describe_layout(layout: Layout) -> list[Description]:
    """A layout's modalities in order, in plain values."""
    return [
        {"name": m.name, "dofs": list(m.dofs), "unit": m.unit, "controlled": m.controlled}
        | ({} if m.kind == "plain" else {"kind": m.kind, "centre": m.centre and list(m.centre)})
        for m in layout.modalities
    ]


def layout_of(description: Sequence[Description]) -> Layout:
    """The layout that `describe_layout` described."""
    return Layout([
        Modality(m["name"], m["dofs"], m["unit"], m["controlled"], m.get("kind", "plain"), m.get("centre"))
        for m in description
    ])  # fmt: skip


def describe_basis(basis: Basis) -> Description:
    """One family of functions.

    Raises:
        TypeError: one that is not the library's.
    """
    family = type(basis).__name__
    if BASES.get(family) is not type(basis):
        raise TypeError(f"a model file keeps the bases {', '.join(BASES)}, not {family}")
    return {"family": family, **basis.settings()}


def basis_of(description: Description) -> Basis:
    """The basis that `describe_basis` described."""
    settings = dict(description)
    return BASES[settings.pop("family")](**settings)


def describe_stack(basis: StackedBasis) -> Description:
    """A basis a DoF: each different one once, and which a DoF has."""
    families = basis.families
    return {
        "families": [describe_basis(family) for family in families],
        "of_dof": [families.index(each) for each in basis.bases],
    }


def stack_of(description: Description) -> StackedBasis:
    """The stack that `describe_stack` described."""
    families = [basis_of(family) for family in description["families"]]
    return StackedBasis([families[i] for i in description["of_dof"]])


def describe_filter(filter: InteractionFilter, primitive: InteractionPrimitive) -> Description:
    """With which options `ebip` makes a filter of a primitive, but for its numbers.

    Raises:
        TypeError: `ebip` does not make such a filter; says what in it is another.
    """
    if type(filter) is not InteractionEnsembleFilter:
        raise TypeError(f"a model file keeps filters that `ebip` makes, not {type(filter).__name__}")
    update, noise = filter.analysis, filter.model.measurement_noise
    inflation, weighting = update.inflation, update.weighting
    learned = isinstance(inflation, Inflation) and isinstance(inflation.factor, nn.Module)
    description: Description = {
        "n_members": filter.n_members,
        "square_root": isinstance(update.rule, SquareRoot),
        "weigh": update.weighting is not None,
        "forgetting": weighting.forgetting.start.tolist() if isinstance(weighting, EvidenceWeighting) else 6.0,
        "primacy": weighting.primacy.start.tolist() if isinstance(weighting, EvidenceWeighting) else 0.0,
        "slope": weighting.slope.start.tolist() if isinstance(weighting, EvidenceWeighting) else 2.0,
        "relative": weighting.relative.start.item() if isinstance(weighting, EvidenceWeighting) else 0.0,
        "localise": update.localisation is not None,
        "weight_noise": isinstance(filter.model.process_noise, InteractionNoise)
        and filter.model.process_noise.weights is not None,
        "context": describe_basis(noise.context) if isinstance(noise, PhaseGatedNoise) else None,
        "robust": type(update.trust[0]).__name__ if len(update.trust) else None,
        "inflation": "learned" if learned else float(inflation.factor) if isinstance(inflation, Inflation) else None,  # type: ignore[arg-type]
        "phase": _describe_phase(filter.phase_model),
        "readout": describe_readout(filter.readout),
        "recent": None if update.recent is None else list(update.recent.windows),
        "recognition": filter.recognition is not None and len(filter.recognition.sharpness) > 0,
        "pace": describe_pace(filter),
        **describe_caution(filter),
    }
    again = build_filter(primitive, description)
    ours, theirs = ({name: type(m).__name__ for name, m in each.named_modules()} for each in (filter, again))
    strange = sorted(name for name in {**ours, **theirs} if ours.get(name) != theirs.get(name))
    if strange:
        raise TypeError(f"a model file does not keep the filter's {strange[0]}, {ours.get(strange[0], 'missing')}")
    shapes = [{name: list(t.shape) for name, t in tensors_of(each).items()} for each in (filter, again)]
    if shapes[0] != shapes[1] or filter.meaning() != again.meaning():
        raise TypeError("a model file does not keep this filter: it has settings that `ebip` does not give")
    return description


def build_filter(primitive: InteractionPrimitive, description: Description) -> InteractionEnsembleFilter:
    """The filter that `describe_filter` described, of a primitive; its numbers are still to be filled in.

    Raises:
        ValueError: a description of no filter.
    """
    try:
        options = {
            name: description[name] for name in OPTIONS if name in description
        }  # older files say nothing of memories
        readout = description["readout"]
        if options["context"] is not None:
            options["context"] = basis_of(options["context"])
        if options["robust"] is not None:
            options["robust"] = TRUST[options["robust"]]()
        if options["inflation"] == "learned":
            options["inflation"] = AboveOne(primitive.weights.new_tensor(1.5))
        options["weight_noise"] = 1.0 if options["weight_noise"] else None
        options["phase"] = _phase_of(options["phase"])
        filter = ebip(primitive, **options)
        weighting = filter.analysis.weighting
        if (
            description.get("recognition")
            and isinstance(weighting, EvidenceWeighting)
            and primitive.labels is not None
        ):
            ones = primitive.weights.new_ones(len(weighting.forgetting.start), len(PHASES))
            filter.recognition = Recognition(primitive.labels, ones).to(primitive.weights)
        filter.readout = None if readout is None else readout_of(readout, primitive)
        if description.get("recent") is not None:  # older files know of none
            windows = description["recent"]
            windows = windows if isinstance(windows, list) else [windows]  # before version 6: one
            filter.analysis.recent = recent_of(primitive, float(windows[0]), [float(w) for w in windows[1:]])
        filter.analysis.pace = pace_of(primitive, description.get("pace"))  # files before version 7 know of none
        give_caution(filter, primitive, description)
        return filter
    except (AttributeError, ArithmeticError, LookupError, TypeError, ValueError) as error:
        raise ValueError(f"a description of no filter that `ebip` makes: {error}") from error


def tensors_of(filter: nn.Module) -> dict[str, Tensor]:
    """Parameters and persistent buffers [...] by name."""
    return {
        name: tensor
        for name, tensor in filter.state_dict().items()
        if isinstance(tensor, Tensor) and not name.endswith("_extra_state")
    }


def own_tensors(filter: nn.Module, made: nn.Module) -> dict[str, Tensor]:
    """What a filter has and one just ``made`` with the same options has not: its numbers [...], by name."""
    theirs = tensors_of(made)
    return {name: tensor for name, tensor in tensors_of(filter).items() if not torch.equal(tensor, theirs[name])}


def updated(description: Description, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Tensors [...] by name of a filter that a file described, as this version names and means them."""
    tensors = dict(tensors)
    for name, tensor in tensors.items():  # of a single memory, which had no dimension of its own
        if tensor.ndim == 0 and name.split(".")[-2] in ("sharpness", "forgetting", "slope"):
            tensors[name] = tensor.unsqueeze(0)
    raw = "analysis.weighting.slope.raw"
    if raw in tensors and "slope" not in description:  # it could only be positive, and started at 2
        former = Positive(torch.full_like(tensors[raw], 2.0))
        former.load_state_dict({"start": former.start, "raw": tensors[raw]})
        tensors[raw] = former.value.detach() - former.start
    return tensors


@torch.no_grad()
def fill(filter: nn.Module, tensors: Mapping[str, Tensor]) -> None:
    """Give a filter the tensors [...] by name, all of those that it does not have from its primitive.

    Raises:
        ValueError: a tensor that it does not have, or of another shape.
    """
    places = tensors_of(filter)
    for name, tensor in tensors.items():
        if name not in places or places[name].shape != tensor.shape:
            expected = list(places[name].shape) if name in places else "none of that name"
            raise ValueError(f"a tensor {name} {list(tensor.shape)}, expected {expected}")
        places[name].copy_(tensor)


def _describe_phase(phase: PhaseModel) -> Description:
    family = type(phase)
    if family not in (AcceleratingPhase, ConstantVelocityPhase, CyclicPhase, DriftingPhase):
        raise TypeError(f"a model file keeps the phases of the library, not {family.__name__}")
    return {"family": family.__name__, "overrun": phase.overrun}


def _phase_of(description: Description) -> PhaseModel:
    if description["family"] == "ConstantVelocityPhase":
        return ConstantVelocityPhase(description["overrun"])
    if description["family"] == "CyclicPhase":
        return CyclicPhase(description["overrun"])
    if description["family"] == "AcceleratingPhase":
        return AcceleratingPhase(description["overrun"])
    if description["family"] == "DriftingPhase":
        return DriftingPhase(1.0, description["overrun"])
    raise ValueError(f"no phase {description['family']!r}")
