"""A fresh virtual environment with qgs, LocusGS, worlds and tools for authors from their wheels.

Installing torch again for every test would take minutes. All packages of the present environment
but qgs and its plugins are lent through a folder of links, so that qgs can only come from its
wheel. Whether the wheels require what they import cannot be seen there: tools/lint.
"""

import re
import subprocess
import sys
import sysconfig
import venv
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
KEPT_BACK = re.compile(
    r"_*(editable_+)?_*(impl_)?(qgs|query_gaussians).*|.*\.pth|pip|pip-.*|__pycache__"
)


@dataclass(frozen=True)
class FreshEnvironment:
    """A virtual environment at `folder`."""

    folder: Path

    def run(self, command, cwd, timeout=600):
        """Standard output of a bash script in the activated environment; it must end well."""
        activate = f"unset PYTHONPATH; export COLUMNS=200; source {self.folder}/bin/activate"
        done = subprocess.run(
            ["bash", "-euo", "pipefail", "-c", f"{activate}\n{command}"],
            cwd=cwd,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            timeout=timeout,
        )
        assert done.returncode == 0, f"{command}\n{done.stdout}"
        return done.stdout


def make_fresh_environment(folder):
    """Build the wheels of qgs and three plugins and install them into a new environment."""
    wheels = folder / "wheels"
    build = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "--wheel-dir", str(wheels)]
    plugins = (str(ROOT / "plugins" / name) for name in ("locus", "worlds", "dev"))
    subprocess.run([*build, str(ROOT), *plugins], check=True)
    venv.create(folder / "venv", with_pip=True)
    environment = FreshEnvironment(folder / "venv")
    environment.run("pip uninstall -q -y setuptools", folder)  # torch wants a newer one: the lent
    _lend_packages(folder)
    environment.run(f"pip install -q --no-index {wheels}/*.whl", folder)
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
