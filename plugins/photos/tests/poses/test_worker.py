"""The process of COLMAP: what it takes up again, and how many threads it uses."""

import json
import sqlite3
import subprocess
import sys
from contextlib import closing
from dataclasses import asdict

from qgs_photos.poses.job import Job
from walked import PHOTOS

# COLMAP's own threshold for threads is above the size of this model, so the options are looked at
PROBE = """
import json, sys
from qgs_photos.poses import worker
worker.FREE_CENTRE = 3
adjust, threads = worker.COLMAP.bundle_adjustment, []
def counted(model, options):
    threads.append(options.ceres.solver_options.num_threads)
    adjust(model, options)
worker.COLMAP.bundle_adjustment = counted
worker.mapped(worker.Job(**json.loads(sys.argv[1])))
print("threads", threads)
"""


def cameras(database):
    """Of each photo of the database that has features."""
    with closing(sqlite3.connect(database)) as opened:
        return [*opened.execute("select camera_id from images join keypoints using (image_id)")]


def test_an_interrupted_process_is_taken_up_with_one_camera_and_the_wanted_threads(
    made, shots, tmp_path
):
    """One thread is one for principal points too."""
    models = tmp_path / "models"
    models.mkdir()
    job = Job(
        images=str(made.folder / "images"),
        database=str(tmp_path / "database.db"),
        models=str(models),
        groups=[[*made.posed]],
        sizes=dict.fromkeys(made.posed, shots[0].image.shape[:2]),
        sequential=True,
        features=1000,
        threads=1,
        seed=0,
    )
    asked = json.dumps(asdict(job))
    process = subprocess.Popen(
        [sys.executable, "-m", "qgs_photos.poses.worker"],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    process.stdin.write(f"{asked}\n")
    process.stdin.flush()
    next(line for line in process.stdout if "Processed file [2/" in line)
    process.kill()
    process.communicate()
    assert 1 <= len(cameras(tmp_path / "database.db")) < PHOTOS
    command = [sys.executable, "-c", PROBE, asked]
    found = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "threads [1]" in found.stdout
    assert (models / "best/cameras.bin").is_file()
    assert cameras(tmp_path / "database.db") == [(1,)] * PHOTOS
