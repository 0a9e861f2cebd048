"""The guide's tutorial, every file and every command of it, as a new user would type them."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from fresh_environment import ROOT, FreshEnvironment

pytestmark = pytest.mark.slow

BLOCK = re.compile(r'^```(\w+)(?: title="([^"]*)")?\n(.*?)^```$', re.DOTALL | re.MULTILINE)
TRAINING = "qgs train recipe.yaml --out run"
ONE_SCENE = " --set evaluation.scenes=1"
SHORTER = " --set training.steps=3 --set optimizer.warmup=1" + ONE_SCENE
STEPS = "training.steps=50"


def script_of(page: str) -> Iterator[str]:
    """The tutorial as a bash script; files to write are here-documents, other files are shown."""
    for kind, title, text in BLOCK.findall(page):
        verb, colon, path = title.partition(": ")
        if kind == "bash":
            yield text.replace(TRAINING, TRAINING + SHORTER).replace(STEPS, STEPS + ONE_SCENE)
        elif colon:
            yield f"test {'-e' if verb == 'change' else '! -e'} {path}\n"
            yield f"cat > {path} <<'END OF FILE'\n{text}END OF FILE\n"


def test_every_command_of_the_tutorial(fresh: FreshEnvironment, tmp_path: Path) -> None:
    page = (ROOT / "docs/plugin.md").read_text(encoding="utf-8")
    assert TRAINING in page
    output = fresh.run("set -x\n" + "".join(script_of(page)), tmp_path, timeout=900)
    folder = tmp_path / "qgs-sightline"
    assert (folder / "run/checkpoint.safetensors").is_file()
    assert list((folder / "dist").glob("qgs_sightline-*.whl"))
    assert "sightline/frustum" in output
    fresh.run("pip uninstall -q -y qgs-sightline", tmp_path)
