"""Ctrl-C ends a study within two seconds, says how to go on, and leaves no process behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.conftest import interactions

ROOT = Path(__file__).parents[2]
STUDIES = {
    # Folds in processes of their own: an interrupt reaches all of them at once, as a terminal sends it.
    "folds": (["compare", "--quick", "--folds", "2", "--methods", "ebip"], "fold-00"),
    "alone": (["tune", "--quick", "--steps", "1000"], "scan_scaled.json"),
    "importing": (["tune", "--quick", "--folds", "2"], "config.json"),
}


def members_of(group: int) -> list[int]:
    """Processes of a group that are not merely waited for."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            state, _, theirs = (entry / "stat").read_text().rpartition(")")[2].split()[:3]
        except (OSError, ValueError):
            continue
        if int(theirs) == group and state != "Z":
            found.append(int(entry.name))
    return found


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="asks /proc which processes there are")
@pytest.mark.parametrize("study", STUDIES)
def test_an_interrupt_ends_a_study(study: str, tmp_path: Path) -> None:
    interactions(30).save(tmp_path / "made.npz")
    (name, *options), sign = STUDIES[study]
    out = tmp_path / "a run"
    line = [sys.executable, "-m", f"experiments.{name}", "--data", str(tmp_path / "made.npz"), *options]
    with (tmp_path / "said.txt").open("w+") as said:
        started = subprocess.Popen(
            [*line, "--out", str(out)], cwd=ROOT, start_new_session=True, stdout=said, stderr=subprocess.STDOUT,
            # Whoever runs the tests in the background of a script has interrupts ignored, which is handed on.
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )  # fmt: skip
        try:
            deadline = time.monotonic() + 100
            while not (out / sign).exists() and started.poll() is None and time.monotonic() < deadline:
                time.sleep(0.02)
            time.sleep(0.3)
            began = time.monotonic()
            os.killpg(started.pid, signal.SIGINT)
            status = started.wait(timeout=30)
            seconds = time.monotonic() - began
            time.sleep(0.2)
            left = members_of(started.pid)
        finally:
            for process in members_of(started.pid):
                os.kill(process, signal.SIGKILL)
        said.seek(0)
        text = said.read()
    assert status == 130, text
    assert seconds < 2
    assert left == []
    assert "Traceback" not in text
    assert "interrupted; what is finished is kept, and the rest is done by" in text
    assert f"python -m experiments.{name} --data" in text
    assert f"--out '{out}'" in text
    if study == "folds":  # what it says is how to go on
        again = text.strip().splitlines()[-1].replace("python -m", f"{sys.executable} -m")
        done = subprocess.run(again, shell=True, cwd=ROOT, check=False, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        assert f"resuming {out}" in done.stdout
        assert (out / "results.json").exists()
