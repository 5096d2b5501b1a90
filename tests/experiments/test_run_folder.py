import json
from pathlib import Path

import pytest

from experiments.folds import read_values
from experiments.run_folder import RunFolder
from torch_ebip.common.files import read_json, write_json


def test_a_new_run_says_everything_needed(tmp_path: Path) -> None:
    run = RunFolder("tune", {"seed": 1, "horizons": (0.2, 0.9)}, str(tmp_path / "run"))
    config = json.loads((run.path / "config.json").read_text())
    assert config["settings"] == {"seed": 1, "horizons": [0.2, 0.9]}
    assert config["versions"]["torch"]
    assert "commit" in config


def test_an_unfinished_run_resumes_only_with_its_settings(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    out = str(tmp_path / "run")
    RunFolder("tune", {"seed": 1, "horizons": (0.2, 0.9)}, out)
    RunFolder("tune", {"seed": 1, "horizons": (0.2, 0.9)}, out)
    assert "resuming" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="seed: 1 there, 2 here"):
        RunFolder("tune", {"seed": 2, "horizons": (0.2, 0.9)}, out)
    with pytest.raises(SystemExit, match="holds a run of tune, not of compare"):
        RunFolder("compare", {"seed": 1, "horizons": (0.2, 0.9)}, out)


def test_a_finished_run_stops_unless_forced(tmp_path: Path) -> None:
    out = str(tmp_path / "run")
    run = RunFolder("tune", {}, out)
    write_json(run.results, {})
    with pytest.raises(SystemExit, match="finished run; --force starts over"):
        RunFolder("tune", {}, out)
    again = RunFolder("tune", {}, out, force=True)
    assert not again.results.exists()


def test_numbers_that_are_not_finite_become_null(tmp_path: Path) -> None:
    write_json(tmp_path / "a.json", {"a": [float("nan"), 1.0], "b": (float("inf"),)})
    assert json.loads((tmp_path / "a.json").read_text()) == {"a": [None, 1.0], "b": [None]}


def test_other_files_are_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("mine")
    for force in (False, True):
        with pytest.raises(SystemExit, match="holds files but no run"):
            RunFolder("tune", {}, str(tmp_path), force=force)
    for foreign in ('{"model_type": "llama"}', '{"experiment"', "[]"):
        (tmp_path / "config.json").write_text(foreign)
        with pytest.raises(SystemExit, match="holds files but no run"):
            RunFolder("tune", {}, str(tmp_path), force=True)
    with pytest.raises(SystemExit, match="is a file"):
        RunFolder("tune", {}, str(tmp_path / "thesis.tex"))
    with pytest.raises(SystemExit, match="cannot be written"):
        RunFolder("tune", {}, "/proc/nowhere/run")
    assert (tmp_path / "thesis.tex").read_text() == "mine"


@pytest.mark.parametrize("text", ["", "{", "[" * 100_000, "\xff", "1" * 5000])
def test_damaged_json_is_named(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.json").write_text(text, encoding="latin-1")
    with pytest.raises(ValueError, match=r"a\.json"):
        read_json(tmp_path / "a.json")
    with pytest.raises(FileNotFoundError):
        read_json(tmp_path / "none.json")


@pytest.mark.parametrize("content", [3, [3], [{}], [{"values": {"a": [1]}}], [{"values": {"a": [1], "b": [1, 2]}}]])
def test_what_is_no_fold_is_named(tmp_path: Path, content: object) -> None:
    write_json(tmp_path / "a.json", content)
    with pytest.raises(ValueError, match=r"a\.json: not the values of a fold"):
        read_values(tmp_path / "a.json")
