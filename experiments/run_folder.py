"""A run folder: what was run, with which settings and versions, and whether it is finished."""

from __future__ import annotations

import json
import os
import platform
import secrets
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from experiments.interrupts import advise
from torch_ebip.common.files import atomic_write, read_json, write_json

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class RunFolder:
    """The folder of one run of an experiment, new or to be resumed.

    Args:
        experiment: its name.
        settings: everything that decides the result; an unfinished run is resumed only with the same.
        out: the folder; default ``runs/EXPERIMENT/STAMP``.
        force: start over, also over a finished run of this experiment; nothing else is ever removed.
        arguments: of the command line, for `experiments.rerun`; default: those of this process.

    Raises:
        SystemExit: the folder cannot be written, holds a finished run, another experiment, other settings, or
            files that are not a run's; says which.
    """

    def __init__(
        self,
        experiment: str,
        settings: Mapping[str, Any],
        out: str | None = None,
        force: bool = False,
        arguments: Sequence[str] | None = None,
    ) -> None:
        stamp = time.strftime("%Y%m%d-%H%M%S")
        self.path = Path(out) if out is not None else Path("runs") / experiment / stamp
        config = self.path / "config.json"
        asked = json.loads(json.dumps(dict(settings)))
        now = {"experiment": experiment, "settings": asked, **_circumstances(arguments)}
        if self.path.exists() and not self.path.is_dir():
            raise SystemExit(f"{self.path} is a file, expected a folder to write the run to")
        try:
            if self.path.is_dir() and any(not _unfinished(file) for file in self.path.iterdir()):
                stored = self._stored(config, experiment)
                if not force:
                    self._check(stored["settings"], asked)
                    self._resume(stored, now)
                    self._advise(experiment, now)
                    return
                # At once out of the way: half a folder would be neither a run nor empty.
                removed = self.path.with_name(f".{self.path.name}.{secrets.token_hex(4)}.removed")
                os.replace(self.path, removed)
                shutil.rmtree(removed)
            self._run = now
            write_json(config, now)
            self._advise(experiment, now)
        except OSError as error:
            raise SystemExit(f"{self.path} cannot be written: {error}") from error

    def _advise(self, experiment: str, now: Mapping[str, Any]) -> None:
        """What an interrupt says."""
        again = shlex.join(["python", "-m", f"experiments.{experiment}", *now["arguments"], "--out", str(self.path)])
        advise(f"what is finished is kept, and the rest is done by\n  {again}")

    def _resume(self, stored: dict[str, Any], now: Mapping[str, Any]) -> None:
        """Go on with a run; what was half-written when it was killed goes, and what differs from then is noted."""
        for file in self.path.rglob("*.part"):
            if _unfinished(file):
                file.unlink()
        differing = [key for key in ("versions", "commit", "threads") if stored.get(key) != now[key]]
        print(f"resuming {self.path}" + (f", with other {', '.join(differing)}" if differing else ""))
        if differing:
            stored.setdefault("resumed_with", []).append({key: now[key] for key in differing})
            write_json(self.path / "config.json", stored)
        self._run = stored

    def finish(self, results: Mapping[str, Any]) -> None:
        """Write ``results.json``, with all that is needed to run it again under ``run``."""
        write_json(self.results, {**results, "run": self._run})

    def _stored(self, config: Path, experiment: str) -> dict[str, Any]:
        """What the folder says of its run; SystemExit if it holds none of this experiment."""
        try:
            content = dict(read_json(config))
            found, _ = content["experiment"], dict(content["settings"])
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise SystemExit(f"{self.path} holds files but no run; choose another --out") from error
        if found != experiment:
            raise SystemExit(f"{self.path} holds a run of {found}, not of {experiment}")
        return content

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


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure as PNG, atomically."""
    with atomic_write(path) as file:
        figure.savefig(file, format="png", dpi=110)


def _unfinished(file: Path) -> bool:
    """Whether `atomic_write` was killed while it wrote it."""
    return file.name.startswith(".") and file.suffix == ".part"


def _circumstances(arguments: Sequence[str] | None) -> dict[str, Any]:
    """What else a result may depend on."""
    packages = ("torch", "numpy", "pytorch-kinematics", "tensorboard", "scipy", "matplotlib")
    commit = subprocess.run(
        ["git", "-C", str(Path(__file__).parent), "rev-parse", "HEAD"], capture_output=True, text=True, check=False
    )
    changes = subprocess.run(
        ["git", "-C", str(Path(__file__).parent), "status", "--porcelain", "--untracked-files=no"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    return {
        "arguments": _without_folder(sys.argv[1:] if arguments is None else arguments),
        "working_folder": os.getcwd(),
        "threads": torch.get_num_threads(),
        "processes": int(os.environ.get("WORLD_SIZE", "1")),
        "versions": {"python": platform.python_version(), **{name: version(name) for name in packages}},
        "commit": commit.stdout.strip() or None,
        "changed_since_commit": bool(changes.stdout.strip()),
        "machine": {"system": platform.platform(), "processor": platform.machine(), "cores": os.cpu_count()},
    }


def _without_folder(arguments: Sequence[str]) -> list[str]:
    """The arguments that decide the result: not where it goes."""
    kept = []
    rest = iter(arguments)
    for argument in rest:
        if argument == "--out":
            next(rest, None)
        elif argument != "--force" and not argument.startswith("--out="):
            kept.append(argument)
    return kept
