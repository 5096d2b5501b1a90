"""Kill a tuning run with SIGKILL at random moments, again and again, and see that nothing is lost.

A small recording is made and tuned on once without disturbance. Then the same command is started, killed after a
random time, looked at and started again, until it is finished; then once more from the beginning, until there were
as many kills as asked for. After each kill every file of the run must be whole: JSON that parses, a checkpoint that
loads with weights only. Each finished run must have the numbers of the undisturbed one, to the bit, in its results
and in its tuned filter, and nothing half-written beside them.
"""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.table import Table
from tqdm import tqdm

from experiments.command_line import add_run_options, command, experiment_parser
from experiments.rerun import compare
from experiments.run_folder import RunFolder
from torch_ebip import Demonstrations, Layout, Modality
from torch_ebip.common.files import read_json
from torch_ebip.learning.interaction_model import NAME
from torch_ebip.learning.model_file import read_model_file

LAYOUT = Layout(
    [
        Modality("hand", ["hand.x", "hand.y", "hand.z"], "m"),
        Modality("gaze", ["gaze.yaw"], "rad"),
        Modality("arm", ["joint_1", "joint_2"], "rad", controlled=True),
    ]
)
STAGES = {"results.json": "finished", NAME: "learned", "checkpoint.pt": "tuning", "config.json": "started"}
"""What stands in a run's folder at each stage, the latest first."""


def recording(seed: int, count: int = 24) -> Demonstrations:
    """A small interaction: paths and joints that depend on where it goes, with noise."""
    generator = torch.Generator().manual_seed(seed)
    trajectories = []
    for i in range(count):
        phase = torch.linspace(0, 1, 50 + i % 7).unsqueeze(-1)
        goal = torch.randn(6, generator=generator)
        path = goal * phase**2 + 0.3 * torch.sin(3 * phase + torch.arange(6))
        trajectories.append(path + 0.01 * torch.randn(path.shape, generator=generator))
    return Demonstrations(LAYOUT, trajectories, 30.0)


def damage(folder: Path) -> list[str]:
    """What is wrong with the files of a run, if anything is."""
    found = []
    for file in sorted(path for path in folder.rglob("*") if path.is_file() and not path.name.endswith(".part")):
        try:
            if file.suffix == ".json":
                read_json(file)
            elif file.suffix == ".pt":
                torch.load(file, weights_only=True)
            elif file.suffix == ".safetensors":
                read_model_file(file)
            elif file.suffix == ".png" and not file.read_bytes().endswith(b"IEND\xaeB`\x82"):
                raise ValueError("cut off")
        except Exception as error:  # whatever it is, the file is damaged
            found.append(f"{file.relative_to(folder)}: {type(error).__name__}: {error}")
    return found


def strangers(folder: Path, reference: Path) -> list[str]:
    """What differs from the undisturbed run: numbers, parameters, and files that it does not have."""
    comparison = compare(read_json(reference / "results.json"), read_json(folder / "results.json"))
    found = [f"{d.place}: {d.before} there, {d.after} here" for d in comparison.differing]
    mine, theirs = (read_model_file(path / NAME)[1] for path in (folder, reference))
    for name, tensor in theirs.items():
        if name not in mine or not torch.equal(tensor, mine[name]):
            found.append(f"{NAME}: {name} differs")
    names = [{p.name for p in path.rglob("*") if "tfevents" not in p.name} for path in (folder, reference)]
    return found + [f"{name}: only in one of them" for name in sorted(names[0] ^ names[1])]


def stage(folder: Path) -> str:
    """How far a run is, from its files."""
    return next((word for name, word in STAGES.items() if (folder / name).exists()), "not begun")


