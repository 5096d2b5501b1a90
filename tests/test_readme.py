"""The README holds: its code runs, its formats are read, its commands and their options are there."""

from __future__ import annotations

import importlib
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from torch_ebip import Demonstrations

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```(\w+)\n(.*?)^```$", README, re.DOTALL | re.MULTILINE)
COMMAND = re.compile(r"-m experiments\.(\w+)")
OPTION = re.compile(r"(?<![\w-])--[a-z][a-z-]*")
COMMANDS = sorted(set(COMMAND.findall(README)))


def test_every_kind_of_block_is_checked() -> None:
    assert {language for language, _ in BLOCKS} == {"bash", "python", "bibtex"}


def test_the_python_is_twelve_lines() -> None:
    """`test_wheel` runs them, from an installed wheel."""
    (block,) = _blocks("python")
    lines = [line for line in block.splitlines() if line]
    assert len(lines) <= 12 + 1  # the report is printed beside the twelve


@pytest.mark.parametrize("page", sorted(path.name for path in (ROOT / "docs").glob("*.md")))
def test_the_python_of_a_page_runs(page: str) -> None:
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    blocks = re.findall(r"^```python\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)
    assert blocks or page != "extending.md"
    if blocks:
        subprocess.run([sys.executable, "-c", "\n".join(blocks)], check=True, cwd=ROOT)


def test_the_description_of_a_folder_is_read(tmp_path: Path) -> None:
    (block,) = re.findall(
        r"^```toml\n(.*?)^```$", (ROOT / "docs" / "recordings.md").read_text(), re.DOTALL | re.MULTILINE
    )
    (tmp_path / "layout.toml").write_text(block, encoding="utf-8")
    header = [dof for modality in tomllib.loads(block)["modalities"] for dof in modality["dofs"]]
    rows = [header, ["0.1"] * len(header), ["0.2"] * (len(header) - 1) + [""]]
    (tmp_path / "one.csv").write_text("\n".join(",".join(row) for row in rows), encoding="utf-8")
    demonstrations = Demonstrations.load_folder(tmp_path)
    assert demonstrations.rate == 60.0
    assert demonstrations.layout.dofs == ("hand.x", "hand.y", "hand.z", "joint_1", "joint_2")
    assert demonstrations.layout.controlled.tolist() == [False, False, False, True, True]


def test_the_installation_is_what_the_package_offers() -> None:
    """CI runs the second of these lines as it stands; here only that what they name is there."""
    (block,) = _blocks("bash")
    offered = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    assert len(block.splitlines()) == 2
    for line in block.splitlines():
        assert re.fullmatch(r"pip install -q -c constraints.txt -e '\.\[\w+\]' && python -m [\w.]+", line), line
    named = re.findall(r"(?:\.|torch-ebip)\[(\w+)\]", README)
    assert {"experiments", "test"} <= set(named) <= set(offered)


@pytest.mark.parametrize("name", COMMANDS)
def test_a_commands_options_are_there(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    known = _options(name, capsys)
    named = {option for text, options in _named_options() if text == name for option in options}
    assert named <= known, f"experiments.{name} has no {', '.join(sorted(named - known))}"


def test_options_named_on_their_own_belong_to_a_command_nearby(capsys: pytest.CaptureFixture[str]) -> None:
    known = {name: _options(name, capsys) for name in COMMANDS}
    checked = 0
    for section in re.split(r"^## ", README, flags=re.MULTILINE)[1:]:
        for paragraph in re.split(r"\n\s*\n|\n- ", _without_blocks(section)):
            near = COMMAND.findall(paragraph) or COMMAND.findall(section)
            for span in re.findall(r"`(--[^`]+)`", paragraph):
                for option in OPTION.findall(span):
                    assert any(option in known[name] for name in near), f"{option}: none of {near} has it"
                    checked += 1
    assert checked >= 10


def test_the_other_studies_have_what_is_said_of_all_of_them(capsys: pytest.CaptureFixture[str]) -> None:
    section = README.split("## Other studies")[1].split("\n## ")[0]
    assert "`--help`, `--seed` and `--quick`" in section
    studies = re.findall(r"^- `python -m experiments\.(\w+)`", section, re.MULTILINE)
    assert len(studies) >= 5
    for name in studies:
        assert {"--help", "--seed", "--quick", "--out"} <= _options(name, capsys), name


def test_the_files_it_points_to_are_there() -> None:
    links = re.findall(r"\]\(([^)#:]+)\)", README)
    paths = re.findall(r"`((?:experiments|tests|docs)/[\w/.]+)`", README)
    architecture = (ROOT / "docs" / "architecture.md").read_text().split("\nShapes:")[0]
    files = [name for row in architecture.splitlines() if row.startswith("| `") for name in _first_cell(row)]
    missing = [
        path for path in [*links, *paths, *(f"torch_ebip/{name}" for name in files)] if not (ROOT / path).exists()
    ]
    assert len(files) >= 7
    assert not missing


def test_the_architecture_names_every_file() -> None:
    architecture = (ROOT / "docs" / "architecture.md").read_text().split("\nShapes:")[0]
    named = {name.rstrip("/") for row in architecture.splitlines() for name in _first_cell(row)}
    found = {path.name for path in (ROOT / "torch_ebip").iterdir() if path.suffix == ".py" or path.is_dir()}
    assert found - {"__init__.py", "__pycache__"} == named


def _blocks(language: str) -> list[str]:
    return [text for kind, text in BLOCKS if kind == language]


def _without_blocks(text: str) -> str:
    return re.sub(r"^```.*?^```$", "", text, flags=re.DOTALL | re.MULTILINE)


def _first_cell(row: str) -> list[str]:
    """Files that the first cell of a row of a table names."""
    return re.findall(r"`([\w/.]+)`", row.split("|")[1]) if row.startswith("| ") else []


def _named_options() -> Iterator[tuple[str, list[str]]]:
    """Options that stand behind a command, with the command; those before it are another program's."""
    for span in [*re.findall(r"`([^`\n]*)`", _without_blocks(README)), *"".join(_blocks("bash")).splitlines()]:
        for name, rest in re.findall(r"-m experiments\.(\w+)([^&]*)", span):
            yield name, OPTION.findall(rest)


def _options(name: str, capsys: pytest.CaptureFixture[str]) -> set[str]:
    """What ``--help`` of an experiment lists."""
    module = f"experiments.{name}"
    is_package = (ROOT / "experiments" / name).is_dir()
    with pytest.raises(SystemExit) as stopped:
        importlib.import_module(f"{module}.__main__" if is_package else module).main(["--help"])
    assert stopped.value.code == 0
    text = capsys.readouterr().out
    assert f"usage: python -m {module}" in text
    return set(OPTION.findall(text))
