"""A disk that is full ends a run with a line that says so, and what was written before stays good."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from experiments.kill import damage, recording
from experiments.rerun import compare
from torch_ebip.common.files import read_json

# As root of a user namespace one may mount a small disk: start on it, look, make it larger, go on.
SCRIPT = """
set -e
mount -t tmpfs -o size=$SIZE none "$DISK"
if "$@" --out "$DISK/run" > "$NOTES/first.txt" 2>&1; then echo 0; else echo $?; fi > "$NOTES/status"
cp -r "$DISK/run" "$NOTES/full"
mount -o remount,size=32m "$DISK"
"$@" --out "$DISK/run" > "$NOTES/second.txt" 2>&1
cp -r "$DISK/run" "$NOTES/finished"
"""


def can_mount() -> bool:
    """Whether this machine lets us."""
    try:
        trial = ["unshare", "-rm", "mount", "-t", "tmpfs", "none", "/mnt"]
        return subprocess.run(trial, capture_output=True, check=False).returncode == 0
    except FileNotFoundError:
        return False


@pytest.fixture(scope="module")
def command(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """A small tuning run."""
    file = tmp_path_factory.mktemp("data") / "recording.npz"
    recording(0, 12).save(file)
    return [sys.executable, "-m", "experiments.tune", "--data", str(file), "--quick", "--steps", "8"]


@pytest.fixture(scope="module")
def undisturbed(command: list[str], tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("runs") / "run"
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    subprocess.run([*command, "--out", str(out)], check=True, capture_output=True, env=environment)
    return out


@pytest.mark.skipif(not can_mount(), reason="this machine lets nobody mount a small disk")
@pytest.mark.parametrize("size", ["64k", "96k", "300k"])  # a checkpoint does not fit, a figure does not
def test_a_full_disk_is_named_and_costs_nothing(
    size: str, command: list[str], undisturbed: Path, tmp_path: Path
) -> None:
    disk, notes = tmp_path / "disk", tmp_path / "notes"
    disk.mkdir()
    notes.mkdir()
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "SIZE": size, "DISK": str(disk), "NOTES": str(notes)}
    subprocess.run(["unshare", "-rm", "sh", "-c", SCRIPT, "sh", *command], check=True, env=environment)
    assert (notes / "status").read_text().strip() == "1"
    said = (notes / "first.txt").read_text()
    assert f"No space left on device: '{disk / 'run'}/" in said
    assert "what is finished is kept" in said
    assert "Traceback" not in said
    assert damage(notes / "full") == []
    assert not list((notes / "full").rglob("*.part"))
    assert "resuming" in (notes / "second.txt").read_text()
    comparison = compare(*(read_json(path / "results.json") for path in (undisturbed, notes / "finished")))
    assert comparison.compared > 500
    assert comparison.differing == []
