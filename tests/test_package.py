"""The package as a stranger meets it: its import, and who imports whom."""

import ast
import io
import re
import subprocess
import sys
import tokenize
from importlib.metadata import version
from pathlib import Path

import pytest

import torch_ebip

ROOT = Path(__file__).parents[1]


def test_importing_starts_nothing_and_pulls_in_nothing_heavy() -> None:
    program = (
        "import sys, threading, torch; state = torch.get_rng_state(); import torch_ebip; "
        "assert torch.equal(state, torch.get_rng_state()); assert threading.active_count() == 1; "
        "bad = {'tensorboard', 'pytorch_kinematics', 'matplotlib', 'experiments', 'scipy', 'torch._dynamo'}; "
        "bad &= set(sys.modules); "
        "assert not bad, bad"
    )
    subprocess.run([sys.executable, "-c", program], check=True, cwd=ROOT)


def test_every_public_name_is_there() -> None:
    for name in torch_ebip.__all__:
        assert getattr(torch_ebip, name).__doc__, name


FLOORS = ("common", "kinematics", "recordings", "filtering", "interaction", "live", "learning")
"""From the ground up; `docs/architecture.md` has them in this order."""


def test_imports_run_one_way() -> None:
    """A file imports from its own floor and from those below; nobody imports the experiments."""
    for path in (ROOT / "torch_ebip").rglob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        floor = path.relative_to(ROOT / "torch_ebip").parts[0]
        for node in ast.walk(tree):
            modules = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom):
                assert not node.level, path
                modules = [node.module or ""]
            for module in modules:
                first, _, rest = module.partition(".")
                assert first != "experiments", path
                if first == "torch_ebip" and floor != "__init__.py":
                    above = FLOORS.index(rest.split(".")[0])
                    assert above <= FLOORS.index(floor), f"{path} imports {module}"


def test_within_a_floor_no_two_files_import_each_other() -> None:
    """While the interpreter runs; what is imported for types alone does not count."""
    imports: dict[str, set[str]] = {}
    for path in (ROOT / "torch_ebip").rglob("*.py"):
        name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        found = imports.setdefault(name, set())
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("torch_ebip."):
                module = str(node.module)
                below = {f"{module}.{alias.name}" for alias in node.names}
                found |= {module} | {other for other in below if (ROOT / (other.replace(".", "/") + ".py")).exists()}
    done: set[str] = set()

    def visit(name: str, way: tuple[str, ...]) -> None:
        assert name not in way, " -> ".join([*way[way.index(name) :], name])
        if name not in done:
            for other in sorted(imports.get(name, ())):
                visit(other, (*way, name))
            done.add(name)

    for name in sorted(imports):
        visit(name, ())
    assert len(done) > 60


def test_only_one_file_knows_each_heavy_library() -> None:
    """Only `monitor` knows TensorBoard, only `kinematics` pytorch-kinematics."""
    for path in (ROOT / "torch_ebip").rglob("*.py"):
        text = path.read_text()
        if path.name != "monitor.py":
            assert not re.search(r"^\s*(from|import) .*tensorboard", text, re.MULTILINE), path
        if path.parent.name != "kinematics":
            assert not re.search(r"^\s*(from|import) pytorch_kinematics", text, re.MULTILINE), path


def test_filtering_does_not_speak_of_interactions() -> None:
    """No phase, basis or demonstration in its code; words of docstrings and of the contract's argument apart."""
    for path in (ROOT / "torch_ebip" / "filtering").rglob("*.py"):
        for token in tokenize.generate_tokens(io.StringIO(path.read_text(encoding="utf-8")).readline):
            if token.type == tokenize.NAME:
                strange = re.search(r"phase|basis|demonstration|primitive|interaction", token.string, re.IGNORECASE)
                assert not strange or token.string == "demonstrations", f"{path}:{token.start[0]}: {token.string}"


def test_no_file_is_longer_than_a_reader_can_hold() -> None:
    for path in (ROOT / "torch_ebip").rglob("*.py"):
        assert len(path.read_text(encoding="utf-8").splitlines()) <= 300, path


def test_the_completion_shows_what_is_offered() -> None:
    assert set(dir(torch_ebip)) == {*torch_ebip.__all__, "__version__", "__doc__"}
    offered = [
        "InteractionSession",
        "ForwardKinematicsLoss",
        "MeasurementNoise",
        "Update",
        "SquareRoot",
        "Tuner",
        "Monitor",
    ]
    assert set(offered) <= set(torch_ebip.__all__)


def test_only_the_scene_knows_the_simulator() -> None:
    for folder in ("torch_ebip", "experiments"):
        for path in (ROOT / folder).rglob("*.py"):
            known = path.parent.name == "scene"
            assert known or not re.search(r"^\s*(from|import) mujoco", path.read_text(), re.MULTILINE), path


def test_the_version_is_that_of_the_package() -> None:
    assert torch_ebip.__version__ == version("torch-ebip")
    assert f"## [{torch_ebip.__version__}]" in (ROOT / "CHANGELOG.md").read_text()
    with pytest.raises(AttributeError, match="no attribute 'version'"):
        _ = torch_ebip.version


def test_tuples_of_tensors_print_on_a_line() -> None:
    """A trace used to print 14,000 characters; every NamedTuple that holds tensors says what it is instead."""
    checked = 0
    for path in (ROOT / "torch_ebip").rglob("*.py"):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.ClassDef) and any(ast.unparse(base) == "NamedTuple" for base in node.bases):
                fields = [ast.unparse(each.annotation) for each in node.body if isinstance(each, ast.AnnAssign)]
                own = {each.name for each in node.body if isinstance(each, ast.FunctionDef)}
                if any("Tensor" in field for field in fields):
                    assert "__repr__" in own, f"{path}: {node.name}"
                    checked += 1
    assert checked > 15
