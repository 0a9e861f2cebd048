"""Studies that run: queues on one folder, kills, what is added later. Trainings of seconds."""

import io
import multiprocessing
import os
import re
import signal
import time
from pathlib import Path
from types import SimpleNamespace

import pytest
from commands import done
from fuzzing import kill
from qgs_research.studies import queue as queue_module
from qgs_research.studies.plan import planned
from qgs_research.studies.queue import Queue
from qgs_research.studies.results import Results
from qgs_research.studies.runs import run_of
from qgs_research.studies.study import read_study
from qgs_research.studies.work import is_free, lock_of, work
from rich.console import Console

RECIPES = Path(__file__).parents[4] / "recipes"


@pytest.fixture
def study(tmp_path):
    text = kill.STUDY.format(recipes=RECIPES, steps=12)
    text = text.replace("seeds: [0, 1, 2]", "seeds: [0, 1]")
    text = re.sub(r"  (free|tokengs):.*\n|differs:.*\n", "", text)
    text = re.sub(r"hypotheses:.*", "hypotheses: [flat < locus]", text)
    (tmp_path / "study.yaml").write_text(text)
    return tmp_path / "study.yaml"


@pytest.fixture
def plan(study):
    return planned(read_study(study), study.parent / "out")


def begun(out):
    """Of each run how often it was trained from the start."""
    logs = sorted(out.glob("runs/*/*.log"))
    return {f"{p.parent.name}/{p.stem}": p.read_text().count("step 1 ") for p in logs}


@pytest.mark.slow
def test_two_queues_share_a_folder_and_additions_run_alone(study):
    out = study.parent / "out"
    command = f"study {study} --out {out} --threads 1 --device cpu --workers 1"
    queues = [kill.started(command, study.parent / "log") for _ in range(2)]
    assert [queue.wait(600) for queue in queues] == [0, 0]
    runs = {f"{v}/seed-{s}": 1 for v in ("locus", "flat") for s in (0, 1)}
    assert begun(out) == runs
    assert "2 seeds x 4 scenes" in (out / "table.md").read_text()

    study.write_text(study.read_text().replace("seeds: [0, 1]", "seeds: [0, 1, 2]"))
    told = done("study", study, "--out", out, "--only", 4, "--device", "cpu").output
    assert "6 runs, 2 of them missing" in told
    assert begun(out) == {**runs, "locus/seed-2": 1}

    changed = study.read_text().replace("qgs/content}", "locus/ray_biased, bandwidth: fixed}")
    study.write_text(changed)
    with pytest.raises(ValueError, match="`flat`"):
        done("study", study, "--out", out, "--workers", 0)


def queue_of(plan, workers=1, runs=None):
    console = Console(file=io.StringIO())
    return Queue(plan, runs or plan.runs, workers, threads=1, device="cpu", console=console)


def test_what_failed_comes_last_and_a_collapse_is_final(study, plan, monkeypatch):
    first, second, third, fourth = plan.runs
    first.failure.parent.mkdir(parents=True)
    first.failure.write_text("CollapseError: training collapsed at step 7\n")
    second.failure.parent.mkdir(parents=True, exist_ok=True)
    second.failure.write_text("OSError: no space left\n")
    started = []

    def start(queue, run):
        started.append(run)
        if len(started) == 3:
            queue._stop(signal.SIGTERM, None)
        return SimpleNamespace(exitcode=None, terminate=int, join=float, kill=int)

    monkeypatch.setattr(Queue, "_start", start)
    queue = queue_of(plan, workers=4)
    assert queue.work() == "SIGTERM"
    assert started == [third, fourth, second]
    assert not queue.failures  # what failed before is no failure of this call
    assert str(first.failure) in queue.console.file.getvalue()
    done("slurm", "study", study, "--out", plan.folder)
    assert "#SBATCH --array=1,2,3" in (plan.folder / "slurm.sh").read_text()


def die(*_):
    os.kill(os.getpid(), signal.SIGKILL)


def test_a_run_that_is_killed_again_and_again_says_so_in_the_results(plan, monkeypatch):
    monkeypatch.setattr(queue_module, "work", die)
    killed = plan.runs[0]
    queue = queue_of(plan, runs=[killed])
    assert queue.work() is None
    assert queue.failures == [killed]
    assert "ended 3 times without a save between" in killed.failed
    assert not killed.ended
    assert Results(plan).failed == [killed]


def told(*given):
    """What a process of a run does, as far as it prepares for it."""
    print(f"threads {os.environ['OMP_NUM_THREADS']}, {given}", flush=True)
    os.write(1, b"and a library\n")


def test_a_process_has_its_threads_and_prints_into_the_log(plan, monkeypatch):
    monkeypatch.setattr(queue_module, "work", told)
    run = plan.runs[0]
    queue = queue_of(plan, runs=[run])
    queue._gpu_of[run] = ""
    process = queue._start(run)
    process.join()
    assert process.exitcode == 0
    text = run.log.read_text()
    assert "threads 1" in text
    assert str((plan.folder.absolute(), run.variant, run.seed, ["", "more"], "cpu", 1)) in text
    assert text.endswith("and a library\n")


@pytest.mark.slow
def test_a_killed_study_has_the_table_of_a_quiet_one(tmp_path):
    assert kill.study(tmp_path, 3, steps=20) == 0


def hold(run, pipe):
    with lock_of(run):
        pipe.send(True)
        time.sleep(600)


def test_one_process_has_a_run_until_it_dies(tmp_path):
    run = run_of(tmp_path, "variant", 3)
    fork = multiprocessing.get_context("fork")
    here, there = fork.Pipe()
    holder = fork.Process(target=hold, args=(run, there))
    holder.start()
    assert here.recv()
    assert not is_free(run)
    work(tmp_path, run.variant, run.seed, [""], "cpu", 1)
    assert not run.failed
    holder.kill()
    holder.join()
    assert is_free(run)
