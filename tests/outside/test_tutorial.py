"""The guide's tutorial, every file and every command of it, as a new user would type them."""

import pytest
from guide_pages import BLOCK, text_of

TRAINING = "qgs train recipe.yaml --out run"
ONE_SCENE = " --set evaluation.scenes=1"
SHORTER = " --set training.steps=3 --set optimizer.warmup=1" + ONE_SCENE
STEPS = "training.steps=50"


def script_of(page):
    """The tutorial as a bash script; files to write are here-documents, other files are shown."""
    for kind, title, text in BLOCK.findall(page):
        verb, colon, path = title.partition(": ")
        if kind == "bash":
            yield text.replace(TRAINING, TRAINING + SHORTER).replace(STEPS, STEPS + ONE_SCENE)
        elif colon:
            yield f"test {'-e' if verb == 'change' else '! -e'} {path}\n"
            yield f"cat > {path} <<'END OF FILE'\n{text}END OF FILE\n"


@pytest.mark.slow
def test_every_command_of_the_tutorial(fresh, tmp_path):
    script = "".join(script_of(text_of("plugin.md")))
    assert SHORTER in script
    output = fresh.run(f"set -x\n{script}", tmp_path, timeout=900)
    folder = tmp_path / "qgs-sightline"
    assert (folder / "run/checkpoint.safetensors").is_file()
    assert list((folder / "dist").glob("qgs_sightline-*.whl"))
    assert "sightline/frustum" in output
    fresh.run("pip uninstall -q -y qgs-sightline", tmp_path)
