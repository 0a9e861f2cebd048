"""What people give: each kind ends with poses or with one sentence, and theirs stays as it was."""

import os
import shlex
import signal
import subprocess
import sys

import numpy as np
import pytest
from commands import run_qgs
from photo_formats import cut, noise
from PIL import Image
from qgs_photos.poses import making
from qgs_photos.poses.photos import PosesError
from scipy.io import wavfile
from tables import contents
from walked import write_photos, write_video


def test_hopeless_ones_are_refused_in_a_sentence(images, tmp_path):
    given = tmp_path / "given here"
    images = [image[::2, ::2] for image in images[:4]]
    pictures = {
        "none": [],
        "one photo": images[:1],
        "one view": images[:1] * 4,
        "bare": [np.full_like(image, 127) for image in images],
        "blurred": [np.array(Image.fromarray(i).resize((9, 6)).resize((180, 120))) for i in images],
        "noise": noise(3, 160, 240, 3),
        "tiny": [image[:10, :10] for image in images],
        "cut off": images,
    }
    for name, each in pictures.items():
        write_photos(given / name, each)
    for photo in (given / "cut off").iterdir():
        cut(photo, 0.2)
    write_photos(given / "GIF", images, "{}.gif")
    (write_photos(given / "HEIC", []) / "a.heic").touch()
    write_video(given / "one frame.mp4", images[:1])
    write_video(given / "still.mp4", images[:1] * 4)
    cut(write_video(given / "cut off.mp4", images * 8), 0.5)  # without its index, at the end
    (given / "empty.mp4").touch()
    (given / "text.mp4").write_bytes(b"no video" * 40)
    wavfile.write(given / "sound.mp4", 8000, np.zeros(4500, np.int16))

    before = contents(tmp_path)
    for source in given.iterdir():
        error = run_qgs(f"poses --out {tmp_path}/out", source).exception
        assert type(error) is PosesError, source
        assert "\n" not in str(error)
        assert not (tmp_path / "out").exists(), source
    assert contents(tmp_path) == before


def test_what_cannot_be_written_is_named(walk, tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    for out in (tmp_path / "file/out", "/proc/out"):
        assert isinstance(run_qgs(f"poses --out {out}", walk).exception, OSError)

    def full(*rest):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(making, "prepare", full)
    assert "free space" in str(run_qgs(f"poses --out {tmp_path}/out", walk).exception)


@pytest.mark.slow
def test_a_crash_of_colmap_is_one_sentence(walk, tmp_path):
    code = "import sys; from qgs.cli import main; sys.argv[0] = 'qgs'; main()"
    command = [sys.executable, "-uc", code, "poses", walk, "--out", tmp_path]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    process = subprocess.Popen(command, **pipes)
    next(line for line in process.stdout if line.startswith("features"))
    list_children = shlex.split(f"ps -o pid= --ppid {process.pid}")
    os.kill(int(subprocess.check_output(list_children)), signal.SIGSEGV)
    text, _ = process.communicate(timeout=60)
    assert process.returncode == 2
    assert "error: COLMAP ended in the stage" in text
    assert "Traceback" not in text
