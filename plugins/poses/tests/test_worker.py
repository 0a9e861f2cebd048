"""The process of COLMAP: what it takes up again, and how many threads it uses."""

import json
import sqlite3
import subprocess
import sys
from contextlib import closing
from dataclasses import asdict
from pathlib import Path

import pytest
from qgs_poses.colmap import run
from qgs_poses.job import Job
from walked import PHOTOS


@pytest.fixture
def job(walk, shots, tmp_path) -> Job:
    names = [f"{number}.jpg" for number in range(PHOTOS)]
    (tmp_path / "models").mkdir()
    return Job(
        images=str(walk),
        database=str(tmp_path / "database.db"),
        models=str(tmp_path / "models"),
        groups=[names],
        sizes=dict.fromkeys(names, shots[0].image.shape[:2]),
        sequential=True,
        features=1000,
        threads=1,
        seed=0,
    )


def cameras(job: Job) -> list[int]:
    """Of each photo of the database that has features."""
    query = "select camera_id from images join keypoints using (image_id)"
    with closing(sqlite3.connect(job.database)) as opened:
        return [camera for (camera,) in opened.execute(query)]


def test_photos_share_a_camera_after_their_features_were_interrupted(job):
    process = subprocess.Popen(
        [sys.executable, "-m", "qgs_poses.worker"],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
    )  # fmt: skip
    assert process.stdin
    assert process.stdout
    process.stdin.write(json.dumps(asdict(job)) + "\n")
    process.stdin.flush()
    next(line for line in process.stdout if "Processed file [3/" in line)
    process.kill()
    process.communicate()
    assert 2 <= len(cameras(job)) < PHOTOS
    run(job, PHOTOS, lambda *progress: None)
    found = cameras(job)
    assert len(found) == PHOTOS
    assert len(set(found)) == 1


# COLMAP's own threshold for threads is above the size of this model, so the options are looked at
PROBE = """
import json, sys
from qgs_poses import worker
worker.FREE_CENTRE = 3
adjust, threads = worker.COLMAP.bundle_adjustment, []
def counted(model, options):
    threads.append(options.ceres.solver_options.num_threads)
    adjust(model, options)
worker.COLMAP.bundle_adjustment = counted
worker.mapped(worker.Job(**json.loads(sys.argv[1])))
print("threads", threads)
"""


def test_one_thread_is_one_for_principal_points_too(job):
    command = [sys.executable, "-c", PROBE, json.dumps(asdict(job))]
    found = subprocess.run(command, capture_output=True, text=True, check=True)
    assert "threads [1]" in found.stdout
    assert (Path(job.models) / "best" / "cameras.bin").is_file()
