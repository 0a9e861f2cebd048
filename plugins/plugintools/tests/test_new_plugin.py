"""`qgs new-plugin`: what it writes, and what it refuses."""

import ast
import math
import os
import subprocess
import sys
import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from commands import run_qgs
from qgs_plugintools.new_command import check_name, new_folder, rendered

from qgs.composer.errors import Problems
from qgs.composer.yaml_text import load_mapping
from qgs.contracts import ModelDims
from qgs.types import ImageMemory, QueryState


@pytest.fixture(autouse=True)
def _in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def test_it_writes_a_complete_distribution(tmp_path: Path) -> None:
    result = run_qgs("new-plugin", "far-sighted")
    assert result.exit_code == 0, result.output
    folder = tmp_path / "qgs-far-sighted"
    written = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
    assert written == {
        ".gitignore",
        "README.md",
        "pyproject.toml",
        "recipe.yaml",
        "src/qgs_far_sighted/__init__.py",
        "src/qgs_far_sighted/abstaining.py",
        "src/qgs_far_sighted/py.typed",
        "tests/test_components.py",
    }
    project = tomllib.loads((folder / "pyproject.toml").read_text())["project"]
    assert project["name"] == "qgs-far-sighted"
    assert project["entry-points"]["qgs.plugins"] == {"far-sighted": "qgs_far_sighted:plugin"}
    assert [path.name for path in tmp_path.iterdir()] == ["qgs-far-sighted"], "nothing is left over"


def test_component_and_test_are_short() -> None:
    files = {str(path): text for path, text in rendered("short")}
    component = files["src/qgs_short/abstaining.py"]
    assert len(component.splitlines()) < 50
    assert len(files["tests/test_components.py"].splitlines()) < 10
    for path, text in files.items():
        assert "{{" not in text
        if path.endswith(".py"):
            ast.parse(text)
            assert max(map(len, text.splitlines())) <= 100


def test_what_it_writes_needs_no_tidying(tmp_path: Path) -> None:
    run_qgs("new-plugin", "tidy")
    for command in (["check", "--select", "E,F,W,I,UP,B"], ["format", "--check"]):
        ruff = [sys.executable, "-m", "ruff", *command, "--no-cache", "qgs-tidy"]
        done = subprocess.run(ruff, cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout


WORDS = ["no", "on", "yes", "off", "n", "inf", "nan", "e3", "none"]
"""What other readers of YAML take for values."""


@pytest.mark.parametrize("name", ["a", "wide", "far-sighted", "far_sighted", "view2d", *WORDS])
def test_names_that_are_taken_as_they_are(name: str) -> None:
    check_name(name)
    (text,) = [text for path, text in rendered(name) if path.name == "recipe.yaml"]
    assert load_mapping(text, "recipe.yaml", Problems())["plugins"][-1] == name


def test_a_distribution_that_is_installed_is_not_replaced(install: Callable[..., None]) -> None:
    install("qgs-far-sighted", "far-sighted", "", version="2.0")
    with pytest.raises(ValueError, match=r"qgs-far-sighted 2\.0 is installed, which it would"):
        check_name("far_sighted")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("Far Sighted", "did you mean `far-sighted`"),
        ("../escape", "did you mean `escape`"),
        ("2fast", "did you mean `fast`"),
        ("a--b", "did you mean `a-b`"),
        ("", "is no name of a plugin"),
        ("é", "did you mean `e`"),
        ("été", "did you mean `ete`"),
        ("日本", "is no name of a plugin"),
        ("con", "the name of a device on Windows"),
        ("nul", "choose another, such as `nul-things`"),
        ("com1", "the name of a device on Windows"),
        ("a" * 41, "has 41 characters"),
        ("qgs", "leave `qgs` out"),
        ("qgs-more", "leave `qgs` out"),
        ("locus", "taken by query-gaussians-locus"),
        ("null", "would be read as None"),
        ("true", "would be read as True"),
        ("false", "choose another, such as `false-things`"),
        ("1e3", "did you mean `e3`"),
        ("class", "a word of Python's own"),
        ("torch", "a package that is installed here (torch)"),
        ("yaml", "a package that is installed here (PyYAML)"),
        ("json", "a package that is installed here (Python itself)"),
    ],
)
def test_names_that_are_refused(name: str, message: str, tmp_path: Path) -> None:
    result = run_qgs("new-plugin", "--", name)
    assert message in str(result.exception)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", ["folder", "empty folder", "file", "dangling link"])
