"""Damage checkpoints and training states in many ways, and see that each is used or refused well.

    python tools/fuzz_files.py --count 3000 --seed 0

    python tools/fuzz_files.py --seed 0 --only 17

A checkpoint is loaded and made into Gaussians, a state is trained on; see fuzzing.py.
"""

import json
import random
import shutil
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from fuzzing import JUNK, FaultError, Use, fuzz, other_bytes, other_leaf, refused
from kill_training import RECIPE
from rich.console import Console

import qgs
from qgs.composer import Recipe, resolve
from qgs.contracts import LearnedQueries
from qgs.data.domain import Domain, verdict
from qgs.engine.guard import OutOfMemoryError, TrainingError
from qgs.engine.training import train
from qgs.io.checkpoint import CheckpointFile
from qgs.io.gaussians import save_ply

STEPS = 2
LARGE = {
    "model.width": (4096, 65536, 10**9),
    "model.queries.count": (10**5, 10**8, 10**18, 10**30),
    "model.head.gaussians_per_query": (10**4, 10**6, 10**12, 10**18),
    "model.encoder.depth": (256, 10**4, 10**9),
    "model.decoder.depth": (100, 10**4, 10**9),
    "model.heads": (3, 10**9),
    "views.targets": (10**6, 10**9),
    "training.batch_size": (10**6, 10**12),
    "data.image_size": ([8 * 10**5] * 2, [10**9] * 2, [0, 0]),
}
TYPES = ("F64", "F16", "BF16", "I64", "I32", "U32", "I16", "I8", "U8", "BOOL", "F8_E4M3", "F99", "")


@dataclass
class File:
    """A safetensors file, taken apart: what its header says of each tensor, metadata, bytes.

    header: what is written instead of the first two.
    """

    tensors: dict[str, Any]
    metadata: Any
    data: bytearray
    header: bytes = b""

    @classmethod
    def read(cls, path: Path) -> "File":
        """The file at `path`."""
        whole = path.read_bytes()
        end = 8 + int.from_bytes(whole[:8], "little")
        header = json.loads(whole[8:end])
        return cls(header, header.pop("__metadata__"), bytearray(whole[end:]))

    def bytes(self) -> bytes:
        """What `read` would take apart."""
        header = self.header or json.dumps({"__metadata__": self.metadata, **self.tensors}).encode()
        return len(header).to_bytes(8, "little") + header + self.data


def a_tensor(file: File, dice: random.Random) -> tuple[str, dict[str, Any]]:
    return dice.choice(list(file.tensors.items()))


def other_type(file: File, dice: random.Random) -> None:
    one = dice.random() < 0.5
    kind, chosen = dice.choice(TYPES), [a_tensor(file, dice)[1]]
    for entry in chosen if one else file.tensors.values():
        entry["dtype"] = "I32" if not one and entry["dtype"] == "F32" else kind


def other_shape(file: File, dice: random.Random) -> None:
    _, entry = a_tensor(file, dice)
    shape = entry["shape"]
    large = [n * 2**40 for n in shape] or [2**62]
    changes = (shape[::-1], [*shape, 1], [1, *shape], [-n for n in shape], large, [0, *shape])
    more = [2**33, 2**33, *shape], [torch.Size(shape).numel()], dice.choice(JUNK)
    entry["shape"] = dice.choice((*changes, *more))


def cut_rows(file: File, dice: random.Random) -> None:
    """Some tensors to their first row, so that the file is whole and they would broadcast."""
    entries = [e for e in file.tensors.values() if len(e["shape"]) > 1 or dice.random() < 0.2]
    rows = dice.choice((0, 1, 1, 2))
    kept, data = {id(e) for e in dice.sample(entries, dice.randint(1, 3))}, bytearray()
    for entry in file.tensors.values():
        first, last = entry["data_offsets"]
        if id(entry) in kept and entry["shape"]:
            last = first + (last - first) // max(entry["shape"][0], 1) * rows
            entry["shape"] = [rows, *entry["shape"][1:]]
        entry["data_offsets"] = [len(data), len(data) + last - first]
        data += file.data[first:last]
    file.data = data


