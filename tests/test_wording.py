from qgs.wording import short_names

NAMES = """
a/tiny/x.yaml a/tiny/y.yaml = x y
a/tiny/x.yaml a/big/x.yaml = tiny/x big/x
rooms/locus-1.5 rooms/locus-64 = locus-1.5 locus-64
runs/a/checkpoint.safetensors runs/b = a/checkpoint b
mine.safetensors aa/mine.safetensors = mine aa/mine
"""


def test_short_names_tell_models_and_recipes_apart(tmp_path):
    for line in NAMES.strip().splitlines():
        given, short = line.split(" = ")
        assert short_names(given.split()) == short.split()
    assert short_names([tmp_path / "x.yaml"] * 3) == ["x", "x (2)", "x (3)"]
