"""`qgs` as a user types it, a recipe of one layer, and overrides that make recipes small."""

import yaml
from tables import read_json
from typer.testing import CliRunner

import qgs
from qgs.cli import app

ONE_LAYER = yaml.safe_load("""
recipe: 1
model:
  width: 16
  heads: 2
  encoder: {type: qgs/multiview_vit, patch_size: 8, depth: 1}
  queries: {type: qgs/latent, count: 8, std: 1.0}
  decoder: {depth: 1}
  head: {type: qgs/gaussian_head, gaussians_per_query: 4}
  supervision: {type: qgs/layers, layers: [1]}
""")
SMALL = ("model={width: 16, heads: 2, queries: {count: 8}}",)


def run_qgs(line, *words, **options):
    """What a line without quotes gives, and words with blanks behind it."""
    return CliRunner().invoke(app, [*line.split(), *map(str, words)], **options)


def done(*words):
    """The result of a command that must end well."""
    result = run_qgs(*words, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result


def saved(file, kind, **data):
    """A model of data of such a kind, in `file`."""
    overrides = [
        "plugins=[rooms]",
        "views={inputs: 2, targets: 2, gap: [2, 4], scale: constant}",
        f"data={{type: {kind}, image_size: [16, 16]}}",
        *(f"data.{name}={value}" for name, value in data.items()),
    ]
    qgs.save(qgs.compose(ONE_LAYER, overrides), file)
    return file


def record_of(folder):
    """What `qgs reconstruct` and `qgs refine` say of a result."""
    return read_json(folder / "cameras.json")


def sets(*overrides):
    """The words of a command that make SMALL and these overrides."""
    return [word for setting in (*SMALL, *overrides) for word in ("--set", setting)]
