"""torch_ebip: differentiable ensemble filters for human-robot interaction.

Ensemble Bayesian Interaction Primitives (Campbell, Stepputtis & Ben Amor, RSS 2019) as PyTorch modules, over a filter
layer for any dynamics and any measurement.
"""

from torch_ebip.filtering import (
    AboveOne,
    EnsembleFilter,
    EnsembleState,
    ExtendedFilter,
    Filter,
    Gate,
    GaussianPrior,
    GaussianState,
    Huber,
    Inflation,
    Localisation,
    MeasurementNoise,
    NoProcessNoise,
    ParticleFilter,
    ParticleState,
    Positive,
    RobustWeights,
    SquareRoot,
    StateSpace,
    Stochastic,
    StudentT,
    Trace,
    Update,
    View,
    functional,
)
from torch_ebip.interaction import (
    Basis,
    BasisProjection,
    BSplineBasis,
    ConstantVelocityPhase,
    DemonstrationPrior,
    DemonstrationTable,
    EvidenceWeighting,
    Forecast,
    GaussianBasis,
    InteractionFilter,
    InteractionNoise,
    InteractionPrimitive,
    InteractionTrace,
    MixturePrior,
    MomentPrior,
    PhaseGatedNoise,
    PhaseNoise,
    PolynomialBasis,
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
from torch_ebip.kinematics import RobotArm
from torch_ebip.learning import (
    ForecastObjective,
    ForwardKinematicsLoss,
    InnovationLikelihoodLoss,
    Monitor,
    TrajectoryLoss,
    Tuner,
    TuningResult,
    TuningSettings,
)
from torch_ebip.live import InteractionSession, LiveFilter, SessionForecast, SessionSettings, replay
from torch_ebip.recordings import Demonstrations, Layout, Modality

__all__ = [
    "AboveOne",
    "BSplineBasis",
    "Basis",
    "BasisProjection",
    "ConstantVelocityPhase",
    "DemonstrationPrior",
    "DemonstrationTable",
    "Demonstrations",
    "EnsembleFilter",
    "EnsembleState",
    "EvidenceWeighting",
    "ExtendedFilter",
    "Filter",
    "Forecast",
    "ForecastObjective",
    "ForwardKinematicsLoss",
    "Gate",
    "GaussianBasis",
    "GaussianPrior",
    "GaussianState",
    "Huber",
    "Inflation",
    "InnovationLikelihoodLoss",
    "InteractionFilter",
    "InteractionNoise",
    "InteractionPrimitive",
    "InteractionSession",
    "InteractionTrace",
    "Layout",
    "LiveFilter",
    "Localisation",
    "MeasurementNoise",
    "MixturePrior",
    "Modality",
    "MomentPrior",
    "Monitor",
    "NoProcessNoise",
    "ParticleFilter",
    "ParticleState",
    "PhaseGatedNoise",
    "PhaseNoise",
    "PolynomialBasis",
    "Positive",
    "RobotArm",
    "RobustWeights",
    "SessionForecast",
    "SessionSettings",
    "SigmoidBasis",
    "SquareRoot",
    "StackedBasis",
    "StateSpace",
    "Stochastic",
    "StudentT",
    "Trace",
    "TrajectoryLoss",
    "Tuner",
    "TuningResult",
    "TuningSettings",
    "Update",
    "View",
    "WeightNoise",
    "bip",
    "ebip",
    "ebip_minus",
    "functional",
    "interaction_model",
    "particle_filter",
    "replay",
    "select_basis",
]


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
