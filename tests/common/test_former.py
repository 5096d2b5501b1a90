"""Module paths of before are found, say where they are now, and give the same things."""

import importlib
import subprocess
import sys
from pathlib import Path

import pytest

import torch_ebip
from torch_ebip.common.former import MOVED, FormerPaths

ROOT = Path(__file__).parents[2]
NAMES = {
    "filters": ("LiveFilter", "EnsembleFilter", "BasisProjection"),
    "filters.evidence": ("EvidenceWeighting",),
    "functional": ("ensemble_update", "systematic_resample"),
    "losses": ("CRPSLoss", "ForwardKinematicsLoss"),
    "monitor": ("Monitor", "noise_scalars"),
    "noise": ("StudentT", "PhaseNoise", "AboveOne", "MeasurementNoise"),
    "objective": ("ForecastObjective", "Weights"),
    "session": ("InteractionSession", "replay", "SessionSettings"),
    "tuning": ("Tuner", "TuningSettings"),
    "layout": ("Layout",),
}


@pytest.mark.parametrize("path", NAMES)
def test_names_of_before_are_those_of_now(path: str) -> None:
    for name in [each for each in sys.modules if each.startswith("torch_ebip.") and each.split(".")[1] in MOVED]:
        del sys.modules[name]
    with pytest.warns(DeprecationWarning, match=rf"torch_ebip\.{path} is now torch_ebip\."):
        module = importlib.import_module(f"torch_ebip.{path}")
    for name in NAMES[path]:
        thing = getattr(module, name)
        assert thing.__name__ == name
        assert getattr(torch_ebip, name, thing) is thing
    with pytest.raises(AttributeError, match=r"where there is no 'FilterNoise': see CHANGELOG\.md"):
        _ = module.FilterNoise


def test_every_place_is_there_and_none_is_shadowed() -> None:
    for old, places in MOVED.items():
        assert not (ROOT / "torch_ebip" / old).exists()
        assert not (ROOT / "torch_ebip" / f"{old}.py").exists()
        for place in places:
            importlib.import_module(f"torch_ebip.{place}")
    with pytest.raises(ModuleNotFoundError, match=r"No module named 'torch_ebip\.nonsense'"):
        importlib.import_module("torch_ebip.nonsense")
    assert sum(type(finder) is FormerPaths for finder in sys.meta_path) == 1


def test_a_strangers_import_works_and_warns_where_it_stands() -> None:
    program = "from torch_ebip.session import InteractionSession; print(InteractionSession.__name__)"
    command = [sys.executable, "-W", "always::DeprecationWarning", "-c", program]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.strip() == "InteractionSession"
    assert "torch_ebip.session is now torch_ebip.live" in done.stderr
