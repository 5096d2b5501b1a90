"""Nothing is lost when a run is killed, the campaign would see it if it were; workers do not outlive their run."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from experiments.kill import damage, main, stage, strangers
from experiments.run_folder import RunFolder
from torch_ebip.common.files import write_json
from torch_ebip.learning.model_file import write_model_file


def test_a_killed_run_ends_in_the_same_numbers(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    main(["--kills", "2", "--steps", "4", "--interactions", "12", "--seed", "2", "--out", str(tmp_path / "run")])
    results = json.loads((tmp_path / "run" / "results.json").read_text())
    assert results["kills"] == sum(results["kills_by_stage"].values()) == 2
    assert results["runs_finished"] >= 1
    assert results["lost"] == results["differing"] == []
    assert "numbers or files that differ" in capsys.readouterr().out


@pytest.fixture
def finished(tmp_path: Path) -> Path:
    """Two folders of the same run: this one and ``reference`` beside it."""
    for folder in (tmp_path / "mine", tmp_path / "reference"):
        write_json(folder / "results.json", {"rows": [{"mean": 0.5}]})
        write_model_file(folder / "model.safetensors", {}, {"a": torch.ones(3)})
    return tmp_path / "mine"


def test_the_campaign_sees_damage(finished: Path) -> None:
    assert damage(finished) == []
    path = finished / "model.safetensors"
    path.write_bytes(path.read_bytes()[:-4])
    (finished / "results.json").write_text('{"rows": [')
    (finished / "noise.png").write_bytes(b"\x89PNG")
    (finished / ".model.safetensors.1234.part").write_bytes(b"")
    assert [line.split(":")[0] for line in damage(finished)] == ["model.safetensors", "noise.png", "results.json"]


def test_the_campaign_sees_other_numbers(finished: Path) -> None:
    reference = finished.parent / "reference"
    assert strangers(finished, reference) == []
    write_json(finished / "results.json", {"rows": [{"mean": 0.6}]})
    write_model_file(finished / "model.safetensors", {}, {"a": torch.tensor([1.0, 1.0, 1.0 + 1e-6])})
    (finished / ".left.part").write_bytes(b"")
    found = strangers(finished, reference)
    assert found == [
        "rows/0/mean: 0.5 there, 0.6 here",
        "model.safetensors: a differs",
        ".left.part: only in one of them",
    ]
    assert stage(finished) == "finished"


def test_what_was_half_written_goes_when_a_run_resumes(tmp_path: Path) -> None:
    out = tmp_path / "run"
    out.mkdir()
    (out / ".config.json.12ab.part").write_text("{")  # killed before anything else was there
    RunFolder("tune", {}, str(out))
    (out / "fold-00").mkdir()
    for name in (".config.json.34cd.part", "fold-00/.values.json.56ef.part", "mine.part"):
        (out / name).write_text("half")
    RunFolder("tune", {}, str(out))
    assert sorted(str(p.relative_to(out)) for p in out.rglob("*") if p.is_file()) == ["config.json", "mine.part"]


WORKER = """
import sys, time, os, multiprocessing
from concurrent.futures import ProcessPoolExecutor
from experiments.folds import end_with_parent

def sleep(path):
    open(path, "w").write(str(os.getpid()))
    time.sleep(600)

if __name__ == "__main__":
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context, initializer=end_with_parent) as pool:
        pool.submit(sleep, sys.argv[1]).result()
"""


def test_workers_end_with_the_run_that_started_them(tmp_path: Path) -> None:
    program, note = tmp_path / "program.py", tmp_path / "worker"
    program.write_text(WORKER)
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    parent = subprocess.Popen([sys.executable, str(program), str(note)], env=environment)
    try:
        assert _within(60, lambda: note.exists() and note.read_text() != "")
        worker = int(note.read_text())
        os.kill(parent.pid, signal.SIGKILL)
        parent.wait()
        assert _within(30, lambda: not Path(f"/proc/{worker}").exists() or _is_zombie(worker))
    finally:
        parent.kill()


def _within(seconds: float, holds) -> bool:
    """Whether something comes true in time."""
    deadline = time.monotonic() + seconds
    while not holds():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.1)
    return True


def _is_zombie(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except FileNotFoundError:
        return True
