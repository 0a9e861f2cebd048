"""Each distribution requires what it imports, and nothing else: deptry's rules."""

import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import qgs

ROOT = Path(__file__).parents[1]
PLUGINS = sorted(file.parent.name for file in ROOT.glob("plugins/*/pyproject.toml"))
MODULES = {
    "pillow": "PIL",
    "pyyaml": "yaml",
    "query-gaussians": "qgs",
    "scikit-image": "skimage",
    "universal-pathlib": "upath",
    **{f"query-gaussians-{name}": f"qgs_{name}" for name in PLUGINS},
}
"""Of distributions whose module is named otherwise."""
# Imported by name, or by accelerate and fsspec.
BY_NAME = ("gsplat", "huggingface_hub", "lpips", "tensorboard", "wandb")
IGNORED = f"DEP002={'|'.join(BY_NAME)},DEP003=pydantic_core|mpl_toolkits,DEP004=pytest"


def check(project: Path, *roots: str, ignored: str = IGNORED, dev: str = "docs,test") -> None:
    modules = ",".join(f"{name}={module}" for name, module in MODULES.items())
    command = [sys.executable, "-m", "deptry", *roots, "--config", str(project / "pyproject.toml")]
    command += ["--package-module-name-map", modules, "--per-rule-ignores", ignored, "--no-ansi"]
    command += ["--optional-dependencies-dev-groups", dev, "--exclude", "no folder"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr + done.stdout


def test_the_core() -> None:
    check(ROOT, "qgs", "--known-first-party", "qgs")


@pytest.mark.parametrize("name", PLUGINS)
def test_a_plugin(name: str) -> None:
    check(ROOT / "plugins" / name, f"plugins/{name}/src")


def test_tests_and_tools() -> None:
    """They need the extra `test`, and all distributions of this repository."""
    ours = [w for name in ("qgs", *MODULES.values()) for w in ("--known-first-party", name)]
    folders = [f"plugins/{name}/tests" for name in PLUGINS]
    existing = [folder for folder in folders if (ROOT / folder).is_dir()]
    check(ROOT, "tests", "tools", *existing, *ours, "--ignore", "DEP002", dev="none")


def test_messages_name_the_distributions_of_this_repository() -> None:
    offered: dict[str, dict[str, str]] = {}
    for name in PLUGINS:
        file = ROOT / "plugins" / name / "pyproject.toml"
        project = tomllib.loads(file.read_text(encoding="utf-8"))["project"]
        for group, entries in project["entry-points"].items():
            offered.setdefault(group, {}).update(dict.fromkeys(entries, project["name"]))
    assert {group: offered[group] for group in qgs.DISTRIBUTIONS} == qgs.DISTRIBUTIONS
