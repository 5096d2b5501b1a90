"""CSV as people have it: times of its own, marks, delimiters, decimal commas, units."""

from pathlib import Path

import numpy as np
import pytest
import torch

from torch_ebip import Demonstrations

LAYOUT = '{}\n[[modalities]]\nname = "hand"\ndofs = ["x", "y"]\nunit = "{}"\n'
PLAIN = "x,y\n" + "".join(f"{i},{2 * i}.5\n" for i in range(5))


def folder(path: Path, *files: bytes | str, head: str = "rate = 60.0", unit: str = "m", mark: bytes = b"") -> Path:
    (path / "layout.toml").write_bytes(mark + LAYOUT.format(head, unit).encode())
    for name, text in zip("abcdef", files, strict=False):
        (path / f"{name}.csv").write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


@pytest.mark.parametrize(
    "text",
    [
        PLAIN.encode(),
        b"\xef\xbb\xbf" + PLAIN.encode(),
        PLAIN.encode() + b"\n",
        PLAIN.encode() + b"\r\n \r\n",
        PLAIN.replace("\n", "\r\n").encode(),
        PLAIN.replace(".", "#").replace(",", ";").replace("#", ",").encode(),
        PLAIN.replace(",", ";").encode(),
        PLAIN.replace(",", "\t").encode(),
        PLAIN.replace(",", "|").encode(),
    ],
)
def test_the_same_numbers_however_they_are_written(tmp_path: Path, text: bytes) -> None:
    made = Demonstrations.load_folder(folder(tmp_path, text, mark=b"\xef\xbb\xbf"))
    assert made.rate == 60
    wanted = torch.stack([torch.arange(5.0), 2 * torch.arange(5.0) + 0.5], -1)
    assert torch.equal(made[0], wanted)
    assert made.remarks == ()


def test_a_header_of_two_lines(tmp_path: Path) -> None:
    made = Demonstrations.load_folder(folder(tmp_path, 'x,"note,\nof two lines",y\n1,a,2\n3,b,4\n'))
    assert torch.equal(made[0], torch.tensor([[1.0, 2.0], [3.0, 4.0]]))


def test_times_decide_how_long_it_lasts(tmp_path: Path) -> None:
    rows = "".join(f"{i / 30},{i},0\n" for i in range(61) if not 20 < i < 50)
    with pytest.warns(UserWarning, match=r"rows of 1 of 1 files \(a.csv\) are not 0.01667 s apart"):
        made = Demonstrations.load_folder(folder(tmp_path, "time,x,y\n" + rows))
    assert float(made.durations) == pytest.approx(2.0)
    x = made[0][:, 0]
    assert x[45:95].isnan().all()  # a gap is a gap
    said = ~x.isnan()
    torch.testing.assert_close(x[said], (torch.arange(len(x)) / 2)[said], atol=1e-3, rtol=0)
    assert made.remarks


def test_times_that_agree_change_nothing(tmp_path: Path) -> None:
    rows = [f"{1e9 + i / 60:.4f},{i},0\n" for i in range(8)]
    made = Demonstrations.load_folder(folder(tmp_path, "t,x,y\n" + "".join(rows)))
    assert torch.equal(made[0][:, 0], torch.arange(8.0))
    assert made.remarks == ()


def test_times_are_named_or_left_alone(tmp_path: Path) -> None:
    text = "stamp,time,x,y\n" + "".join(f"{50 * i},{i},{i},0\n" for i in range(9))
    named = Demonstrations.load_folder(folder(tmp_path, text, head='time = "stamp"\ntime_unit = "ms"'))
    assert named.rate == 20
    assert torch.equal(named[0][:, 0], torch.arange(9.0))
    none = Demonstrations.load_folder(folder(tmp_path, text, head='rate = 60\ntime = ""'))
    assert none.rate == 60
    assert len(none[0]) == 9


def test_rows_of_several_files_share_a_rate(tmp_path: Path) -> None:
    a, b = ("time,x,y\n" + "".join(f"{i / rate},{i / rate},0\n" for i in range(rate)) for rate in (20, 50))
    with pytest.warns(UserWarning, match="rows of 1 of 2 files"):
        made = Demonstrations.load_folder(folder(tmp_path, a, b, head="rate = 50.0\nmax_gap = 0.2"))
    torch.testing.assert_close(made[0][:, 0], torch.arange(len(made[0])) / 50, atol=1e-6, rtol=0)


def test_units_are_converted(tmp_path: Path) -> None:
    made = Demonstrations.load_folder(folder(tmp_path, PLAIN, unit="mm"))
    assert made.layout.units == ("m", "m")
    np.testing.assert_allclose(made[0][:, 0], np.arange(5) / 1000, rtol=1e-6)


@pytest.mark.parametrize(
    ("text", "head", "said"),
    [
        ("x,y\n1,2\n\n3,4\n", "rate = 60", "a.csv:3: an empty line between samples"),
        ("x,y\n1,2\n1,2,3\n", "rate = 60", "a.csv:3: 3 cells, the header has 2"),
        ("x,y\n1,2\n1,b\n", "rate = 60", "a.csv:3: column 'y': 'b' is not a number"),
        ("x;y\n1,5;2\n1.5.2;3\n", "rate = 60", "a.csv:3: column 'x'"),
        ("x,y\n1,2\n1,2\n", 'time = "stamp"', "a.csv: no column of times"),
        ("time,x,y\n0,1,2\n,1,2\n", "rate = 60", "a.csv: 1 of 2 times are missing"),
        ("time,x,y\n" + "".join(f"{16 * i},1,2\n" for i in range(9)), "rate = 60", "are these ms"),
        ("time,x,y\n" + "".join(f"{-i / 60},1,2\n" for i in range(9)), "rate = 60", "run backwards"),
        ("x,y\n1,2\n1,2\n", 'rate = 60\ntime_unit = "mm"', "time_unit must be a unit of time"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, text: str, head: str, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        Demonstrations.load_folder(folder(tmp_path, text, head=head))


def test_double_precision_comes_back(tmp_path: Path) -> None:
    layout = Demonstrations.load_folder(folder(tmp_path, PLAIN)).layout
    values = torch.rand(7, 2, dtype=torch.float64)
    for dtype in (torch.float64, torch.float32):
        Demonstrations(layout, [values.to(dtype)], 60.0).save(tmp_path / "made.npz")
        assert torch.equal(Demonstrations.load(tmp_path / "made.npz")[0], values.to(dtype))
