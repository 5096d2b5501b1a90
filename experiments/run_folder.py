"""A run folder: what was run, with which settings and versions, and whether it is finished."""

from __future__ import annotations

import json
import math
import platform
import shutil
import subprocess
import time
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

from torch_ebip.files import atomic_write, read_text

LARGEST_JSON = 1 << 28
"""Bytes."""


class RunFolder:
    """The folder of one run of an experiment, new or to be resumed.

    Args:
        experiment: its name.
        settings: everything that decides the result; an unfinished run is resumed only with the same.
        out: the folder; default ``runs/EXPERIMENT/STAMP``.
        force: start over, also over a finished run of this experiment; nothing else is ever removed.

    Raises:
        SystemExit: the folder cannot be written, holds a finished run, another experiment, other settings, or
            files that are not a run's; says which.
    """

    def __init__(
        self, experiment: str, settings: Mapping[str, Any], out: str | None = None, force: bool = False
    ) -> None:
        stamp = time.strftime("%Y%m%d-%H%M%S")
        self.path = Path(out) if out is not None else Path("runs") / experiment / stamp
        config = self.path / "config.json"
        asked = json.loads(json.dumps(dict(settings)))
        if self.path.exists() and not self.path.is_dir():
            raise SystemExit(f"{self.path} is a file, expected a folder to write the run to")
        if self.path.is_dir() and any(self.path.iterdir()):
            stored = self._stored(config, experiment)
            if not force:
                self._check(stored, asked)
                print(f"resuming {self.path}")
                return
            shutil.rmtree(self.path)
        try:
            write_json(config, {"experiment": experiment, "settings": asked, **_environment()})
        except OSError as error:
            raise SystemExit(f"{self.path} cannot be written: {error}") from error

    def _stored(self, config: Path, experiment: str) -> dict[str, Any]:
        """The settings of the run that the folder holds; SystemExit if it holds none of this experiment."""
        try:
            content = read_json(config)
            found, settings = content["experiment"], dict(content["settings"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise SystemExit(f"{self.path} holds files but no run; choose another --out") from error
        if found != experiment:
            raise SystemExit(f"{self.path} holds a run of {found}, not of {experiment}")
        return settings

    def _check(self, theirs: Mapping[str, Any], asked: Mapping[str, Any]) -> None:
        names = sorted({*theirs, *asked})
        differing = [
            f"{n}: {theirs.get(n)} there, {asked.get(n)} here" for n in names if theirs.get(n) != asked.get(n)
        ]
        if differing:
            raise SystemExit(
                f"{self.path} holds a run with other settings ({'; '.join(differing)}); --force starts over"
            )
        if self.results.exists():
            raise SystemExit(f"{self.path} holds a finished run; --force starts over")

    @property
    def results(self) -> Path:
        """``results.json``, there once the run is finished."""
        return self.path / "results.json"


def read_json(path: Path) -> Any:
    """What `write_json` wrote.

    Raises:
        FileNotFoundError: there is no such file.
        ValueError: it is no JSON, or cannot be read.
    """
    text = read_text(path, LARGEST_JSON)
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: not what a run writes, or damaged: {error}") from error


def write_json(path: Path, content: Any) -> None:
    """Write JSON atomically; numbers that are not finite become null."""
    with atomic_write(path) as file:
        file.write((json.dumps(_finite(content), indent=1, allow_nan=False) + "\n").encode())


def _finite(content: Any) -> Any:
    if isinstance(content, dict):
        return {key: _finite(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return [_finite(value) for value in content]
    return None if isinstance(content, float) and not math.isfinite(content) else content


def _environment() -> dict[str, Any]:
    packages = ("torch", "numpy", "pytorch-kinematics", "tensorboard", "scipy", "matplotlib")
    commit = subprocess.run(
        ["git", "-C", str(Path(__file__).parent), "rev-parse", "HEAD"], capture_output=True, text=True, check=False
    )
    return {
        "versions": {"python": platform.python_version(), **{name: version(name) for name in packages}},
        "commit": commit.stdout.strip() or None,
        "machine": {"system": platform.platform(), "processor": platform.machine()},
    }
