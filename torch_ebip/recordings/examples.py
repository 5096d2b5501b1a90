"""A small set of recordings to try things with, made by `python -m experiments.example`: nobody was recorded."""

from __future__ import annotations

from importlib import resources

from torch_ebip.recordings.demonstrations import Demonstrations


def example() -> Demonstrations:
    """Thirty simulated hand-overs to a UR5, 30 Hz: a person's hand (m) and gaze (rad), the arm's six joints (rad).

    The hand goes where it wants to, the gaze is there first, and the arm meets the hand at the end.

    Example:
        >>> from torch_ebip.recordings import example
        >>> example()
        Demonstrations(30 of 47 to 75 samples at 30 Hz, 11 DoFs: hand, gaze, robot)
    """
    with resources.as_file(resources.files("torch_ebip.recordings").joinpath("example.npz")) as path:
        return Demonstrations.load(path)
