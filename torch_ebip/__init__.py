"""torch_ebip: differentiable ensemble filters for human-robot interaction.

Ensemble Bayesian Interaction Primitives (Campbell, Stepputtis & Ben Amor, RSS 2019) as PyTorch modules, over a filter
layer for any dynamics and any measurement.
"""

from torch_ebip.common.exports import exported as _exported
from torch_ebip.common.former import keep_former_paths as _keep_former_paths
from torch_ebip.filtering import (
    AboveOne,
    EnsembleFilter,
    EnsembleState,
    ExtendedFilter,
    Filter,
    GaussianPrior,
    GaussianState,
    MeasurementNoise,
    NoProcessNoise,
    ParticleFilter,
    ParticleState,
    Positive,
    StateSpace,
    Trace,
    View,
    functional,
)
from torch_ebip.filtering import (
    updates as _updates,
)
from torch_ebip.filtering.updates import *
from torch_ebip.interaction import (
    AnalogueReadout,
    Analogues,
    Basis,
    BasisProjection,
    BSplineBasis,
    DemonstrationPrior,
    DemonstrationTable,
    EvidenceWeighting,
    Expert,
    Forecast,
    FourierBasis,
    GaussianBasis,
    HorizonShrinkage,
    InteractionFilter,
    InteractionNoise,
    InteractionPrimitive,
    InteractionTrace,
    MixturePrior,
    MomentPrior,
    PeriodicBSplineBasis,
    PhaseBank,
    PhaseGatedNoise,
    PhaseNoise,
    PolynomialBasis,
    Recognition,
    Shrinkage,
    SigmoidBasis,
    StackedBasis,
    WeightNoise,
    bip,
    ebip,
    ebip_minus,
    interaction_model,
    particle_filter,
    select_basis,
)
from torch_ebip.interaction import (
    phases as _phases,
)
from torch_ebip.interaction.phases import *
from torch_ebip.kinematics import RobotArm
from torch_ebip.learning import (
    CRPSLoss,
    EnergyScoreLoss,
    ForecastObjective,
    ForwardKinematicsLoss,
    InnovationLikelihoodLoss,
    InteractionModel,
    Monitor,
    TrajectoryLoss,
    Tuner,
    TuningResult,
    TuningSettings,
    learn,
    load_model,
)
from torch_ebip.live import InteractionSession, LiveFilter, SessionForecast, SessionSettings, replay
from torch_ebip.recordings import Demonstrations, Layout, Modality

__all__ = [
    "AboveOne",
    "AnalogueReadout",
    "Analogues",
    "BSplineBasis",
    "Basis",
    "BasisProjection",
    "CRPSLoss",
    "DemonstrationPrior",
    "DemonstrationTable",
    "Demonstrations",
    "EnergyScoreLoss",
    "EnsembleFilter",
    "EnsembleState",
    "EvidenceWeighting",
    "Expert",
    "ExtendedFilter",
    "Filter",
    "Forecast",
    "ForecastObjective",
    "ForwardKinematicsLoss",
    "FourierBasis",
    "GaussianBasis",
    "GaussianPrior",
    "GaussianState",
    "HorizonShrinkage",
    "InnovationLikelihoodLoss",
    "InteractionFilter",
    "InteractionModel",
    "InteractionNoise",
    "InteractionPrimitive",
    "InteractionSession",
    "InteractionTrace",
    "Layout",
    "LiveFilter",
    "MeasurementNoise",
    "MixturePrior",
    "Modality",
    "MomentPrior",
    "Monitor",
    "NoProcessNoise",
    "ParticleFilter",
    "ParticleState",
    "PeriodicBSplineBasis",
    "PhaseBank",
    "PhaseGatedNoise",
    "PhaseNoise",
    "PolynomialBasis",
    "Positive",
    "Recognition",
    "RobotArm",
    "SessionForecast",
    "SessionSettings",
    "Shrinkage",
    "SigmoidBasis",
    "StackedBasis",
    "StateSpace",
    "Trace",
    "TrajectoryLoss",
    "Tuner",
    "TuningResult",
    "TuningSettings",
    "View",
    "WeightNoise",
    "bip",
    "ebip",
    "ebip_minus",
    "functional",
    "interaction_model",
    "learn",
    "load_model",
    "particle_filter",
    "replay",
    "select_basis",
]
__all__ += _exported(vars(_updates))
__all__ += _exported(vars(_phases))

_keep_former_paths()


def __getattr__(name: str) -> str:
    """``__version__``: looked up when somebody asks, which takes as long as importing all the rest."""
    if name != "__version__":
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version("torch-ebip")
    except PackageNotFoundError:  # run from a checkout that nobody installed
        return "unknown"


def __dir__() -> list[str]:
    """What is offered, and nothing of how it is made."""
    return [*__all__, "__version__", "__doc__"]
