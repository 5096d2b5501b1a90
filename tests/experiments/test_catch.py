"""The closed loop: throws, who catches them, what is counted, and the command line at a small size."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from experiments.ball_catching import flight
from experiments.ball_catching.geometry import Array
from experiments.ball_catching.scene import Limits, Reach, World
from experiments.ball_catching.scene.camera import NoGraphicsError
from experiments.ball_catching.sensors import LAYOUT
from experiments.ball_catching.teacher import HABITS
from experiments.catch import __main__ as command
from experiments.catch import pictures
from experiments.catch.controllers import MeanController, ReactiveController, mean_posture, predict_flight
from experiments.catch.jobs import Plan, Portion, run_portion
from experiments.catch.learning import MEMBERS, filters, know, learn
from experiments.catch.table import markdown, summarise
from experiments.catch.throws import Toss, catchable, draw
from experiments.catch.trial import Drop, run
from torch_ebip import InteractionModel
from torch_ebip.common.files import write_json
from torch_ebip.learning.starts import Start, tunable

pytest.importorskip("mujoco")
READY = np.array(HABITS[0].ready)


@pytest.fixture(scope="module")
def tosses() -> list[Toss]:
    return draw("aimed", 8, 3)


@pytest.fixture(scope="module")
def world() -> World:
    return World()


class Told:
    """Goes where it is told, and remembers what sensors said."""

    def __init__(self, goal: Array | None) -> None:
        self.goal, self.seconds = goal, list[float]()
        self.pushed: list[tuple[str, float]] = []
        self.asked: list[float] = []

    def push(self, sensor: str, values: Array, time: float) -> None:
        self.pushed.append((sensor, time))

    def command(self, now: float, joints: Array) -> Array | None:
        self.asked.append(now)
        return self.goal


def test_throws_are_fixed_by_their_seed(tosses: list[Toss]) -> None:
    again, other = draw("aimed", 5, 3), draw("aimed", 5, 4)
    for one, two in zip(tosses, again, strict=False):
        assert one.release == two.release
        np.testing.assert_array_equal(one.velocity, two.velocity)
        assert [p.arrival for p in one.packets] == [p.arrival for p in two.packets]
    assert tosses[0].release != other[0].release
    assert [toss.number for toss in tosses] == list(range(8))


def test_sensors_send_what_they_see_when_they_have_it(tosses: list[Toss]) -> None:
    for toss in tosses:
        arrivals = [packet.arrival for packet in toss.packets]
        assert arrivals == sorted(arrivals)
        assert all(0 < packet.arrival - packet.time < 0.1 for packet in toss.packets)
        assert {packet.sensor for packet in toss.packets} == set(LAYOUT.names) - {"robot"}
        seen = [packet.time for packet in toss.packets if packet.sensor == "ball"]
        assert toss.release < min(seen) < toss.release + 0.12
        assert max(packet.time for packet in toss.packets) <= toss.end
        for packet in toss.packets:
            assert packet.values.shape == (len(LAYOUT[packet.sensor].dofs),)


def test_what_is_catchable() -> None:
    position = np.array([[0.3, 0.0, 1.5]] * 3)
    target = np.array([[3.15, 0.2, 1.0], [3.15, 3.0, 1.0], [3.15, 0.2, 1.0]])
    velocity = flight.release_velocity(position, target, np.array([0.9, 0.9, 0.9]))
    path = flight.fly(position, velocity, 2.0)
    reach = Reach()
    assert [catchable(path, i, reach, Limits()) for i in range(2)] == [True, False]
    assert not catchable(path, 2, reach, Limits(speed=0.1))


def test_the_flight_is_predicted_from_what_was_seen_of_it() -> None:
    path = flight.fly(np.array([[0.3, -0.2, 1.5]]), np.array([[3.8, 0.3, 3.6]]), 1.2)
    times = np.arange(2, 14) / 60
    seen = [(float(t), path.at(np.array([[t]]))[0, 0]) for t in times]
    ahead, positions, velocities = predict_flight(seen, 0.25)
    assert ahead[0] >= 0.25
    near = ahead < 1.0
    np.testing.assert_allclose(positions[near], path.at(ahead[None])[0][near], atol=0.01)
    np.testing.assert_allclose(velocities[near], path.velocity_at(ahead[None])[0][near], atol=0.05)


def test_who_knows_catches_and_who_does_nothing_does_not(tosses: list[Toss], world: World) -> None:
    reach, caught = Reach(), 0
    possible = [toss for toss in tosses if toss.catchable][:4]
    for toss in possible:
        path = flight.fly(toss.position[None], toss.velocity[None], 1.6)
        k = int((path.position[0, :, 0] > 3.15).argmax())
        direction = path.velocity[0, k] / np.linalg.norm(path.velocity[0, k])
        goal = reach.solve(path.position[0, k], -direction, READY, READY).joints
        outcome = run(world, toss, Told(goal), READY)
        caught += outcome.caught
        assert outcome.ahead > 0  # it was told before the release
        idle = run(world, toss, Told(None), READY)
        assert idle.distance > outcome.distance
        assert idle.ahead == pytest.approx(toss.release)
        assert not (idle.caught and idle.distance > 0.3)
    assert caught >= len(possible) - 1


def test_the_reactive_catcher_catches(tosses: list[Toss], world: World) -> None:
    reach = Reach()
    possible = [toss for toss in tosses if toss.catchable][:4]
    outcomes = [run(world, toss, ReactiveController(reach, READY, Limits()), READY) for toss in possible]
    assert sum(outcome.caught for outcome in outcomes) >= len(possible) - 1
    assert np.median([outcome.distance for outcome in outcomes]) < 0.05


def test_a_trial_repeats_itself_and_cuts_what_is_dropped(tosses: list[Toss], world: World) -> None:
    toss, whole, cut = tosses[0], Told(READY), Told(READY)
    one = run(world, toss, whole, READY)
    two = run(world, toss, cut, READY, Drop(("imu_gyro", "imu_acceleration"), 0.3))
    assert one == two
    assert whole.asked[:3] == pytest.approx([0.0, 1 / 60, 2 / 60], abs=1.1e-3)
    kept = [entry for entry in whole.pushed if not entry[0].startswith("imu") or entry[1] <= 0.3 * toss.end]
    assert cut.pushed == kept
    assert len(whole.pushed) - len(kept) > 30
    # Nothing is heard before it arrives.
    assert len(whole.pushed) <= len(toss.packets)


def test_the_mean_response_is_the_mean_of_the_demonstrations() -> None:
    primitive = know(40, 0)
    rows = primitive.basis.project(primitive.weights.new_ones(40), primitive.weights)
    wanted = rows[:, LAYOUT.slice("robot")].mean(0).double().numpy()
    np.testing.assert_allclose(mean_posture(primitive, 1.0), wanted, atol=1e-6)
    controller = MeanController(primitive, None)
    np.testing.assert_allclose(controller.command(0.0, READY), wanted, atol=1e-6)


def throw(number: int, caught: bool, catchable: bool = True) -> dict[str, object]:
    return {
        "number": number,
        "caught": caught,
        "touched": True,
        "catchable": catchable,
        "distance": 0.1 * number,
        "ahead": number - 2.0,
        "seconds": [0.001, 0.003],
    }


def test_the_table_against_formulas() -> None:
    a = [throw(i, caught) for i, caught in enumerate([True] * 9 + [False])]
    b = [throw(i, caught) for i, caught in enumerate([True] * 3 + [False] * 6 + [True])]
    a[0]["catchable"] = b[0]["catchable"] = False
    summary = summarise({("a", "aimed"): a, ("b", "aimed"): b}, "a")
    rows = {(row["method"], row["metric"]): row for row in summary["rows"]}
    row = rows["a", "caught"]
    z, n, p = 1.959963984540054, 10, 0.9
    centre = (p + z**2 / (2 * n)) / (1 + z**2 / n)
    half = z / (1 + z**2 / n) * np.sqrt(p * (1 - p) / n + z**2 / (4 * n**2))
    assert (row["value"], row["n"]) == (0.9, 10)
    assert row["low"] == pytest.approx(centre - half)
    assert row["high"] == pytest.approx(centre + half)
    assert rows["a", "caught_within_reach"]["n"] == 9
    assert rows["b", "caught_within_reach"]["value"] == pytest.approx(3 / 9)
    assert rows["a", "distance"]["value"] == pytest.approx(0.45)
    assert rows["a", "settled_before_release"]["value"] == pytest.approx(0.7)
    assert rows["a", "cycle_median"]["value"] == pytest.approx(2.0)
    # Six throws that only a caught, one that only b caught: 2 (1 + 7) / 2^7.
    test = next(c for c in summary["comparisons"] if c["metric"] == "caught")
    assert (test["only_a"], test["only_b"]) == (6, 1)
    assert test["p_value"] == pytest.approx(2 * 8 / 128)
    text = markdown(summary)
    assert "| aimed | `a` | 90% (60 to 98 %, n = 10) |" in text


@pytest.fixture(scope="module")
def learned(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What `learn` would leave, without the tuning."""
    folder, start = tmp_path_factory.mktemp("learned"), Start(300.0, 10.0)
    known = know(100, 0)
    InteractionModel(tunable(known, start, MEMBERS), known).save(folder / "model.safetensors")
    write_json(folder / "report.json", {"factor": 300.0})
    write_json(folder / "config.json", {"settings": {"demonstrations": 100, "seed": 0}})
    return folder


