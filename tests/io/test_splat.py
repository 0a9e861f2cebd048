"""Files of Gaussians for other viewers: .splat, and `qgs convert`."""

import re
from dataclasses import replace

import numpy as np
import torch
from commands import run_qgs

import qgs
from qgs.data.scenes import warn_once
from qgs.io.splat import RECORD, save_splat
from qgs.types import Gaussians, map_tensors


def gaussians(count: int) -> Gaussians:
    generator = torch.Generator().manual_seed(0)

    def draw(*trailing: int) -> torch.Tensor:
        return torch.rand(1, count, *trailing, generator=generator)

    quats = torch.nn.functional.normalize(draw(4) - 0.5, dim=-1)
    return Gaussians(draw(3) * 10 - 5, draw(3) + 1e-3, quats, draw() * 0.98 + 0.01, draw(3))


def test_bytes_are_those_of_the_format(tmp_path):
    given = gaussians(300)
    save_splat(given, tmp_path / "scene.splat")
    read = np.frombuffer((tmp_path / "scene.splat").read_bytes(), RECORD)
    assert RECORD.itemsize == 32
    order = (given.scales[0].prod(-1) * given.opacities[0]).argsort(descending=True).numpy()
    np.testing.assert_array_equal(read["mean"], given.means[0].numpy()[order])
    np.testing.assert_array_equal(read["scale"], given.scales[0].numpy()[order])
    np.testing.assert_allclose(
        read["rgba"][:, :3] / 255, given.colors[0].numpy()[order], atol=0.002
    )
    np.testing.assert_allclose(
        read["rgba"][:, 3] / 255, given.opacities[0].numpy()[order], atol=0.002
    )
    quats = (read["quat"].astype(float) - 128) / 128
    np.testing.assert_allclose(quats, given.quats[0].numpy()[order], atol=0.008)


def test_the_most_opaque_are_kept(tmp_path):
    given = gaussians(50)
    qgs.save_ply(given, tmp_path / "all.ply")
    done = run_qgs("convert", tmp_path / "all.ply", tmp_path / "few.ply", "--count", 7)
    assert done.exception is None
    assert re.search(r"few\.ply: 7 of 50 Gaussians, 0\.00 MB", done.output)
    few = qgs.load_ply(tmp_path / "few.ply")
    best = given.opacities[0].topk(7).indices.sort().values  # as they were ordered, by query
    torch.testing.assert_close(few.opacities[0], given.opacities[0, best])
    torch.testing.assert_close(few.means[0], given.means[0, best])
    assert run_qgs("convert", tmp_path / "all.ply", tmp_path / "same.PLY").exception is None
    assert torch.equal(qgs.load_ply(tmp_path / "same.PLY").means, given.means)
    assert given.most_opaque(99).count == 50
    both = map_tensors(lambda x: torch.cat([x, x.flip(1)]), given)
    halves = both.most_opaque(5)
    torch.testing.assert_close(halves.colors[0], halves.colors[1].flip(0))
    assert run_qgs("convert", tmp_path / "few.ply", tmp_path / "few.splat").exception is None
    assert (tmp_path / "few.splat").stat().st_size == 7 * 32


def test_harmonics_survive_convert_and_are_told_of_where_they_cannot(tmp_path, caplog):
    given = replace(gaussians(9), sh=torch.randn(1, 9, 8, 3))
    qgs.save_ply(given, tmp_path / "all.ply")
    done = run_qgs("convert", tmp_path / "all.ply", tmp_path / "few.ply", "--count", 3)
    assert done.exception is None
    assert torch.equal(qgs.load_ply(tmp_path / "few.ply").sh, given.most_opaque(3).sh)
    assert caplog.text == ""
    warn_once.cache_clear()
    assert run_qgs("convert", tmp_path / "all.ply", tmp_path / "all.splat").exception is None
    assert ".splat files have no place for spherical harmonics (`sh`): left out" in caplog.text
    save_splat(replace(qgs.load_ply(tmp_path / "all.ply"), sh=None), tmp_path / "plain.splat")
    assert (tmp_path / "plain.splat").read_bytes() == (tmp_path / "all.splat").read_bytes()


def test_other_kinds_and_files_that_exist_are_refused(tmp_path):
    qgs.save_ply(gaussians(2), tmp_path / "a.ply")
    error = run_qgs("convert", tmp_path / "a.ply", tmp_path / "a.spz").exception
    assert "must end in .ply or .splat" in str(error)
    before = (tmp_path / "a.ply").read_bytes()
    assert isinstance(
        run_qgs("convert", tmp_path / "a.ply", tmp_path / "a.ply").exception, FileExistsError
    )
    assert (tmp_path / "a.ply").read_bytes() == before
