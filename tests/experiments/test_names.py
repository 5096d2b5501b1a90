"""Names that mean something to TeX, Markdown or rich; terminals that know ASCII only; packages that are not there."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from experiments.figures import plain, plt
from tests.conftest import interactions
from torch_ebip import Demonstrations, Layout, Modality

ROOT = Path(__file__).parents[2]
ODD = [
    Modality("ha$nd^{$", ["$\\frac{1$", "hand_{y}"], "$m^$"),
    Modality("[red]gaze[/red]|", ["_gaze"], "rad²"),
    Modality("Ärm", ["$\\arm{$|1", "[bold]arm"], "%s{}", controlled=True),
]


def test_a_study_of_odd_names_in_a_terminal_of_ascii(tmp_path: Path) -> None:
    made = interactions(24)
    Demonstrations(Layout(ODD), list(made), made.rate).save(tmp_path / "odd.npz")
    out = tmp_path / "run"
    line = [sys.executable, "-m", "experiments.tune", "--data", str(tmp_path / "odd.npz"), "--quick", "--steps", "1"]
    terminal = {"PYTHONIOENCODING": "ascii", "LC_ALL": "C", "PYTHONUTF8": "0", "COLUMNS": "200"}
    environment = {**os.environ, **terminal}
    done = subprocess.run(
        [*line, "--out", str(out)], cwd=ROOT, env=environment, check=False, capture_output=True, timeout=200
    )
    said = done.stdout.decode("ascii")
    assert done.returncode == 0, done.stderr.decode("ascii", "replace")[-2000:]
    results = json.loads((out / "results.json").read_text())
    assert {row["modality"] for row in results["rows"]} == {"Ärm", None}
    for figure in ("results.png", "forecasts.png", "noise.png"):
        assert (out / figure).stat().st_size > 10_000
    assert "[red]gaze[/red]|" in said


@pytest.mark.parametrize("module", ["tune", "compare", "catch", "fuzz"])
def test_without_their_packages_the_studies_say_what_to_install(module: str, tmp_path: Path) -> None:
    """In one line, as a command; as an ImportError to whoever imports them."""
    (tmp_path / "sitecustomize.py").write_text(
        "import importlib.util as u\n"
        "u.find_spec = (lambda real: lambda name, *a: None if name in ('matplotlib', 'rich') else real(name, *a))"
        "(u.find_spec)\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    line = [sys.executable, "-m", f"experiments.{module}", "--help"]
    done = subprocess.run(line, cwd=ROOT, env=environment, check=False, capture_output=True, text=True)
    assert done.returncode == 1
    wanted = "the experiments need matplotlib, rich: pip install 'torch-ebip[experiments]'"
    assert done.stderr.strip() == wanted
    if module == "tune":
        line = [sys.executable, "-c", "import experiments.results"]
        done = subprocess.run(line, cwd=ROOT, env=environment, check=False, capture_output=True, text=True)
        assert done.stderr.strip().splitlines()[-1] == f"ImportError: {wanted}"


def test_pictures_show_names_as_they_are_and_numbers_as_formulas() -> None:
    figure, axis = plt.subplots()
    axis.semilogy([1, 2], [3.1, 3.3], label=plain("_gaze"))
    axis.set_xlabel(plain("a $\\frac{1$ and $"))
    axis.legend()
    figure.canvas.draw()
    assert [text.get_text().strip() for text in axis.get_legend().get_texts()] == ["_gaze"]
    assert axis.xaxis.label._preprocess_math(axis.xaxis.label.get_text()) == ("a $\\frac{1$ and $", False)
    assert any("mathdefault" in tick.get_text() for tick in axis.get_yticklabels(which="both"))
    assert plt.rcParams["text.parse_math"]  # else powers of ten are spelled as TeX
    plt.close(figure)
