"""Pure kernels: no state, no randomness of their own, leading batch dimensions."""

from torch_ebip.functional.linear import FactorisationError, add_product, cholesky
from torch_ebip.functional.moments import ensemble_covariance, ensemble_mean, ensemble_variance
from torch_ebip.functional.resampling import systematic_resample
from torch_ebip.functional.update import Taper, ensemble_update, square_root_update

__all__ = [
    "FactorisationError",
    "Taper",
    "add_product",
    "cholesky",
    "ensemble_covariance",
    "ensemble_mean",
    "ensemble_update",
    "ensemble_variance",
    "square_root_update",
    "systematic_resample",
]
