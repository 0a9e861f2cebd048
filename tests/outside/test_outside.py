"""The guide's tutorial as a new user types it, beside wheels of qgs, LocusGS and the tools."""

import re
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import pytest
from guide_pages import BLOCK, text_of
from photo_formats import synthetic, write_nerfstudio
from size import ROOT

pytestmark = pytest.mark.slow

KEPT_BACK = re.compile(
    r"_*(editable_+)?_*(impl_)?(qgs|query_gaussians).*|.*\.pth|pip|pip-.*|__pycache__"
)


def run(environment, command, cwd):
    """Standard output of a bash script in an activated environment; it must end well."""
    activate = f"unset PYTHONPATH; export COLUMNS=200; source {environment}/bin/activate"
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", f"{activate}\n{command}"],
        cwd=cwd,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=900,
    )
    assert done.returncode == 0, f"{command}\n{done.stdout}"
    return done.stdout


@pytest.fixture(scope="module")
def fresh(tmp_path_factory):
    """An environment with qgs, LocusGS, worlds and tools for authors."""
    return environment_with(tmp_path_factory.mktemp("fresh"), "locus", "worlds", "dev")


def environment_with(folder, *plugins):
    """An environment in `folder` with qgs and plug-ins from their wheels.

    Installing torch again would take minutes. All packages of the present environment but qgs and
    its plugins are lent through a folder of links, so that qgs can only come from its wheel.
    Whether the wheels require what they import cannot be seen there: tools/lint.
    """
    wheels = folder / "wheels"
    build = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--wheel-dir", str(wheels)]
    sources = (str(ROOT / "plugins" / name) for name in plugins)
    subprocess.run([*build, str(ROOT), *sources], check=True)
    environment = folder / "venv"
    venv.create(environment, with_pip=True)
    run(environment, "pip uninstall -q -y setuptools", folder)  # torch wants a newer one: the lent
    _lend_packages(folder)
    run(environment, f"pip install -q --no-index {wheels}/*.whl", folder)
    return environment


def _lend_packages(folder):
    lent = folder / "lent"
    lent.mkdir()
    for site in {sysconfig.get_path("purelib"), sysconfig.get_path("platlib")}:
        for entry in Path(site).iterdir():
            if not KEPT_BACK.fullmatch(entry.name) and not (lent / entry.name).exists():
                (lent / entry.name).symlink_to(entry)
    (own,) = (folder / "venv").glob("lib/python*/site-packages")
    (own / "lent.pth").write_text(f"{lent}\n")


ORIGIN = """
import pathlib, qgs, qgs_locus, qgs_dev
print(*{pathlib.Path(x.__file__).parents[1] for x in (qgs, qgs_locus, qgs_dev)})
"""


def test_qgs_and_its_recipes_come_from_its_wheel(fresh, tmp_path):
    (origin,) = run(fresh, f'python -c "{ORIGIN}"', tmp_path).split()
    assert Path(origin).is_relative_to(fresh)
    assert not list(fresh.rglob("tests/test_recipes.py"))  # nothing of the source tree
    assert "tiny/locus.yaml" in run(fresh, "qgs recipes", tmp_path)
    assert f"{fresh}" in run(fresh, "qgs compose rooms/locus_64.yaml", tmp_path)
    run(fresh, "qgs recipes rooms/locus_64.yaml --out mine", tmp_path)
    assert f"{fresh}" not in run(fresh, "qgs compose mine/rooms/locus_64.yaml", tmp_path)


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


def test_every_command_of_the_tutorial(fresh, tmp_path):
    script = "".join(script_of(text_of("plugin.md")))
    assert SHORTER in script
    output = run(fresh, f"set -x\n{script}", tmp_path)
    folder = tmp_path / "qgs-sightline"
    assert (folder / "run/checkpoint.safetensors").is_file()
    assert list((folder / "dist").glob("qgs_sightline-*.whl"))
    assert "sightline/charbonnier" in output
    run(fresh, "pip uninstall -q -y qgs-sightline", tmp_path)


LOCUS_ALONE = f"""
qgs train tiny/locus_alone.yaml --out run --set data.path=photos {SHORTER}
qgs eval run --set evaluation.scenes=1
qgs reconstruct run photos --out scene
"""


def test_locus_alone_trains_evaluates_and_reconstructs(tmp_path):
    write_nerfstudio(tmp_path / "photos", synthetic(tmp_path / "noise", 12, (64, 64)))
    run(environment_with(tmp_path / "alone", "locus"), LOCUS_ALONE, tmp_path)
    assert list((tmp_path / "scene").glob("*.ply"))
