"""What people bring: a layout of degrees of freedom, demonstrations on it, and their files."""

from torch_ebip.recordings.actions import actions
from torch_ebip.recordings.demonstrations import Demonstrations
from torch_ebip.recordings.examples import example
from torch_ebip.recordings.frames import from_frame, to_frame
from torch_ebip.recordings.layout import Layout, Modality
from torch_ebip.recordings.reading import read
from torch_ebip.recordings.repeats import longest_repeats

__all__ = [
    "Demonstrations",
    "Layout",
    "Modality",
    "actions",
    "example",
    "from_frame",
    "longest_repeats",
    "read",
    "to_frame",
]