def other_offsets(file: File, dice: random.Random) -> None:
    _, entry = a_tensor(file, dice)
    first, last = entry["data_offsets"]
    entry["data_offsets"] = dice.choice(
        ([last, first], [first, 2**63], [-1, last], [0, last], dice.choice(JUNK), [first + 4, last])
    )


def other_name(file: File, dice: random.Random) -> None:
    name, entry = a_tensor(file, dice)
    news = ("foo", "", "/", "weights/", f"{name}x", "a/b/c/d", "x" * 10_000, name.upper(), "\u20ac")
    file.tensors[dice.choice(news)] = file.tensors.pop(name)
    if dice.random() < 0.3:
        other, _ = a_tensor(file, dice)
        file.tensors[name] = file.tensors.pop(other)
    if dice.random() < 0.2:
        file.tensors[name] = entry


def other_values(file: File, dice: random.Random) -> None:
    _, entry = a_tensor(file, dice)
    first, last = entry["data_offsets"]
    bad = dice.choice((b"\xff\xff\xff\xff", b"\x00\x00\x80\x7f", b"\x00\x00\xc0\x7f"))
    if last - first >= 4:
        place = first + dice.randrange((last - first) // 4) * 4
        file.data[place : place + 4] = bad


def other_metadata(file: File, dice: random.Random) -> None:
    key = dice.choice(list(file.metadata))
    text = file.metadata[key]
    deep = dice.choice(("[", '{"a":')) * 5000
    junk = json.dumps(dice.choice(JUNK))
    cut = text[: dice.randrange(len(text) + 1)]
    file.metadata[key] = dice.choice((cut, deep, junk, "null", "", text + text, "1e999", "-5"))
    if dice.random() < 0.2:
        del file.metadata[key]
    if dice.random() < 0.05:
        file.metadata = dice.choice(({}, [], None, {"a": 1}, {key: 5}))


def other_value_of_json(file: File, dice: random.Random) -> None:
    """A leaf, or a branch, of the JSON in the metadata."""
    trees = {k: json.loads(v) for k, v in file.metadata.items() if v[:1] in "{["}
    key = dice.choice(list(trees))
    other_leaf(trees[key], dice)
    file.metadata[key] = json.dumps(trees[key])


def larger(file: File, dice: random.Random) -> None:
    """Sizes in the recipe that no tensor has, or that no machine holds."""
    tree = json.loads(file.metadata["qgs.recipe"])
    for path in dice.sample(list(LARGE), dice.randint(1, 2)):
        *parents, option = path.split(".")
        below = tree
        for parent in parents:
            below = below[parent]
        below[option] = dice.choice(LARGE[path])
    file.metadata["qgs.recipe"] = json.dumps(tree)


def other_recipe(file: File, dice: random.Random) -> None:
    recipes = (
        {"extends": "/etc/passwd"}, {"extends": "/dev/zero"}, {"recipe": 1}, {"recipe": 99},
        {"recipe": 1, "plugins": ["nobody"]}, {"recipe": 1, "swap": {"*": {"type": "qgs/none"}}},
        ["recipe"], "/etc/passwd", "/dev/zero", 7,
    )  # fmt: skip
    tree, new = json.loads(file.metadata["qgs.recipe"]), dice.choice(recipes)
    joined = {**tree, **new} if isinstance(new, dict) and dice.random() < 0.5 else new
    file.metadata["qgs.recipe"] = json.dumps(joined)


def other_header(file: File, dice: random.Random) -> None:
    """JSON with keys twice, other spaces, other encodings, or more than JSON."""
    text = json.dumps({"__metadata__": file.metadata, **file.tensors})
    name, entry = a_tensor(file, dice)
    twice = f"{{{json.dumps(name)}: {json.dumps(dice.choice((entry, {}, None)))}, {text[1:]}"
    file.header = dice.choice((
        *(twice.encode(), text.encode() + b" " * dice.choice((1, 8, 10**6)), b" " + text.encode()),
        *(text.encode("utf-16"), text.encode("utf-8-sig"), text.encode() * 2),
        text.encode() + b"\0",
        *(text.replace("[", "[NaN, ", 1).encode(), b"[" * 100_000, b"{}", b"\xff" + text.encode()),
    ))  # fmt: skip


CHANGES = (
    other_type, other_shape, cut_rows, other_offsets, other_name, other_values, other_metadata,
    other_value_of_json, other_value_of_json, larger, other_recipe, other_header,
)  # fmt: skip


def damage(path: Path, dice: random.Random) -> str:
    """Change the file in one way, rarely in two; the names of the ways."""
    if dice.random() < 0.12:
        return other_bytes(path, dice)
    names = []
    for change in dice.choices(CHANGES, k=dice.choice((1, 1, 1, 2))):
        try:
            change(file := File.read(path), dice)
        except (TypeError, KeyError, ValueError, IndexError, AttributeError, RecursionError):
            continue  # on top of another change
        path.write_bytes(file.bytes())
        names.append(change.__name__)
    return "+".join(names)


def small(steps: int) -> Recipe:
    sizes = ("model.width=16", "model.heads=2", "model.queries.count=8", "data.samples=1")
    parts = ("model.decoder.depth=2", "model.supervision.layers=[2]", "data.image_size=[16, 16]")
    training = (f"training.steps={steps}", "training.seconds=null", "optimizer.warmup=1")
    return resolve(RECIPE, [*sizes, *parts, *training, "training.ema=0.9", "evaluation.scenes=1"])


def use_checkpoint(checkpoint: Path) -> None:
    model = qgs.load(checkpoint)
    assert isinstance(model.queries, LearnedQueries)
    with torch.no_grad():
        gaussians = model.decode(model.queries.start(1))
    save_ply(gaussians, checkpoint.with_suffix(".ply"))
    with CheckpointFile(checkpoint) as file:
        _ = file.step, verdict(file.domain, Domain())


def start_from(checkpoint: Path) -> None:
    recipe = resolve(small(2).tree, [f"init_from={checkpoint}"])
    train(recipe, checkpoint.parent / "other", console=Console(quiet=True), device="cpu")


def resume(file: Path) -> None:
    train(small(STEPS + 1), file.parent, console=Console(quiet=True), device="cpu", resume=True)


USES = (
    *(("checkpoint", use) for use in (use_checkpoint, use_checkpoint, start_from, resume)),
    *(("state", resume),) * 4,
)


def judged(use: Callable[[Path], None], path: Path) -> str:
    """How the use of a file ends. Raises what nobody should see."""
    try:
        use(path)
    except OutOfMemoryError as error:
        raise FaultError(f"allocates before it checks: {error}") from error
    except (ValueError, OSError, TrainingError) as error:
        return f"{path.stem} {refused(error, str(path))}"
    return f"{path.stem} success"


def prepared(scratch: Path) -> Callable[[random.Random, Path], tuple[str, Use]]:
    """Train a small model; cases are copies of its run."""
    train(small(STEPS), scratch / "run", console=Console(quiet=True), device="cpu")

    def case_in(dice: random.Random, folder: Path) -> tuple[str, Use]:
        shutil.copytree(scratch / "run", folder, dirs_exist_ok=True)
        kind, use = dice.choice(USES)
        path = folder / f"{kind}.safetensors"
        return f"{use.__name__} {kind}, {damage(path, dice)}", partial(judged, use, path)

    return case_in


if __name__ == "__main__":
    sys.exit(fuzz(__doc__, prepared))
