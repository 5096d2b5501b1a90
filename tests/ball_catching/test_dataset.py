"""The data set: caught balls, plausible statistics, reproducible, cached."""

from pathlib import Path

import numpy as np
import pytest
import torch

from experiments.ball_catching import BOX_WIDTH, LAYOUT, SUBSETS, base_transform, dataset, generate, teacher
from experiments.ball_catching.__main__ import main as command_line
from experiments.ball_catching.dataset import Session, load_or_generate
from experiments.ball_catching.geometry import GRAVITY
from experiments.ball_catching.thrower import PEOPLE
from torch_ebip import Demonstrations


def same(a: Demonstrations, b: Demonstrations) -> bool:
    return len(a) == len(b) and all(
        torch.equal(x.nan_to_num(9e9), y.nan_to_num(9e9)) for x, y in zip(a, b, strict=True)
    )


def last(demonstrations: Demonstrations, name: str) -> torch.Tensor:
    return torch.stack([values[-1, LAYOUT.slice(name)] for values in demonstrations]).double()


def test_layout_and_subsets() -> None:
    assert LAYOUT.n_dofs == 48
    assert int(LAYOUT.controlled.sum()) == 6
    assert list(SUBSETS) == ["ball", "shoe+imu", "shoe+imu+head", "shoe+imu+head+ball", "all"]
    assert set(SUBSETS["all"]) == set(LAYOUT.names) - {"robot"}
    for names in SUBSETS.values():
        assert not (LAYOUT.mask(names) & LAYOUT.controlled).any()


def test_takes_less_than_a_minute(timed_demonstrations: tuple[Demonstrations, float]) -> None:
    demonstrations, seconds = timed_demonstrations
    assert len(demonstrations) == 221
    assert seconds < 60.0


def test_the_ball_ends_in_the_box(demonstrations: Demonstrations) -> None:
    box = base_transform() @ teacher.arm()(last(demonstrations, "robot"))
    ball = torch.from_numpy(demonstrations.columns["interception"])
    distance = (box[:, :3, 3] - ball).norm(dim=-1)
    assert (distance < 0.1).double().mean() > 0.97
    # All the way within the opening, seen along its axis, ball radius included.
    inside = torch.linalg.solve(box, torch.cat([ball, torch.ones(len(ball), 1)], -1)[..., None])[:, :2, 0]
    assert (inside.abs() + 0.045 < BOX_WIDTH / 2).double().mean() > 0.97
    # The box looks at the ball that comes from the thrower.
    assert (box[:, 0, 2] < 0).double().mean() > 0.97


def test_measured_ball_agrees_with_the_interception(demonstrations: Demonstrations) -> None:
    error = last(demonstrations, "ball") - torch.from_numpy(demonstrations.columns["interception"])
    assert error.isfinite().all()
    assert error.std() < 0.015


def test_balls_are_caught_all_over_a_region_of_about_1_8_m(demonstrations: Demonstrations) -> None:
    y = demonstrations.columns["interception"][:, 1]
    width = np.quantile(y, 0.99) - np.quantile(y, 0.01) + BOX_WIDTH
    assert 1.5 < width < 2.1


def test_release_and_durations(demonstrations: Demonstrations) -> None:
    phase = demonstrations.columns["release_phase"]
    assert phase.mean() == pytest.approx(0.43, abs=0.03)
    assert 0.3 < phase.min() < phase.max() < 0.6
    np.testing.assert_allclose(demonstrations.columns["release"], phase * demonstrations.durations.numpy(), rtol=1e-5)
    assert demonstrations.durations.min() > 1.1
    assert demonstrations.durations.max() < 3.0
    assert demonstrations.durations.std() > 0.15


def test_the_robot_keeps_its_limits(demonstrations: Demonstrations) -> None:
    limits = teacher.arm().joint_limits
    for values in demonstrations:
        joints = values[:, LAYOUT.slice("robot")].double()
        assert (joints.diff(dim=0) * demonstrations.rate).abs().max() < np.pi + 0.05  # encoder noise, differenced
        assert ((joints > limits[:, 0]) & (joints < limits[:, 1])).all()


def test_joint_speeds_are_below_the_limit(session: Session) -> None:
    since = session.t - session.throw.release[:, None]
    speed = np.abs(session.lesson.joints(since).qd).max(axis=(1, 2))
    assert (speed[session.lesson.possible] < np.pi).all()


