"""What happens at a measurement, one idea a file. A line here exports a part to `torch_ebip` itself."""

from typing import TYPE_CHECKING

from torch_ebip.common.exports import exported
from torch_ebip.filtering.updates.cauchy import Cauchy as Cauchy
from torch_ebip.filtering.updates.gate import Gate as Gate
from torch_ebip.filtering.updates.huber import Huber as Huber
from torch_ebip.filtering.updates.inflation import Inflation as Inflation
from torch_ebip.filtering.updates.inflation import SpreadRule as SpreadRule
from torch_ebip.filtering.updates.localisation import Localisation as Localisation
from torch_ebip.filtering.updates.part import Part as Part
from torch_ebip.filtering.updates.recent import Recent as Recent
from torch_ebip.filtering.updates.relaxation import RelaxationToPrior as RelaxationToPrior
from torch_ebip.filtering.updates.rules import Rule as Rule
from torch_ebip.filtering.updates.rules import SquareRoot as SquareRoot
from torch_ebip.filtering.updates.rules import Stochastic as Stochastic
from torch_ebip.filtering.updates.student_t import StudentT as StudentT
from torch_ebip.filtering.updates.trust import RobustWeights as RobustWeights
from torch_ebip.filtering.updates.update import Update as Update
from torch_ebip.filtering.updates.weighting import Weighting as Weighting

if not TYPE_CHECKING:  # a type checker reads the lines above
    __all__ = exported(globals())