def test_the_command_at_a_small_size(learned: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "run"
    small = ["--filter", str(learned), "--demonstrations", "100", "--throws", "2", "--out", str(out)]
    small += ["--methods", "ebip_tuned,mean", "--workers", "2", "--no-pictures"]
    command.main(small)
    results = json.loads((out / "results.json").read_text())
    assert {row["method"] for row in results["rows"]} == {"ebip_tuned", "mean"}
    assert {row["condition"] for row in results["rows"]} == {"aimed", "blindfolded"}
    assert {row["metric"] for row in results["rows"]} >= {"caught", "distance", "ahead_of_release", "cycle_p99"}
    assert (out / "results.md").exists()
    assert "ebip_tuned" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="finished run"):
        command.main(small)
    # Without its results the run is unfinished; what was thrown is not thrown again.
    (out / "results.json").unlink()
    kept = sorted((out / "throws").iterdir())
    assert len(kept) == 4
    marked = json.loads(kept[0].read_text())
    marked[0]["distance"] = 77.0
    kept[0].write_text(json.dumps(marked))
    command.main(small)
    again = json.loads((out / "results.json").read_text())
    assert max(row["high"] or 0 for row in again["rows"] if row["metric"] == "distance") > 10


def test_pictures_are_drawn_with_and_without_graphics(
    learned: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    plan = Plan(str(learned), 2, 100, 0, 0.5, 1.0, (), 0.0)
    rows = run_portion(Portion(plan, "ebip", "aimed", 0, 1))

    def none(*arguments: object) -> None:
        raise NoGraphicsError("no OpenGL; apt install")

    monkeypatch.setattr(pictures, "Camera", none)
    monkeypatch.setattr(pictures, "STRIDE", 20)
    pictures.draw_pictures(plan, "ebip", {("ebip", "aimed"): [{**rows[0], "caught": True}]}, tmp_path)
    assert "apt install; plotted instead" in capsys.readouterr().err
    with Image.open(tmp_path / "throws.gif") as animation:
        assert animation.n_frames > 10
    with Image.open(tmp_path / "throws.png") as strip:
        assert min(strip.size) > 400


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--drop", "nose@0.3"], "expects SENSOR@SHARE"),
        (["--drop", "imu"], "expects SENSOR@SHARE"),
        (["--drop", "imu@2"], "expects SENSOR@SHARE"),
        (["--methods", "ebip,magic"], "magic unknown"),
        (["--throws", "0"], "--throws of at least 1"),
        (["--arm", "0"], "--arm between 0 and 1"),
        (["--filter", "/nowhere"], "no finished tuning"),
        (["--lead", "soon"], "--lead"),
        (["--lead", "inf"], "--lead"),
    ],
)
def test_mistakes_are_explained(arguments: list[str], message: str, tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match=message):
        command.main([*arguments, "--out", str(tmp_path / "run")])
    assert not (tmp_path / "run").exists()


def test_a_filter_of_other_demonstrations_is_refused(learned: Path, tmp_path: Path) -> None:
    with pytest.raises(SystemExit, match="tuned on 100 demonstrations of seed 0, not on 221 of seed 1"):
        command.main(["--filter", str(learned), "--seed", "1", "--out", str(tmp_path / "run")])


def test_learning_leaves_a_tuned_filter_of_eighty(tmp_path: Path) -> None:
    stages: list[str] = []
    quick = {"scan": 4, "pace": False, "expert": False, "analogues": False}
    learn(tmp_path, 90, 0, 1, lambda progress: stages.append(progress.stage), **quick)
    assert "gradient" in stages
    report = json.loads((tmp_path / "report.json").read_text())
    filter = filters(tmp_path, know(90, 0), report["factor"])["ebip_tuned"]()
    assert filter.n_members == MEMBERS
    told = len(stages)
    learn(tmp_path, 90, 0, 1, lambda progress: stages.append(progress.stage), **quick)  # nothing left to do
    assert len(stages) == told
