"""torch_ebip: differentiable ensemble filters for human-robot interaction.

Ensemble Bayesian Interaction Primitives (Campbell, Stepputtis & Ben Amor, RSS 2019) as PyTorch modules.
"""

from torch_ebip import functional
from torch_ebip.basis import (
    Basis,
    BSplineBasis,
    GaussianBasis,
    PolynomialBasis,
    SigmoidBasis,
    StackedBasis,
    select_basis,
)
from torch_ebip.demonstrations import Demonstrations
from torch_ebip.filters import (
    EnsembleFilter,
    ExtendedFilter,
    Filter,
    Forecast,
    LiveFilter,
    ParticleFilter,
    Trace,
    bip,
    ebip,
    ebip_minus,
    particle_filter,
)
from torch_ebip.kinematics import RobotArm
from torch_ebip.layout import Layout, Modality
from torch_ebip.losses import ForwardKinematicsLoss
from torch_ebip.primitive import InteractionPrimitive

__all__ = [
    "BSplineBasis",
    "Basis",
    "Demonstrations",
    "EnsembleFilter",
    "ExtendedFilter",
    "Filter",
    "Forecast",
    "ForwardKinematicsLoss",
    "GaussianBasis",
    "InteractionPrimitive",
    "Layout",
    "LiveFilter",
    "Modality",
    "ParticleFilter",
    "PolynomialBasis",
    "RobotArm",
    "SigmoidBasis",
    "StackedBasis",
    "Trace",
    "bip",
    "ebip",
    "ebip_minus",
    "functional",
    "particle_filter",
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