class Campaign:
    """A command that is killed, and what became of it.

    Args:
        folder: to work in.
        seed: of the recording, and of the moments.
        steps: gradient steps of a run.
        interactions: in the recording.
    """

    def __init__(self, folder: Path, seed: int, steps: int, interactions: int) -> None:
        self.folder, self.random = folder, random.Random(seed)
        recording(seed, interactions).save(folder / "recording.npz")
        self.line = [sys.executable, "-m", "experiments.tune", "--data", str(folder / "recording.npz"), "--quick"]
        self.line += ["--steps", str(steps), "--seed", str(seed)]
        self.reference = folder / "undisturbed"
        began = time.monotonic()
        if self.start(self.reference).wait() != 0:
            raise SystemExit(f"the undisturbed run failed: {self.errors()}")
        self.seconds = time.monotonic() - began
        self.kills: Counter[str] = Counter()
        self.finished = 0
        self.lost: list[str] = []
        self.differing: list[str] = []

    def start(self, out: Path) -> subprocess.Popen[bytes]:
        """The command, in a group of processes of its own, with one thread."""
        with (self.folder / "errors.txt").open("wb") as errors:
            return subprocess.Popen(
                [*self.line, "--out", str(out)], stdout=subprocess.DEVNULL, stderr=errors, start_new_session=True,
                env={**os.environ, "OMP_NUM_THREADS": "1"},
            )  # fmt: skip

    def errors(self) -> str:
        """The last words of the last process."""
        return (self.folder / "errors.txt").read_text(errors="replace")[-300:]

    def once(self, out: Path, kill: bool) -> bool:
        """Start it, and kill it at a random moment or let it end; whether it ended by itself."""
        process = self.start(out)
        try:
            process.wait(self.random.uniform(0, self.seconds) if kill else None)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            self.kills[stage(out)] += 1
            self.lost += damage(out) if out.exists() else []
            return False
        if process.returncode != 0:
            self.lost.append(f"at {stage(out)}: ended with {process.returncode}: {self.errors()}")
        return True

    def run(self, kills: int, bar: tqdm[Any]) -> None:
        """Until there were so many kills and the last run is finished."""
        out = self.folder / "disturbed"
        while self.kills.total() < kills or out.exists():
            before = self.kills.total()
            ended = self.once(out, before < kills)
            bar.update(self.kills.total() - before)
            finished = (out / "results.json").exists()
            if finished:
                self.finished += 1
                self.differing += strangers(out, self.reference)
            if ended or finished:
                shutil.rmtree(out, ignore_errors=True)
            bar.set_postfix_str(f"{self.finished} runs finished, {len(self.lost)} lost, {len(self.differing)} differ")


@command
def main(arguments: list[str] | None = None) -> None:
    """Run the campaign from the command line."""
    options = _parser().parse_args(arguments)
    kills = min(options.kills, 3) if options.quick else options.kills
    if kills < 1 or options.steps < 1:
        raise SystemExit("needs --kills and --steps of at least 1")
    began = time.monotonic()
    settings = {"kills": kills, "steps": options.steps, "interactions": options.interactions, "seed": options.seed}
    run = RunFolder("kill", settings, options.out, options.force, arguments)
    with (
        tempfile.TemporaryDirectory() as folder,
        tqdm(total=kills, desc="kills", unit="kill", dynamic_ncols=True) as bar,
    ):
        campaign = Campaign(Path(folder), options.seed, options.steps, options.interactions)
        campaign.run(kills, bar)
    results = {
        "experiment": "kill",
        "kills": kills,
        "kills_by_stage": dict(campaign.kills),
        "runs_finished": campaign.finished,
        "lost": campaign.lost,
        "differing": campaign.differing,
        "undisturbed_seconds": round(campaign.seconds, 1),
        "seconds": round(time.monotonic() - began, 1),
    }
    run.finish(results)
    _print(results)
    print(f"{results['seconds']:.0f} s; written to {run.path}")
    if campaign.lost or campaign.differing:
        raise SystemExit(1)


def _print(results: dict[str, Any]) -> None:
    table = Table(title="a tuning run under kill -9", title_justify="left")
    table.add_column("")
    table.add_column("count", justify="right")
    for name in ("not begun", *reversed(STAGES.values())):
        table.add_row(f"killed: {name}", str(results["kills_by_stage"].get(name, 0)))
    table.add_section()
    table.add_row("kills", str(results["kills"]))
    table.add_row("runs that finished", str(results["runs_finished"]))
    table.add_row("files or runs lost", str(len(results["lost"])))
    table.add_row("numbers or files that differ", str(len(results["differing"])))
    console = Console()
    console.print(table)
    for line in [*results["lost"], *results["differing"]][:20]:
        console.print(line, markup=False)


def _parser() -> Any:
    parser = experiment_parser("kill", __doc__)
    parser.add_argument("--kills", type=int, default=100, help="how many (default: 100)")
    parser.add_argument("--steps", type=int, default=20, help="gradient steps of a run (default: 20)")
    parser.add_argument("--interactions", type=int, default=24, help="in the recording (default: 24)")
    add_run_options(parser, "kill", "the recording and of the moments", "three kills", resumes=False)
    return parser


if __name__ == "__main__":
    main()
