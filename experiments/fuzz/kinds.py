"""What is read, kind by kind: a valid file of each, its reader, and what must hold of all that it lets through."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial
from importlib import resources
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import torch

from experiments.folds import read_values, write_values
from experiments.fuzz import generators, planted_archives, planted_models, planted_texts
from experiments.fuzz.generators import Generator
from experiments.fuzz.mutations import Mutation
from experiments.fuzz.worker import Reader
from experiments.results import Cell
from torch_ebip import (
    BSplineBasis,
    Demonstrations,
    InteractionModel,
    InteractionPrimitive,
    InteractionSession,
    Layout,
    Modality,
    RobotArm,
    StackedBasis,
    ebip,
    load_model,
    replay,
)
from torch_ebip.learning.checkpoint import load_checkpoint, save_checkpoint
from torch_ebip.learning.starts import Start, tunable

CONFIGURATION = {"seed": 1, "horizons": [0.2, 0.9], "start": {"factor": 10.0}}


@dataclass(frozen=True)
class Kind:
    """A kind of file.

    Attributes:
        name: of the kind.
        target: name of the file that is changed; others may lie beside it.
        make: writes valid files into a folder.
        read: reads them, raises AssertionError if what was read is not valid, returns what stands for the content.
        planted: changes that only this kind can take, given a folder whose file ``canary`` must never appear.
        generate: makes a file of any shape; see `generators`.
        word: of a refusal that has no path to name.
        exact: whether the format notices blind damage.
    """

    name: str
    target: str
    make: Callable[[Path], None]
    read: Reader
    planted: Callable[[Path, int, int, bool], Iterator[Mutation]]
    generate: Generator
    word: str | None = None
    exact: bool = False


@cache
def demonstrations() -> Demonstrations:
    """A dozen hand-overs of a hand and an arm."""
    generator = torch.Generator().manual_seed(0)
    layout = Layout([Modality("hand", ["hand.x", "hand.y"], "m"), Modality("arm", ["arm.1"], "rad", controlled=True)])
    paths = []
    for i in range(12):
        phase = torch.linspace(0, 1, 40 + 2 * i)
        goal = torch.randn((), generator=generator)
        path = torch.stack([goal * phase, phase + 0.1 * goal, goal * phase**2], -1)
        paths.append(path + 0.01 * torch.randn(path.shape, generator=generator))
    return Demonstrations(layout, paths, 30.0, {"release": np.arange(12.0), "who": np.array(list("abcdefghijkl"))})


@cache
def primitive() -> InteractionPrimitive:
    """Of these hand-overs."""
    return InteractionPrimitive.fit(demonstrations(), StackedBasis([BSplineBasis(6)] * 3))


def _same_demonstrations(read: Demonstrations) -> Any:
    assert 0 < read.rate < math.inf
    assert len(read.lengths) == len(read) > 0
    assert all(len(column) == len(read) for column in read.columns.values())
    assert len(set(read.layout.dofs)) == read.layout.n_dofs
    for path in read:
        assert path.ndim == 2
        assert path.shape[1] == read.layout.n_dofs
        assert len(path) > 1
        assert not path.isinf().any()
        assert path.dtype in (torch.float32, torch.float64)
    if sum(path.numel() for path in read) > 1_000_000:
        return "large"
    return hash((read.layout, read.rate, tuple(path.numpy().tobytes() for path in read), tuple(sorted(read.columns))))


def _read_npz(folder: Path) -> Any:
    return _same_demonstrations(Demonstrations.load(folder / "recordings.npz"))


def _read_folder(folder: Path) -> Any:
    return _same_demonstrations(Demonstrations.load_folder(folder))


def _make_folder(description: str, folder: Path) -> None:
    layout = demonstrations().layout
    tables = [
        {"name": m.name, "dofs": list(m.dofs), "unit": m.unit, "controlled": m.controlled} for m in layout.modalities
    ]
    if description == "layout.json":
        (folder / description).write_text(json.dumps({"rate": 30.0, "modalities": tables}))
    else:
        entries = [
            "[[modalities]]\n" + "".join(f"{name} = {json.dumps(value)}\n" for name, value in table.items())
            for table in tables
        ]
        (folder / description).write_text("rate = 30.0\n" + "".join(entries))
    for i in range(2):
        rows = [",".join(layout.dofs), *(",".join(map(repr, row)) for row in demonstrations()[i].tolist())]
        (folder / f"{'ab'[i]}.csv").write_text("\n".join(rows) + "\n")


def _read_arm(folder: Path) -> Any:
    arm = RobotArm(folder / "arm.urdf", "flange")
    pose = arm(torch.full((arm.n_joints,), 0.3))
    assert pose.isfinite().all()
    assert not arm.joint_limits.isnan().any()
    assert not arm.velocity_limits.isnan().any()


def _make_arm(folder: Path) -> None:
    text = resources.files("torch_ebip.kinematics").joinpath("ur5.urdf").read_text(encoding="utf-8")
    (folder / "arm.urdf").write_text(text)


def _make_checkpoint(folder: Path) -> None:
    generator = torch.Generator().manual_seed(0)
    content = {
        "step": 3,
        "parameters": {name: torch.randn(40, 8, generator=generator) for name in ("noise", "inflation")},
        "validation": {8: 0.5},
    }
    save_checkpoint(folder / "checkpoint.pt", CONFIGURATION, content)


def _read_checkpoint(folder: Path) -> Any:
    content = load_checkpoint(folder / "checkpoint.pt", CONFIGURATION)
    tensors = [
        x for x in content.get("parameters", {}).values() if isinstance(x, torch.Tensor) and x.numel() < 10_000
    ]
    return hash(tuple((tensor.sum().item(), tuple(tensor.shape)) for tensor in tensors if not tensor.is_sparse))


def _make_session(folder: Path) -> None:
    generator = torch.Generator().manual_seed(1)
    with InteractionSession(ebip(primitive()), primitive(), record=folder / "session.jsonl") as session:
        for k in range(24):
            session.push("hand", torch.rand(2, generator=generator).tolist(), k / 30)
            if k % 8 == 7:
                session.forecast([0.1, 0.3], k / 30)
                session.advance(k / 30)


def _generate_session(random: Random, path: Path, valid: bool) -> None:
    generators.session(random, path, valid, ebip(primitive()), primitive())


def _read_session(folder: Path) -> Any:
    lived = replay(folder / "session.jsonl", ebip(primitive()), primitive())
    assert all(bool(forecast.mean.isfinite().all()) for forecast in lived.forecasts)
    assert lived.identical in (True, False)


def _make_values(folder: Path) -> None:
    cells = [Cell("all", 0.5, "mae", "robot", "rad"), Cell("ball", 0.8, "mse", "robot", "rad")]
    write_values(folder / "values.json", {cell: {"a": np.arange(9.0), "b": np.ones(9)} for cell in cells})


def _read_values(folder: Path) -> Any:
    for methods in read_values(folder / "values.json").values():
        assert all(array.ndim == 1 and array.dtype == np.float64 for array in methods.values())


def _make_model(folder: Path) -> None:
    known = primitive()
    InteractionModel(tunable(known, Start(100.0, 10.0)), known).save(folder / "model.safetensors")


def _read_model(folder: Path) -> Any:
    model = load_model(folder / "model.safetensors")
    assert all(bool(parameter.isfinite().all()) for parameter in model.filter.parameters())
    assert model.filter.dof_names == model.layout.dofs
    assert 0 < model.rate < math.inf
    with torch.no_grad():
        state = model.filter.initial_state(generator=torch.Generator().manual_seed(0))
        assert bool(model.filter.forecast(state, torch.ones(1)).mean.isfinite().all())
    tensors = [tensor.numpy().tobytes() for tensor in model.filter.state_dict().values()]
    return hash((str(model), model.layout, tuple(tensors)))


KINDS: dict[str, Kind] = {
    kind.name: kind
    for kind in (
        Kind(
            "npz",
            "recordings.npz",
            lambda folder: demonstrations().save(folder / "recordings.npz"),
            _read_npz,
            planted_archives.recordings,
            generators.recordings,
            exact=True,
        ),
        Kind(
            "csv", "b.csv", partial(_make_folder, "layout.toml"), _read_folder, planted_texts.table, generators.table
        ),
        Kind(
            "toml",
            "layout.toml",
            partial(_make_folder, "layout.toml"),
            _read_folder,
            planted_texts.toml,
            generators.toml_layout,
        ),
        Kind(
            "json",
            "layout.json",
            partial(_make_folder, "layout.json"),
            _read_folder,
            planted_texts.json_layout,
            generators.json_layout,
        ),
        Kind("urdf", "arm.urdf", _make_arm, _read_arm, planted_texts.urdf, generators.urdf, word="urdf"),
        Kind(
            "checkpoint",
            "checkpoint.pt",
            _make_checkpoint,
            _read_checkpoint,
            planted_archives.checkpoint,
            partial(generators.checkpoint, configuration=CONFIGURATION),
            exact=True,
        ),
        Kind("session", "session.jsonl", _make_session, _read_session, planted_texts.session, _generate_session),
        Kind(
            "fold values", "values.json", _make_values, _read_values, planted_texts.run_json, generators.fold_values
        ),
        Kind(
            "model",
            "model.safetensors",
            _make_model,
            _read_model,
            planted_models.model,
            planted_models.generate,
            exact=True,
        ),
    )
}
"""By name."""
