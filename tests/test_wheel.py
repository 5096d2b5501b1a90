"""What strangers install: the wheel and the sdist hold what they should, and run where nothing else is."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tarfile
import zipfile
from importlib.metadata import distribution
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
REQUIRED = ("torch", "numpy", "pytorch-kinematics", "safetensors", "tensorboard")
ROBOT = ("torch", "numpy", "safetensors")
"""All that a saved model needs."""


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """sdist and, out of it, wheel."""
    folder = tmp_path_factory.mktemp("dist")
    source = tmp_path_factory.mktemp("source") / "checkout"
    files = [
        "pyproject.toml",
        "setup.py",
        "README.md",
        "LICENSE",
        "CHANGELOG.md",
        "MANIFEST.in",
        "constraints.txt",
        "CITATION.cff",
    ]
    source.mkdir()
    for name in [*files, "torch_ebip", "experiments", "tests", "docs"]:  # nothing of it is written into
        subprocess.run(["cp", "-r", str(ROOT / name), str(source)], check=True)
    subprocess.run(
        [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(folder), str(source)],
        check=True, stdout=subprocess.DEVNULL,
    )  # fmt: skip
    return folder


def one(folder: Path, pattern: str) -> Path:
    (found,) = folder.glob(pattern)
    return found


def closure(names: tuple[str, ...]) -> set[str]:
    """Distributions that some of them need here, themselves included."""
    found: set[str] = set()
    waiting = list(names)
    while waiting:
        name = re.sub(r"[-_.]+", "-", waiting.pop()).lower()
        if name in found:
            continue
        found.add(name)
        for requirement in distribution(name).requires or []:
            head, _, marker = requirement.partition(";")
            if (
                "extra ==" in marker
                or "platform_system" in marker
                or "sys_platform" in marker
                or "python_version <" in marker
            ):
                continue
            waiting.append(re.match(r"[\w.-]+", head.strip()).group())
    return found


def environment(folder: Path, wheel: Path, names: tuple[str, ...]) -> Path:
    """A new virtual environment with the wheel and, linked from this one, some distributions with what they need."""
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(folder)], check=True)
    site = one(folder, "lib/python*/site-packages")
    for name in closure(names):
        for file in distribution(name).files or []:
            top = Path(file).parts[0]
            if top in ("..", "__pycache__") or (site / top).exists():
                continue
            (site / top).symlink_to(Path(str(distribution(name).locate_file(top))).resolve())
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(site)
    return folder / "bin" / "python"


def run(python: Path, program: str, folder: Path) -> str:
    plain = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run([str(python), "-W", "error::DeprecationWarning:torch_ebip", "-c", program],
                          cwd=folder, env=plain, capture_output=True, text=True)  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_twelve_lines_of_the_readme_run_from_the_wheel_and_the_model_without_the_rest(
    built: Path, tmp_path: Path
) -> None:
    """Recordings, learn, save, load, session; then its model where torch, numpy and safetensors are alone."""
    wheel = one(built, "*.whl")
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"^```python\n(.*?)^```$", readme, re.DOTALL | re.MULTILINE)
    whole = environment(tmp_path / "whole", wheel, REQUIRED)
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    where = "\nimport torch_ebip; print(torch_ebip.__file__, torch_ebip.__version__)"
    said = run(whole, block + where, elsewhere)
    assert str(tmp_path / "whole") in said
    assert "better than" in said
    robot = environment(tmp_path / "robot", wheel, ROBOT)
    program = """
import sys
from importlib.util import find_spec
assert not any(find_spec(name) for name in ("pytorch_kinematics", "tensorboard", "scipy", "tqdm", "experiments"))
from torch_ebip import load_model
from torch_ebip.recordings import example
model = load_model("handover.safetensors")
with model.session() as session:
    for step, sample in enumerate(example()[0][:30]):
        session.push("hand", sample[:3], time=step / 30)
    print(session.forecast(rate=50.0).mean.isfinite().all().item())
print(model.forecast(example()[0], [0.5]).mean.isfinite().all().item(), model.report.verdict)
"""
    said = run(robot, program, elsewhere)
    assert said.startswith("True\nTrue ")
    hint = "import torch_ebip\ntry: torch_ebip.RobotArm.ur5()\nexcept ImportError as error: print(error)"
    assert "pip install pytorch-kinematics" in run(robot, hint, elsewhere)


def test_the_wheel_holds_the_library_and_nothing_else(built: Path) -> None:
    wheel = one(built, "*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    assert {name.split("/")[0] for name in names} == {
        "torch_ebip",
        f"{'-'.join(wheel.name.split('-')[:2])}.dist-info",
    }
    assert {"torch_ebip/py.typed", "torch_ebip/kinematics/ur5.urdf", "torch_ebip/recordings/example.npz"} <= set(
        names
    )
    subprocess.run(["check-wheel-contents", str(wheel)], check=True)


def test_what_is_uploaded_is_in_order(built: Path) -> None:
    subprocess.run(["twine", "check", "--strict", *map(str, built.iterdir())], check=True)
    text = zipfile.ZipFile(one(built, "*.whl")).read(
        next(name for name in zipfile.ZipFile(one(built, "*.whl")).namelist() if name.endswith("METADATA"))
    ).decode()  # fmt: skip
    assert "Project-URL: Source" in text
    assert "Programming Language :: Python :: 3.13" in text
    links = re.findall(r"\]\(([^)#]+)\)", text)
    assert len(links) > 10
    assert all(link.startswith("https://") for link in links), links


def test_the_sdist_holds_a_suite_that_passes(built: Path, tmp_path: Path) -> None:
    """A few of its tests, from the unpacked archive: that all pass is what CI shows of the checkout it is made of."""
    with tarfile.open(one(built, "*.tar.gz")) as archive:
        archive.extractall(tmp_path, filter="data")
    (folder,) = tmp_path.iterdir()
    tracked = {str(path.relative_to(ROOT)) for top in ("tests", "experiments", "docs", "torch_ebip")
               for path in (ROOT / top).rglob("*") if path.is_file() and "__pycache__" not in path.parts}  # fmt: skip
    there = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
    assert not tracked - there
    plain = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    chosen = ["tests/test_package.py", "tests/recordings", "tests/learning/test_interaction_model.py", "-n0", "-x"]
    subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", *chosen], check=True, cwd=folder, env=plain
    )
