"""Several processes: the numbers of one, and a run that survives the loss of one of them."""

import json
import os
import subprocess
import sys
from itertools import product
from pathlib import Path

import pytest
import torch

from torch_ebip.common.draws import seeded
from torch_ebip.learning.ranks import RankLostError, Ranks

ROOT = Path(__file__).parents[2]


def launch(count: int, folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """torchrun of the small program."""
    folder.mkdir(exist_ok=True)
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(count)]
    return subprocess.run(
        [*command, "-m", "tests.ranks_program", str(folder), *arguments],
        cwd=ROOT,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )


def outcome(folder: Path) -> dict:
    return json.loads((folder / "outcome.json").read_text())


def assert_same(a: dict, b: dict) -> None:
    assert a["validation"].keys() == b["validation"].keys()
    for step, loss in a["validation"].items():
        assert b["validation"][step] == pytest.approx(loss, rel=1e-4)
    for name, values in a["parameters"].items():
        torch.testing.assert_close(
            torch.tensor(b["parameters"][name]), torch.tensor(values), rtol=1e-3, atol=1e-3, msg=name
        )


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> dict:
    """What one process comes to."""
    folder = tmp_path_factory.mktemp("ranks") / "1"
    done = launch(1, folder)
    assert done.returncode == 0, done.stderr
    return outcome(folder)


def assert_talked(outcome: dict, count: int) -> None:
    """That many processes did, on this machine only; torchrun itself does not keep to that."""
    assert outcome["words"] == "from the first"
    assert outcome["ranks"] == list(range(count))
    assert outcome["listening"] == [["127.0.0.1"]] * count


def test_the_result_does_not_depend_on_the_number_of_processes(alone: dict, tmp_path: Path) -> None:
    done = launch(2, tmp_path / "2")
    assert done.returncode == 0, done.stderr
    assert_same(alone, outcome(tmp_path / "2"))
    assert_talked(outcome(tmp_path / "2"), 2)


def test_a_killed_process_ends_the_run_which_resumes_with_another_number(alone: dict, tmp_path: Path) -> None:
    killed = launch(2, tmp_path / "killed", "3")
    assert killed.returncode != 0
    assert "run it again to go on" in killed.stderr
    assert (tmp_path / "killed" / "c.pt").exists()
    assert not (tmp_path / "killed" / "outcome.json").exists()
    resumed = launch(3, tmp_path / "killed")
    assert resumed.returncode == 0, resumed.stderr
    assert_same(alone, outcome(tmp_path / "killed"))
    assert_talked(outcome(tmp_path / "killed"), 3)


def test_one_process_needs_no_group() -> None:
    ranks = Ranks.start()
    assert (ranks.rank, ranks.size, ranks.first) == (0, 1, True)
    assert ranks.mean({"a": 2.0}, 3.0) == {"a": 2.0}
    assert ranks.gather("x") == ["x"]
    assert ranks.shard([1, 2, 3]) == [1, 2, 3]
    with pytest.raises(ValueError, match="as it was"):
        ranks.from_first(_fail)


def _fail() -> None:
    raise ValueError("as it was")


def test_shards_are_a_partition() -> None:
    parts = [Ranks(rank, 3).shard(list(range(10))) for rank in range(3)]
    assert sorted(item for part in parts for item in part) == list(range(10))
    assert max(map(len, parts)) - min(map(len, parts)) <= 1


def test_seeds_of_neighbours_share_no_stream() -> None:
    keys = product(range(3), (-1, 0, 1), (0, 1))
    draws = {tuple(torch.rand(2, generator=seeded(*key)).tolist()) for key in keys}
    assert len(draws) == 18
    assert torch.equal(torch.rand(2, generator=seeded(1, 2)), torch.rand(2, generator=seeded(1, 2)))


def test_what_the_first_process_cannot_make_ends_all_of_them(monkeypatch: pytest.MonkeyPatch) -> None:
    wire: list = []

    def broadcast(made: list) -> None:
        if made != [None, None]:
            wire[:] = made
        made[:] = wire

    def fail() -> int:
        raise ValueError("no such file")

    monkeypatch.setattr(torch.distributed, "broadcast_object_list", broadcast)
    with pytest.raises(ValueError, match="no such file"):
        Ranks(0, 2).from_first(fail)
    with pytest.raises(SystemExit, match="the first process stopped"):
        Ranks(1, 2).from_first(lambda: pytest.fail("only the first one makes it"))
    assert Ranks(0, 2).from_first(lambda: 7) == Ranks(1, 2).from_first(lambda: 8) == 7


def test_a_broken_connection_is_a_lost_rank(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> None:
        raise RuntimeError("connection closed by peer")

    monkeypatch.setattr(torch.distributed, "all_reduce", broken)
    for talk in (lambda: Ranks(0, 2).add_up([torch.ones(3)]), lambda: Ranks(1, 2).mean({"a": 1.0}, 1.0)):
        with pytest.raises(RankLostError, match="connection closed by peer"):
            talk()