def test_the_ball_is_unseen_until_it_has_left_the_hand(demonstrations: Demonstrations) -> None:
    for values, release in zip(demonstrations, demonstrations.columns["release"], strict=True):
        seen = ~values[:, LAYOUT.slice("ball")].isnan().any(-1)
        first = int(seen.nonzero()[0])
        assert release < first / 60.0
        assert seen[first:].double().mean() > 0.7


def test_missing_values_are_few_elsewhere(demonstrations: Demonstrations) -> None:
    values, _ = demonstrations.pad()
    for name in LAYOUT.names:
        if name != "ball":
            missing = np.mean([bool(v[:, LAYOUT.slice(name)].isnan().any()) for v in demonstrations])
            assert missing < 0.2, name
    assert not torch.isinf(values).any()
    assert not torch.stack([v[-1] for v in demonstrations]).isnan().any()


def test_readings_at_rest(demonstrations: Demonstrations) -> None:
    # In the first samples people hardly move: the unit feels gravity, the soles the body's weight.
    force = torch.stack([v[0, LAYOUT.slice("imu_acceleration")] for v in demonstrations]).norm(dim=-1)
    assert force.nanmedian() == pytest.approx(GRAVITY, abs=0.3)
    shoes = LAYOUT.mask(["shoe_left", "shoe_right"])
    load = torch.stack([v[0, shoes] for v in demonstrations]).sum(-1).numpy()
    weight = np.array([PEOPLE[p].mass for p in demonstrations.columns["person"]]) * GRAVITY
    assert np.nanmedian(load / weight) == pytest.approx(1.0, abs=0.05)


def test_head_never_comes_near_a_wrap(demonstrations: Demonstrations) -> None:
    head = torch.cat([v[:, LAYOUT.slice("head")] for v in demonstrations])
    assert head.norm(dim=-1).nan_to_num().max() < 1.5


def test_several_people_styles_and_teachers(demonstrations: Demonstrations) -> None:
    for name, least in (("person", 5), ("style", 3), ("teacher", 3)):
        _, counts = np.unique(demonstrations.columns[name], return_counts=True)
        assert len(counts) == least
        assert counts.min() >= 10, name


def test_same_seed_same_data() -> None:
    first = generate(12, seed=3)
    assert same(first, generate(12, seed=3))
    assert not same(first, generate(12, seed=4))
    assert same(generate(5, seed=3), first.subset(range(5)))


def test_global_random_state_is_left_alone() -> None:
    torch_state, numpy_state = torch.random.get_rng_state(), str(np.random.get_state())  # noqa: NPY002
    generate(1)
    assert torch.equal(torch_state, torch.random.get_rng_state())
    assert numpy_state == str(np.random.get_state())  # noqa: NPY002


def test_bad_count() -> None:
    with pytest.raises(ValueError, match="n: expected at least one demonstration, got 0"):
        generate(0)


def test_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "new" / "cache"
    made = load_or_generate(3, seed=1, cache_dir=folder)
    (path,) = folder.iterdir()  # nothing but the finished file
    monkeypatch.setattr(dataset, "generate", lambda n, seed: pytest.fail("was in the cache"))
    read = load_or_generate(3, seed=1, cache_dir=folder)
    assert same(made, read)
    assert set(read.columns) == set(made.columns)
    assert read.columns["style"].tolist() == made.columns["style"].tolist()
    monkeypatch.undo()
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.warns(UserWarning, match="is made anew"):
        assert same(load_or_generate(3, seed=1, cache_dir=folder), made)
    assert same(Demonstrations.load(path), made)


def test_a_cache_that_cannot_be_written_is_no_obstacle(tmp_path: Path) -> None:
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    with pytest.warns(UserWarning, match="could not be kept"):
        assert len(load_or_generate(2, cache_dir=blocked)) == 2


def test_command_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(dataset, "user_cache_dir", lambda *_: str(tmp_path / "cache"))
    figure, out = tmp_path / "figure.png", tmp_path / "data.npz"
    command_line(["--n", "3", "--figure", str(figure), "--out", str(out), "--index", "2"])
    assert figure.stat().st_size > 50_000
    assert len(Demonstrations.load(out)) == 3
    assert "release at" in capsys.readouterr().out
    for wrong in (["--n", "0"], ["--n", "3", "--index", "3"]):
        with pytest.raises(SystemExit):
            command_line(wrong)
        assert "must be" in capsys.readouterr().err
