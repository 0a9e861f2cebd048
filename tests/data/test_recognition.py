import pytest
from upath import UPath

from qgs.data.recognition import recognised

HASH = "0a" * 32
HOLDINGS = {
    "train/index.json": "qgs/chunks",
    "test/000000.torch": "qgs/chunks",
    "000000.torch": "qgs/chunks",
    "transforms.json": "qgs/photos",
    "transforms_train.json": "qgs/photos",
    "poses_bounds.npy": "qgs/photos",
    "scene/transforms.json": "qgs/photos",
    "train/scene/transforms.json": "qgs/photos",
    f"{HASH}.zip": "qgs/dl3dv",
    f"1K/{HASH}.zip": "qgs/dl3dv",
    f"{HASH}/transforms.json": "qgs/dl3dv",
    f"{HASH}/gaussian_splat/transforms.json": "qgs/dl3dv",
    "garden/nerfstudio/transforms.json": "qgs/dl3dv",
    "2K/garden/gaussian_splat/transforms.json": "qgs/dl3dv",
    "readme.txt": "qgs/photos",
}


@pytest.mark.parametrize("held", HOLDINGS)
@pytest.mark.parametrize("url", ["{}", "memory://recognition{}"])
def test_by_content(tmp_path, held, url):
    root = UPath(url.format(tmp_path))
    file = root / held
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(b"")
    assert recognised(root) == HOLDINGS[held]


def test_files_and_nothing(tmp_path):
    (tmp_path / "a.zip").write_bytes(b"")
    assert recognised(UPath(tmp_path / "a.zip")) == "qgs/dl3dv"
    with pytest.raises(FileNotFoundError, match="does not exist"):
        recognised(UPath(tmp_path / "b"))
