"""torch_ebip."""

from torch_ebip.demonstrations import Demonstrations
from torch_ebip.layout import Layout, Modality

__all__ = ["Demonstrations", "Layout", "Modality"]
