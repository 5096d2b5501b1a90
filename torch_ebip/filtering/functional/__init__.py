"""Pure kernels: no state, no randomness of their own, leading batch dimensions."""

from torch_ebip.filtering.functional.innovation import Innovation, Taper, innovation_of, log_likelihood
from torch_ebip.filtering.functional.linear import FactorisationError, add_product, cholesky
from torch_ebip.filtering.functional.moments import ensemble_covariance, ensemble_mean, ensemble_variance
from torch_ebip.filtering.functional.resampling import systematic_resample
from torch_ebip.filtering.functional.update import (
    Spread,
    apply_gain,
    ensemble_update,
    square_root_moves,
    square_root_update,
    stochastic_moves,
)

__all__ = [
    "FactorisationError",
    "Innovation",
    "Spread",
    "Taper",
    "add_product",
    "apply_gain",
    "cholesky",
    "ensemble_covariance",
    "ensemble_mean",
    "ensemble_update",
    "ensemble_variance",
    "innovation_of",
    "log_likelihood",
    "square_root_moves",
    "square_root_update",
    "stochastic_moves",
    "systematic_resample",
]
