"""Models on the Hugging Face Hub, by the mixin of huggingface_hub (extra `hub`)."""

import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

from huggingface_hub import ModelCard, ModelCardData, ModelHubMixin, hf_hub_download

from qgs.checkpoint.model_file import CheckpointFile, load
from qgs.checkpoint.models import CHECKPOINT, card_of
from qgs.domain import WORDS, shown
from qgs.files import AnyPath
from qgs.model import QueryGaussianModel
from qgs.recipe.yaml_text import dump
from qgs.terminal import without_secrets

SCORES = Path("evaluation", "table.md")
"""Table of scores, relative to the folder of a checkpoint, as `qgs eval` writes it."""

_REPOSITORY = "OWNER/NAME"
_USE = """
This model makes 3D Gaussians of photos with known cameras, in one pass:

```python
# pip install {packages}
import qgs

model = qgs.from_pretrained("{repository}")
qgs.reconstruct(model, "photos").save("reconstruction")
```
"""


class HubCheckpoint(ModelHubMixin):
    """A checkpoint and its card, as a repository of the Hub holds them.

    name: as for `qgs.load`. license: identifier of the Hub for the licence, such as apache-2.0.
    """

    def __init__(self, name: AnyPath, license: str) -> None:
        with CheckpointFile(name) as file:
            self._facts = "\n".join(_facts(file))
            self._file = file.path
            # the recipe is part of them
            if without_secrets(self._facts) != self._facts:
                raise ValueError(
                    f"{name} is not uploaded: its recipe or card has a URL with a password"
                )
            # what config.json gets; else the mixin writes the arguments, with a path
            self._hub_mixin_config = dict(file.recipe.tree)
        self._license = license

    def _save_pretrained(self, save_directory: Path) -> None:
        shutil.copyfile(self._file, save_directory / CHECKPOINT)

    def generate_model_card(self, repo_id: str = _REPOSITORY, **_: Any) -> ModelCard:
        """Return a card with what the checkpoint says of itself."""
        tags = ["gaussian-splatting", "novel-view-synthesis"]
        data = ModelCardData(
            license=self._license, library_name="qgs", pipeline_tag="image-to-3d", tags=tags
        )
        facts = self._facts.replace(_REPOSITORY, repo_id)
        return ModelCard(f"---\n{data.to_yaml()}\n---\n\n{facts}\n")

    @classmethod
    def _from_pretrained(
        cls, *, model_id: str, device: Any, gaussians: int | None, **options: Any
    ) -> QueryGaussianModel:
        if not os.path.isdir(model_id):
            model_id = hf_hub_download(model_id, CHECKPOINT, **options)
        return load(model_id, device, gaussians=gaussians)


def _facts(file: CheckpointFile) -> Iterator[str]:
    """Yield the lines of the card of a checkpoint, without its metadata."""
    yield card_of(file.path) or "# Photos to 3D Gaussians"
    packages = " ".join(sorted({name for name, _ in file.recipe.releases.values()}))
    yield _USE.format(packages=packages, repository=_REPOSITORY)
    if ranges := file.domain.ranges:
        yield "## Views in its training\n"
        yield from (f"- {WORDS[name].format(shown(ends))}" for name, ends in ranges.items())
    scores = file.path.parent / SCORES
    if scores.is_file():
        yield f"\n## Scores\n\n{scores.read_text(encoding='utf-8')}"
    yield f"\n## Recipe\n\n```yaml\n{dump(file.recipe.tree)}```"
    if file.step is not None:
        yield f"\nTrained for {file.step:,} steps."


def push_to_hub(name: AnyPath, repo_id: str, *, license: str, **options: Any) -> str:
    """Upload a checkpoint, its recipe and its card to the Hub; return the URL of the commit.

    name: as for `qgs.load`. license: identifier of the licence, such as "apache-2.0". options: as
    for `ModelHubMixin.push_to_hub`, such as private=True. Raises ValueError for a recipe or card
    with a password, and the errors of `CheckpointFile` and huggingface_hub.
    """
    return HubCheckpoint(name, license).push_to_hub(
        repo_id, model_card_kwargs={"repo_id": repo_id}, **options
    )


def from_pretrained(
    repo_id: str, device: Any = None, *, gaussians: int | None = None, **options: Any
) -> QueryGaussianModel:
    """Load the model in a repository of the Hub, or in a folder with the files of one.

    device, gaussians: as for `qgs.load`. options: as for `ModelHubMixin.from_pretrained`, such as
    revision="v1". Raises the errors of `qgs.load` and of huggingface_hub.
    """
    hub = cast(Any, HubCheckpoint)
    return hub.from_pretrained(repo_id, device=device, gaussians=gaussians, **options)
