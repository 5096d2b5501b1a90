"""How the phase moves, one idea a file. A line here exports a phase model to `torch_ebip` itself."""

from typing import TYPE_CHECKING

from torch_ebip.common.exports import exported
from torch_ebip.interaction.phases.accelerating import AcceleratingPhase as AcceleratingPhase
from torch_ebip.interaction.phases.constant_velocity import ConstantVelocityPhase as ConstantVelocityPhase
from torch_ebip.interaction.phases.cyclic import CyclicPhase as CyclicPhase
from torch_ebip.interaction.phases.drifting import DriftingPhase as DriftingPhase
from torch_ebip.interaction.phases.phase import PhaseModel as PhaseModel

if not TYPE_CHECKING:  # a type checker reads the lines above
    __all__ = exported(globals())