def test_nothing_is_overwritten(kind: str, tmp_path: Path) -> None:
    place = tmp_path / "mine"
    if kind == "file":
        place.write_text("mine")
    elif kind == "dangling link":
        place.symlink_to("nowhere")
    else:
        place.mkdir()
        if kind == "folder":
            (place / "README.md").write_text("mine")
    before = sorted(map(str, tmp_path.rglob("*")))
    result = run_qgs("new-plugin", "wide", "--out", "mine")
    assert isinstance(result.exception, FileExistsError)
    assert "never overwritten; choose another folder with `--out FOLDER`" in str(result.exception)
    assert sorted(map(str, tmp_path.rglob("*"))) == before


def test_a_place_that_cannot_be_written_is_told_by_the_users_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("")
    result = run_qgs("new-plugin", "wide", "--out", "file/wide")
    assert isinstance(result.exception, OSError)
    assert str(result.exception).startswith("cannot write file/wide: ")

    def refuse(*_: object, **__: object) -> None:
        raise PermissionError(13, "Permission denied", "./.qgs-wide.4m63mcr7")

    monkeypatch.setattr("tempfile.mkdtemp", refuse)
    result = run_qgs("new-plugin", "wide")
    told = "cannot write qgs-wide: Permission denied; choose another folder with `--out FOLDER`"
    assert str(result.exception) == told


def test_home_is_expanded_and_blanks_are_quoted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path / "my home"))
    result = run_qgs("new-plugin", "wide", "--out", "~/wide")
    assert (tmp_path / "my home/wide/pyproject.toml").is_file()
    assert f"  cd '{tmp_path}/my home/wide'\n" in result.output


def test_an_sdist_holds_no_training(tmp_path: Path) -> None:
    run_qgs("new-plugin", "wide")
    folder = tmp_path / "qgs-wide"
    project = tomllib.loads((folder / "pyproject.toml").read_text())
    included = project["tool"]["hatch"]["build"]["targets"]["sdist"]["include"]
    there = {f"/{path.name}" for path in folder.iterdir()} - {"/.gitignore", "/pyproject.toml"}
    assert there <= set(included), "hatchling adds the other two"
    assert not {"/run", "/run/checkpoint.safetensors"} & set(included)


def test_a_folder_appears_whole_or_not_at_all(tmp_path: Path) -> None:
    def fail_halfway() -> None:
        with new_folder(tmp_path / "a" / "new") as fresh:
            (fresh / "half").write_text("")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail_halfway()
    assert list((tmp_path / "a").iterdir()) == []


def test_a_folder_that_appears_meanwhile_is_kept_and_a_new_one_has_the_usual_permissions(
    tmp_path: Path,
) -> None:
    with pytest.raises(FileExistsError), new_folder(tmp_path / "usual"):
        (tmp_path / "usual").mkdir()
    assert list(tmp_path.iterdir()) == [tmp_path / "usual"]
    with new_folder(tmp_path / "new"):
        pass
    modes = {os.stat(tmp_path / name).st_mode for name in ("usual", "new")}
    assert len(modes) == 1


@pytest.mark.parametrize("sink", [-0.5, 1.5])
def test_its_component_computes_its_formula(sink: float) -> None:
    (source,) = [text for path, text in rendered("mine") if path.name == "abstaining.py"]
    names: dict = {}
    exec(source, names)
    attention = names["AbstainingAttention"]
    module = attention(attention.Config(sink_init=sink), ModelDims(16, 2, 1))
    state = QueryState(torch.randn(2, 3, 16))
    keys, values = torch.randn(2, 2, 2, 6, 8)
    memory = ImageMemory(torch.randn(2, 6, 16), keys, values, torch.randn(2, 6, 6), (1, 2, 3))
    logits = module.core.project(state.features) @ keys.transpose(-1, -2) / 8**0.5
    read = logits.exp() @ values / (math.exp(sink) + logits.exp().sum(-1, keepdim=True))
    expected = module.core.out_proj(read.transpose(1, 2).flatten(2))
    torch.testing.assert_close(module(state, memory), expected)
