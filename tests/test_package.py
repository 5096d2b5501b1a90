"""The package as a stranger meets it: its import, and who imports whom."""

import re
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import pytest

import torch_ebip

ROOT = Path(__file__).parents[1]


def test_importing_starts_nothing_and_pulls_in_nothing_heavy() -> None:
    program = (
        "import sys, threading, torch; state = torch.get_rng_state(); import torch_ebip; "
        "assert torch.equal(state, torch.get_rng_state()); assert threading.active_count() == 1; "
        "bad = {'tensorboard', 'pytorch_kinematics', 'matplotlib', 'experiments', 'scipy', 'torch._dynamo'}; "
        "bad &= set(sys.modules); "
        "assert not bad, bad"
    )
    subprocess.run([sys.executable, "-c", program], check=True, cwd=ROOT)


def test_every_public_name_is_there() -> None:
    for name in torch_ebip.__all__:
        assert getattr(torch_ebip, name).__doc__, name


def test_imports_run_one_way() -> None:
    """Only `monitor` knows TensorBoard, only `kinematics` pytorch-kinematics, and nobody the experiments."""
    for path in (ROOT / "torch_ebip").rglob("*.py"):
        text = path.read_text()
        assert "import experiments" not in text, path
        assert "from experiments" not in text, path
        if path.name != "monitor.py":
            assert not re.search(r"^\s*(from|import) .*tensorboard", text, re.MULTILINE), path
        if path.parent.name != "kinematics":
            assert not re.search(r"^\s*(from|import) pytorch_kinematics", text, re.MULTILINE), path


def test_only_the_scene_knows_the_simulator() -> None:
    for folder in ("torch_ebip", "experiments"):
        for path in (ROOT / folder).rglob("*.py"):
            known = path.parent.name == "scene"
            assert known or not re.search(r"^\s*(from|import) mujoco", path.read_text(), re.MULTILINE), path


def test_the_version_is_that_of_the_package() -> None:
    assert torch_ebip.__version__ == version("torch-ebip")
    assert f"## [{torch_ebip.__version__}]" in (ROOT / "CHANGELOG.md").read_text()
    with pytest.raises(AttributeError, match="no attribute 'version'"):
        _ = torch_ebip.version
