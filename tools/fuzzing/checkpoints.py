"""Checkpoints, PLY and .splat files, damaged in many ways: each is used, or refused by its name.

Each file must be used without an error, or refused by an error that names the file. In half of the
checkpoints the checksum of the metadata is updated after the damage, as an attacker would do. If a
checkpoint with a wrong checksum is used, it must give the numbers of the undamaged file. Tensors
have no checksum.
"""

import json
import random
from collections.abc import Callable
from functools import partial
from pathlib import Path
from random import choice, randrange
from typing import Any

import numpy as np
import torch
from safetensors.torch import save

import qgs
from fuzzing.cases import JUNK, TABLES, FaultError, Use, other_bytes, other_leaf, refused
from qgs.checkpoint.model_file import CheckpointFile
from qgs.checkpoint.tensors import SEAL, seal
from qgs.contracts import LearnedQueries
from qgs.recipe import resolve
from qgs.reconstruction.scene_formats import save_splat
from qgs.train.initial import initialise

RECIPE = "tiny/locus.yaml"
SMALL = TABLES["small"].split()


def other_tensor(header: Any, data: bytearray) -> None:
    """Change the type, shape, position, name or values of a random tensor."""
    name = choice([key for key in header if key != "__metadata__"])
    entry = header[name]
    shape = entry["shape"]
    first, last = entry["data_offsets"]
    shapes = (shape[::-1], [*shape, 1], [0, *shape], [n * 2**40 for n in shape], [2**62])
    places = ([last, first], [first, 2**63], [-1, last], [0, last], [first + 4, last])
    entry |= choice(
        (
            {},
            {"dtype": choice(TABLES["dtype"])},
            {"shape": choice((*shapes, [-n for n in shape], choice(JUNK)))},
            {"data_offsets": choice((*places, choice(JUNK)))},
        )
    )
    if random.random() < 0.2:
        header[choice((*TABLES["name"], f"{name}x"))] = header.pop(name)
    # NaN, infinity, or anything.
    data[first : first + 4] = choice((b"\xff" * 4, b"\x00\x00\x80\x7f", random.randbytes(4)))


def other_metadata(header: Any, _: bytearray) -> None:
    """Replace an entry of the metadata, or a value in its JSON, by a random value."""
    metadata = header["__metadata__"]
    key = choice(list(metadata))
    text = metadata.pop(key)
    tree = json.loads(text) if text[:1] in "{[" else [text]
    other_leaf(tree)
    changed = json.dumps(tree)
    cut = text[: randrange(len(text) + 1)]
    texts = [changed, changed, changed, cut, '{"a":' * 5000, json.dumps(choice(JUNK)), "", text * 2]
    if random.random() < 0.9:
        metadata[key] = choice(texts)


def other_recipe(header: Any, _: bytearray) -> None:
    """Write other file names, wrong sizes or huge sizes into the recipe in the metadata."""
    tree = json.loads(header["__metadata__"]["qgs.recipe"])
    new = choice(TABLES["recipes"])
    texts = [new, tree | new]
    tree["model"] |= choice(TABLES["sizes"])
    header["__metadata__"]["qgs.recipe"] = json.dumps(choice([*texts, tree, tree]))


def damage_checkpoint(file: Path) -> str:
    """Change the header or the tensors of a checkpoint; return a description of the change."""
    whole = file.read_bytes()
    end = 8 + int.from_bytes(whole[:8], "little")
    header = json.loads(whole[8:end])
    data = bytearray(whole[end:])
    change = choice((other_tensor, other_tensor, other_metadata, other_metadata, other_recipe))
    change(header, data)
    sealed = random.random() < 0.5
    if sealed:
        # Else hardly anything behind the seal would be tried.
        header["__metadata__"][SEAL] = seal(header["__metadata__"])
    if random.random() < 0.05:
        header["__metadata__"] = choice(TABLES["metadata"])
    text = json.dumps(header).encode()
    file.write_bytes(len(text).to_bytes(8, "little") + text + data)
    return f"{change.__name__}, sealed" if sealed else change.__name__


def damage_ply(file: Path) -> str:
    """Change a word in the header of a PLY file, and perhaps a value to NaN or an extreme number.

    Returns a description of the change.
    """
    head, end, data = file.read_bytes().partition(b"end_header\n")
    values = np.frombuffer(data, "<f4").copy()
    if random.random() < 0.5:
        values[randrange(len(values))] = choice(TABLES["numbers"])
    words = head.split(b" ")
    words[randrange(len(words))] = choice([*TABLES["words"], "float"]).encode("latin-1")
    file.write_bytes(b" ".join(words) + end + values.tobytes())
    return "other words and numbers"


def decode(file: Path) -> bytes:
    """Load a checkpoint and decode its queries into Gaussians; return the Gaussians as PLY."""
    with CheckpointFile(file) as checkpoint:
        model = checkpoint.model()
        _ = checkpoint.extra
    assert isinstance(model.queries, LearnedQueries)
    with torch.no_grad():
        gaussians = model.decode(model.queries.start(1))
    # Weights may be any numbers; Gaussians that are none must not be written.
    ply = file.with_suffix(".ply")
    qgs.save_ply(gaussians, ply)
    return ply.read_bytes()


def start_from(file: Path) -> bytes:
    """Start a training from the weights of a checkpoint; return these weights as bytes."""
    recipe = resolve(RECIPE, [*SMALL, "model.queries.count=9", f"init_from={file}"])
    model = recipe.build_model()
    initialise(model, recipe)
    return save(model.state_dict())


def convert(file: Path) -> None:
    """Read Gaussians and write them again."""
    qgs.save_ply(qgs.load_ply(file), file.with_name("again.ply"))


def judged(use: Callable[[Path], bytes | None], path: Path, whole: bytes | None) -> str:
    """Call `use` on the file `path`; return "success", or how the file was refused.

    whole: result of the undamaged file, which must be equal; None allows any result.
    """
    try:
        made = use(path)
    except (ValueError, OSError) as error:
        # Numbers that are not finite are found when Gaussians are written, under another name.
        named = "" if "not finite" in str(error) else str(path)
        return f"{use.__name__} {refused(error, named)}"
    if whole not in (None, made):
        raise FaultError("the numbers differ from those of the undamaged file")
    return f"{use.__name__} success"


def prepare(scratch: Path) -> None:
    """Write a checkpoint, a PLY and a .splat file."""
    qgs.save(qgs.compose(RECIPE, SMALL), scratch / "a.safetensors", extra={"step": "3"})
    decode(scratch / "a.safetensors")
    save_splat(qgs.load_ply(scratch / "a.ply"), scratch / "a.splat")


def case_in(scratch: Path, folder: Path) -> tuple[str, Use]:
    """Copy one of the files in `scratch` to `folder` and damage it.

    Returns a description of the case, and the function that uses it.
    """
    use = choice((decode, start_from, convert))
    original = scratch / (choice(("a.ply", "a.splat")) if use is convert else "a.safetensors")
    path = folder / original.name
    path.write_bytes(original.read_bytes())
    damage = damage_ply if use is convert else damage_checkpoint
    if random.random() < 0.15 or original.suffix == ".splat":
        damage = other_bytes
    what = damage(path)
    whole = use(original) if what == other_metadata.__name__ else None
    return f"{use.__name__}, {what}", partial(judged, use, path, whole)
