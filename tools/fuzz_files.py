"""Damage checkpoints and PLY files in many ways, and see that each is used or refused well.

    python tools/fuzz_files.py --count 1000 --seed 0

    python tools/fuzz_files.py --seed 0 --only 17

A checkpoint is loaded and made into Gaussians, or starts a training; what is made of one with
damaged metadata that is not refused must be what the whole one gives. Other tensors, and metadata
that are sealed anew, as by somebody who means harm, may give other numbers. PLY files are shown.
See fuzzing.py.
"""

import json
import math
import random
import struct
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.torch
import torch
from fuzzing import JUNK, FaultError, Use, fuzz, other_bytes, other_leaf, refused
from qgs_viewer.choice import Choice, painted
from qgs_viewer.query_scene import QueryScene
from qgs_viewer.server import first_eye

import qgs
from qgs.checkpoint.model_file import CheckpointFile
from qgs.checkpoint.tensors import SEAL, seal
from qgs.contracts import LearnedQueries
from qgs.recipe import resolve
from qgs.train.initial import initialise

FORGED = "forged"
RECIPE = Path(__file__).parents[1] / "recipes" / "tiny" / "locus.yaml"
SMALL = ("model.width=16", "model.heads=2", "model.queries.count=8", "data.image_size=[16, 16]",
         "model.decoder.depth=2", "model.supervision.layers=[2]")  # fmt: skip
LARGE = {
    "width": [4096, 65536, 10**9],
    "heads": [3, 10**9],
    "queries": [{"type": "locus/anchored", "count": 10**n} for n in (5, 8, 18, 30)],
    "decoder": [{"depth": 10**n} for n in (2, 4, 9)],
}
TYPES = ("F64", "F16", "BF16", "I64", "I32", "U32", "I16", "I8", "U8", "BOOL", "F8_E4M3", "F99", "")
RECIPES = (
    {"extends": "/etc/passwd"}, {"extends": "/dev/zero"}, {"recipe": 1}, {"recipe": 99},
    {"recipe": 1, "plugins": ["nobody"]}, {"recipe": 1, "swap": {"*": {"type": "qgs/none"}}},
    ["recipe"], "/etc/passwd", 7,
)  # fmt: skip


