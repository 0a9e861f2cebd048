"""The command `qgs`, and the refusal to run beside another distribution `qgs`.

PyPI's distribution `qgs`, a climate model, installs a top-level package of the same name.
"""

import sys
from pathlib import Path

REMEDY = (
    "Run `pip uninstall qgs`, then install query-gaussians again from where it came: a wheel with "
    "`pip install --force-reinstall --no-deps WHEEL`, a checkout with `pip install -e .` in it. "
    "The climate model `qgs` needs an environment of its own"
)


def refuse_other_qgs(module: str) -> None:
    """Raise ImportError where a distribution `qgs` is installed beside our package.

    module: the file of `qgs`. By names of files: importing importlib.metadata would take longer
    than all the rest of `import qgs`. Our own distribution was called `qgs` once; what is left of a
    `pip install -e` of it does no harm.
    """
    own_place = Path(module).resolve().parents[1]
    for entry in dict.fromkeys(sys.path):
        for info in Path(entry).glob("qgs-[0-9]*-info"):
            metadata = info / "METADATA"
            former = metadata.is_file() and "splatting" in metadata.read_text("utf-8", "replace")
            if former and info.resolve().parent != own_place:
                continue
            kind = "query-gaussians under its former name" if former else "a climate model"
            raise ImportError(
                f"the distribution `qgs` ({kind}; {info}) is installed beside query-gaussians, and "
                f"both have a package called `qgs`. {REMEDY}"
            )


def main() -> None:
    """Run `qgs.cli`; exit code 1 where another distribution `qgs` is in its place or beside it."""
    try:
        import qgs

        if "QueryGaussianModel" not in getattr(qgs, "__all__", ()):
            raise ImportError(
                f"the package `qgs` at {qgs.__file__} is not the one of query-gaussians; PyPI's "
                f"`qgs`, a climate model, has the same name. {REMEDY}"
            )
    except ImportError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(1) from None
    from qgs.cli import main as run

    run()
