"""Golden files of the released MVSplat and DepthSplat: what they were made of, and comparison."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import safe_open
from seeded_weights import seeded_state_dict, weights_check
from torch import Tensor

from qgs.types import Cameras, Views

GOLDEN = Path(__file__).parent / "golden"
RTOL, ATOL = 1e-4, 5e-5


class Released:
    """tensors: by name. config: the metadata."""

    def __init__(self, name: str) -> None:
        with safe_open(GOLDEN / f"{name}.safetensors", "pt") as file:
            self.tensors = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118
            self.config: dict[str, Any] = json.loads(file.metadata()["config"])

    @property
    def options(self) -> Mapping[str, Any]:
        """The options of the release."""
        return self.config["options"]

    def views(self) -> Views:
        """Photos and cameras; lenses of the files are divided by the image's size."""
        images, k = self.tensors["images"], self.tensors["intrinsics"]
        height, width = images.shape[-2:]
        assert not k[..., 0, 1].any()
        lens = [k[..., 0, 0] * width, k[..., 1, 1] * height]
        lens += [k[..., 0, 2] * width, k[..., 1, 2] * height]
        cameras = Cameras(self.tensors["extrinsics"], torch.stack(lens, -1), (height, width))
        return Views(images, cameras)

    def weights(self) -> dict[str, Tensor]:
        """The state dict under its published names, without the prefix of checkpoints."""
        weights = self.config["weights"]
        arrays = seeded_state_dict(self.config["state_dict"], weights["seed"], weights["factors"])
        np.testing.assert_allclose(weights_check(arrays), self.tensors["weights_check"].numpy())
        return {name: torch.from_numpy(x) for name, x in arrays.items()}

    def problems(
        self, found: Mapping[str, Tensor], kinder: Mapping[str, tuple[float, float]]
    ) -> dict[str, str]:
        """What is wrong with each of the file's outputs; `kinder`: rtol and atol by name."""
        wrong = {}
        for name in self.config["outputs"]:
            expected = self.tensors[name]
            if name not in found:
                wrong[name] = "missing"
            elif found[name].shape != expected.shape:
                wrong[name] = f"{tuple(found[name].shape)} instead of {tuple(expected.shape)}"
            else:
                rtol, atol = kinder.get(name, (RTOL, ATOL))
                share = (found[name] - expected).abs() / (atol + rtol * expected.abs())
                if not share.max() <= 1:
                    wrong[name] = f"{share.max():.3g} times the tolerance"
        return wrong