def other_tensor(header: Any, data: bytearray, dice: random.Random) -> None:
    """Another type, shape, place, name or value of a tensor."""
    name = dice.choice([key for key in header if key != "__metadata__"])
    entry = header[name]
    shape, (first, last) = entry["shape"], entry["data_offsets"]
    what = dice.choice(("dtype", "shape", "data_offsets", "name", "value"))
    if what == "name":
        header[dice.choice(("foo", "", "/", "x" * 10_000, "\u20ac", f"{name}x"))] = header.pop(name)
    elif what == "value" and last - first >= 4:
        place = first + dice.randrange((last - first) // 4) * 4
        data[place : place + 4] = dice.choice((b"\xff" * 4, b"\x00\x00\x80\x7f", dice.randbytes(4)))
    elif what == "dtype":
        entry["dtype"] = dice.choice(TYPES)
    elif what == "shape":
        large = [n * 2**40 for n in shape] or [2**62]
        less = [-n for n in shape]
        changes = (shape[::-1], [*shape, 1], [0, *shape], large, less, [2**33, 2**33, *shape])
        entry["shape"] = dice.choice((*changes, [torch.Size(shape).numel()], dice.choice(JUNK)))
    else:
        places = ([last, first], [first, 2**63], [-1, last], [0, last], [first + 4, last])
        entry["data_offsets"] = dice.choice((*places, dice.choice(JUNK)))


def other_metadata(header: Any, data: bytearray, dice: random.Random) -> None:
    """Another text, or a leaf or branch of the JSON, in an entry of the metadata."""
    metadata = header["__metadata__"]
    key = dice.choice(list(metadata))
    text = metadata[key]
    if text[:1] in "{[" and dice.random() < 0.6:
        other_leaf(tree := json.loads(text), dice)
        metadata[key] = json.dumps(tree)
    elif dice.random() < 0.8:
        deep, cut = dice.choice(("[", '{"a":')) * 5000, text[: dice.randrange(len(text) + 1)]
        junk = json.dumps(dice.choice(JUNK))
        metadata[key] = dice.choice((cut, deep, junk, "null", "", text + text, "1e999", "-5"))
    elif dice.random() < 0.8:
        del metadata[key]
    else:
        header["__metadata__"] = dice.choice(({}, [], None, {"a": 1}, {key: 5}))


def other_recipe(header: Any, data: bytearray, dice: random.Random) -> None:
    """Files that a recipe names, and sizes that no tensor has or no machine holds."""
    tree, new = json.loads(header["__metadata__"]["qgs.recipe"]), dice.choice(RECIPES)
    if dice.random() < 0.5:
        for option in dice.sample(list(LARGE), dice.randint(1, 2)):
            tree["model"][option] = dice.choice(LARGE[option])
    else:
        tree = {**tree, **new} if isinstance(new, dict) and dice.random() < 0.5 else new
    header["__metadata__"]["qgs.recipe"] = json.dumps(tree)


def damage_checkpoint(file: Path, dice: random.Random) -> str:
    whole = file.read_bytes()
    end = 8 + int.from_bytes(whole[:8], "little")
    header, data = json.loads(whole[8:end]), bytearray(whole[end:])
    change = dice.choice((other_tensor, other_tensor, other_metadata, other_metadata, other_recipe))
    change(header, data, dice)
    metadata = header["__metadata__"]
    is_whole = isinstance(metadata, dict) and all(isinstance(x, str) for x in metadata.values())
    if sealed := is_whole and dice.random() < 0.5:
        # Else hardly anything behind the seal would be tried.
        metadata[SEAL] = seal(metadata)
    text = json.dumps(header).encode()
    file.write_bytes(len(text).to_bytes(8, "little") + text + data)
    # Nothing seals the tensors, and whoever writes a seal may write other metadata.
    forged = sealed or change is not other_metadata
    return f"{FORGED} {change.__name__}" if forged else change.__name__


def damage_ply(file: Path, dice: random.Random) -> str:
    """Another word in the header, or values that are no numbers."""
    head, end, data = file.read_bytes().partition(b"end_header\n")
    words = head.split(b" ")
    if dice.random() < 0.3:
        values = bytearray(data)
        place = 4 * dice.randrange(len(values) // 4)
        number = dice.choice((math.nan, 0.0, 88.0, -120.0, 3e38, -3e38))
        values[place : place + 4] = struct.pack("<f", number)
        data = bytes(values)
    else:
        news = (b"list", b"uchar int", b"double", b"ascii", b"-1", b"10000000000000", b"x", b"\xff")
        words[dice.randrange(len(words))] = dice.choice((*news, b"f_rest_45\nproperty", b"\n"))
    file.write_bytes(b" ".join(words) + end + data)
    return "ply"


def decode(file: Path) -> bytes:
    with CheckpointFile(file) as checkpoint:
        model, _ = checkpoint.model(), checkpoint.extra
    assert isinstance(model.queries, LearnedQueries)
    with torch.no_grad():
        qgs.save_ply(model.decode(model.queries.start(1)), ply := file.with_suffix(".ply"))
    return ply.read_bytes()


def start_from(file: Path) -> bytes:
    recipe = resolve(RECIPE, [*SMALL, "model.queries.count=9", f"init_from={file}"])
    initialise(model := recipe.build_model(), recipe)
    return safetensors.torch.save(model.state_dict())


def show_ply(file: Path) -> None:
    """As the viewer does."""
    scene = QueryScene(qgs.load_ply(file))
    eye, _ = first_eye(scene)
    shown = painted(scene, Choice())
    parts = eye, shown.centers, shown.covariances
    if not all(np.isfinite(part).all() for part in parts) or not shown.magnification > 0:
        raise FaultError("the viewer gets numbers that are not finite")


def judged(use: Callable[[Path], bytes | None], path: Path, whole: bytes | None) -> str:
    """whole: what the undamaged file gives; None where a change may go unseen."""
    try:
        made = use(path)
    except (ValueError, OSError) as error:
        return f"{use.__name__} {refused(error, str(path))}"
    if whole is not None and made != whole:
        raise FaultError("another result than that of the undamaged file")
    return f"{use.__name__} success"


def prepared(scratch: Path) -> Callable[[random.Random, Path], tuple[str, Use]]:
    qgs.save(
        qgs.compose(RECIPE, SMALL), checkpoint := scratch / "a.safetensors", extra={"step": "3"}
    )
    kinds = (
        (decode, damage_checkpoint, decode(checkpoint)),
        (start_from, damage_checkpoint, start_from(checkpoint)),
        (show_ply, damage_ply, None),
    )

    def case_in(dice: random.Random, folder: Path) -> tuple[str, Use]:
        use, damage, whole = dice.choice(kinds)
        path = folder / ("a.ply" if damage is damage_ply else "a.safetensors")
        path.write_bytes((scratch / path.name).read_bytes())
        any_bytes = dice.random() < 0.15
        what = (other_bytes if any_bytes else damage)(path, dice)
        forged = any_bytes or what.startswith(FORGED)
        return f"{use.__name__}, {what}", partial(judged, use, path, None if forged else whole)

    return case_in


if __name__ == "__main__":
    sys.exit(fuzz(__doc__, prepared))
