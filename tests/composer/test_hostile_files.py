"""What no recipe does to whoever resolves it: hang, fill memory, hide where its mistake is."""

import json
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from refusals import refused

from qgs.components import LatentQueries
from qgs.composer import RecipeError, RecipeProblem, places, resolve
from qgs.composer.errors import MAX_PROBLEMS
from qgs.composer.files import MAX_BYTES, MAX_EXTENDS
from qgs.composer.places import near_pattern
from qgs.composer.recipe import annotated

Write = Callable[..., Path]


def extending(name: str, write: Write) -> RecipeProblem:
    """The problem of a recipe that extends `name`, found in a second."""
    began = time.process_time()
    problem = refused(write(f"recipe: 1\nextends: {name}\n", "first.yaml"))
    assert time.process_time() - began < 1
    assert (problem.file, problem.line, problem.option) == ("first.yaml", 2, "extends")
    assert len(str(problem)) < 1000
    return problem


@pytest.mark.parametrize(
    ("name", "what"),
    [
        ("/dev/zero", "a device or a pipe, no regular file"),
        ("fifo", "a device or a pipe, no regular file"),
        (".", "a folder; a recipe is a .yaml file, of a run its recipe.yaml"),
    ],
)
def test_nothing_but_a_regular_file_is_opened(name: str, what: str, write: Write) -> None:
    write("", "empty.yaml")
    os.mkfifo("fifo")
    assert extending(name, write).reason == f"{name} cannot be read: it is {what}"


def test_links_in_a_circle(write: Write) -> None:
    write("", "empty.yaml")
    Path("a.yaml").symlink_to("b.yaml")
    Path("b.yaml").symlink_to("a.yaml")
    assert "symbolic links" in extending("a.yaml", write).reason


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        (r'"a\0b"', r"'a\x00b' holds a NUL character"),
        (r'"a\ud800b"', r"'a\ud800b' holds half of a surrogate pair, which is no character"),
        ("x" * 3000, f"{'x' * 150} ... {'x' * 150} (3,000 characters) cannot be read: File name "),
    ],
)
def test_names_that_no_file_has(name: str, reason: str, write: Write) -> None:
    assert extending(name, write).reason.startswith(reason)


@pytest.mark.parametrize("text", ['model: {queries: {"k\\0": 1}}', 'init_from: "a\\ud800"'])
def test_no_string_of_a_recipe_holds_what_no_file_does(text: str, write: Write) -> None:
    problem = refused(write(f"recipe: 1\n{text}\n"))
    assert problem.line == 2
    assert "holds" in problem.reason
    assert str(problem).replace("\n", "").isprintable()


def test_each_file_is_read_once(write: Write) -> None:
    write("recipe: 1\nseed: 7\n", "0.yaml")
    for n in range(18):
        write(f"extends: [{n}.yaml, ./{n}.yaml]\n", f"{n + 1}.yaml")
    assert resolve("18.yaml").seed == 7


def test_a_long_chain_is_refused(write: Write) -> None:
    for n in range(1000):
        write(f"recipe: 1\nextends: {n + 1}.yaml\n", f"{n}.yaml")
    problem = refused("0.yaml")
    assert (problem.file, problem.line) == (f"{MAX_EXTENDS}.yaml", 2)
    assert f"name more than {MAX_EXTENDS} files" in problem.reason


