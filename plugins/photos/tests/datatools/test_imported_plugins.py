"""Commands import the plugins that are asked for; those that import all say so."""

import re
import sys

from commands import run_qgs
from qgs_photos.datatools.candidates import sources
from tables import rows

ALL = """
list: list
list queries: list
schema: schema
data check photos: data check
data pack photos --out chunks: data pack
"""
"""Commands that import every plugin, and where they say so."""
SOME = """
list qgs/latent
list rooms/locus-64
compose recipe.yaml
recipes
eval absent.safetensors
data check photos --format nerfstudio
data check photos --format rooms/absent
data pack recipe.yaml --out chunks
--help
data check --help
"""


def test_commands_import_the_plugins_that_are_asked_for(install, here):
    source = "from qgs.contracts import Plugin\nplugin = Plugin('marked', 1, ())"
    install("marked", "marked", source)
    (here / "recipe.yaml").write_text("recipe: 1\nmodel: {}")
    (here / "photos/other").mkdir(parents=True)
    (here / "photos/transforms.json").write_text("{}")
    helps = dict(rows(ALL, ": "))
    imported = []
    for words in (*helps, *SOME.strip().splitlines()):
        sources.cache_clear()
        run_qgs(words)
        if sys.modules.pop("_test_marked", None):
            imported.append(words)
    sources.cache_clear()
    assert imported == [*helps]
    for command in helps.values():
        words = re.findall(r"\w+", run_qgs(f"{command} --help").output)
        assert re.search("imports every|plugins are imported", " ".join(words))
