from qgs.wording import short_names


def test_short_names_tell_models_and_recipes_apart(tmp_path):
    assert short_names(["a/tiny/x.yaml", "a/tiny/y.yaml"]) == ["x", "y"]
    assert short_names(["a/tiny/x.yaml", "a/big/x.yaml"]) == ["tiny/x", "big/x"]
    assert short_names([tmp_path / "x.yaml"] * 3) == ["x", "x (2)", "x (3)"]
    assert short_names(["rooms/locus-1.5", "rooms/locus-64"]) == ["locus-1.5", "locus-64"]
    runs = ["runs/a/checkpoint.safetensors", "runs/b"]
    assert short_names(runs) == ["a/checkpoint", "b"]
    assert short_names(["mine.safetensors", "aa/mine.safetensors"]) == ["mine", "aa/mine"]
