"""The command `qgs`: makes sure that the package `qgs` is this project's, then runs it.

PyPI's distribution `qgs`, a climate model, installs a top-level package of the same name.
"""

import sys


def main() -> None:
    """Run `qgs.cli`; exit code 1 where the package `qgs` is another project's."""
    import qgs

    if "QueryGaussianModel" not in getattr(qgs, "__all__", ()):
        print(
            f"error: the package `qgs` at {qgs.__file__} is not the one of query-gaussians; PyPI's "
            "`qgs`, a climate model, has the same name. Run `pip uninstall qgs`, then "
            "`pip install --force-reinstall --no-deps query-gaussians`",
            file=sys.stderr,
        )
        raise SystemExit(1)
    from qgs.cli import main as run

    run()