def test_files_have_a_size_together(write: Write) -> None:
    comment = "#" * (MAX_BYTES // 2 + 1) + "\n"
    write(comment + "seed: 1", "a.yaml")
    write(comment + "seed: 2", "b.yaml")
    assert resolve(write("recipe: 1\nextends: a.yaml\n")).seed == 1
    problem = refused(write("recipe: 1\nextends: [a.yaml, b.yaml]\n"))
    assert problem.reason.endswith("the files of a recipe have 256 KiB at most, all together")


def test_values_are_counted_over_files_and_overrides(write: Write) -> None:
    write(f"seed: [{'1, ' * 9000}1]\n", "a.yaml")
    write(f"extends: a.yaml\ninit_from: [{'1, ' * 9000}1]\n", "b.yaml")
    problem = refused("b.yaml", [f"training.steps=[{'1, ' * 9000}1]"])
    assert (problem.file, problem.option) == ("--set #1", "training.steps")
    assert "more than 20,000 values" in problem.reason


@pytest.mark.parametrize(
    ("value", "reason"),
    [
        ("x" * 100_000, "(100,002 characters)"),
        (10**400, "an integer does not fit into 64 bits"),
        ("\ud800", "half of a surrogate pair"),
        (object(), "a recipe holds no object"),
        (b"bytes", "a recipe holds no bytes"),
    ],
)
def test_values_of_a_mapping_that_no_file_holds(value: Any, reason: str) -> None:
    problem = refused({"recipe": 1, "model": {"queries": {"count": value}}})
    assert (problem.file, problem.option) == ("<mapping>", "model.queries.count")
    assert reason in problem.reason
    assert len(problem.reason) < 300


def test_mappings_nested_as_deep_as_python_allows() -> None:
    deep: Any = 1
    for _ in range(900):
        deep = {"a": deep}
    assert "more than 64 deep" in refused({"recipe": 1, "model": deep}).reason


def test_an_override_of_a_path_nested_too_deep(write: Write) -> None:
    problem = refused(write("recipe: 1\n"), [".".join("a" * 5000) + "=1"])
    assert problem.file == "--set #1"
    assert len(str(problem)) < 600


@pytest.mark.parametrize("section", ["model", "model: {queries", "optimizer"])
def test_no_more_problems_are_told_than_anybody_reads(section: str, write: Write) -> None:
    """Problems of a section, of a component's options, and of another's: not a plugin's fault."""
    keys = ", ".join(f"k{n}: 1" for n in range(5000))
    recipe = write(f"recipe: 1\n{section}: {{{keys}}}" + "}" * section.count("{"))
    with pytest.raises(RecipeError, match="50 problems in the recipe, and perhaps more") as caught:
        resolve(recipe)
    assert len(caught.value.problems) == MAX_PROBLEMS
    assert all(problem.cause is None for problem in caught.value.problems)


def test_control_characters_do_not_reach_a_terminal(write: Write) -> None:
    problem = refused(write('recipe: 1\n"\\e[2Jk": 1\n'))
    assert r"\x1b[2Jk" in problem.reason
    assert str(problem).replace("\n", "").isprintable()


def test_a_recipe_without_losses_is_a_recipe(write: Write) -> None:
    dropped = "losses: {photometric: null, visibility: null}"
    for text in ("losses: {}", "losses: null", dropped):
        recipe = resolve(write(f"recipe: 1\n{text}\nmetrics: {{psnr: null}}\n"))
        shown = annotated(recipe)
        assert resolve(write(shown, "again.yaml")).tree == recipe.tree
        assert (recipe.build_losses() == {}) == (text != "losses: null")


@pytest.mark.parametrize("losses", [300, 800, 1500])
def test_what_resolves_is_read_again_as_a_run_has_it(losses: int, write: Write) -> None:
    """With long values and many, whose defaults are written out with comments."""
    many = {f"n{number}": {"type": "qgs/visibility"} for number in range(losses)}
    tree = {"recipe": 1, "init_from": "x" * 9000, "losses": many}
    if losses == 1500:
        problem = refused(tree, by=resolve)
        assert "with every option written out, there are more than 20,000 values" in problem.reason
        return
    recipe = resolve(tree)
    assert resolve(write(annotated(recipe))).tree == recipe.tree
    assert resolve(json.loads(json.dumps(recipe.tree))).tree == recipe.tree


@pytest.mark.parametrize(
    ("error", "told"),
    [
        (MemoryError("no room"), MemoryError),
        (RuntimeError("DefaultCPUAllocator: can't allocate memory"), RuntimeError),
        (ValueError("stack overflow in a component"), ValueError),
    ],
)
def test_what_is_no_size_is_not_told_as_one(
    error: Exception, told: type, write: Write, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object) -> None:
        raise error

    recipe = resolve(write("recipe: 1\n"))
    monkeypatch.setattr(LatentQueries, "__init__", fails)
    with pytest.raises(told) as caught:
        recipe.build_model("meta")
    assert caught.value is error


@pytest.mark.parametrize("option", ["encoder.mlp_ratio", "queries.count"])
def test_tensors_that_no_machine_holds_are_told_by_their_place(option: str, write: Write) -> None:
    recipe = resolve(write("recipe: 1\n"), [f"model.{option}={2**62}"])
    problem = refused("meta", by=recipe.build_model)
    assert problem.option == f"model.{option.split('.')[0]}"
    assert "tensors that no machine can hold" in problem.reason


def test_layers_are_compared_as_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Comparing a pattern with the names of each of hundreds of layers takes seconds."""
    slots = ("cross_attention", "self_attention")
    paths = [("model", "decoder", "layers", str(n), slot) for n in range(256) for slot in slots]
    seen: list[int] = []
    known = places.nearest
    monkeypatch.setattr(
        places, "nearest", lambda word, names: seen.append(len(names)) or known(word, names)
    )
    for given, near in (("7", "7"), ("300", "*"), ("*", "*")):
        fix = near_pattern(f"decoder.layers.{given}.cros_attention", paths)
        assert fix == f"did you mean `decoder.layers.{near}.cross_attention`?"
    assert seen == [2, 2, 2]
