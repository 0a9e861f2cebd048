"""Studies that run: queues on one folder, kills, what is added later. Trainings of seconds."""

import io
import json
import multiprocessing
import re
import signal
import subprocess
import time
from pathlib import Path

import kill
import pytest
from commands import done
from qgs_research.studies.plan import planned, run_of
from qgs_research.studies.queue import Queue, _end, _signal, last_record
from qgs_research.studies.results import Results
from qgs_research.studies.study import read_study
from qgs_research.studies.work import is_free, locked
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
    command = ["study", str(study), "--out", str(out), "--threads", "1", "--device", "cpu"]
    queues = [kill.started([*command, "--workers", "1"], study.parent / "log") for _ in range(2)]
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

    monkeypatch.setattr(Queue, "_start", start)
    monkeypatch.setattr("qgs_research.studies.queue._POLL_SECONDS", 0.01)
    queue = Queue(plan, 4, 1, "cpu", Console(file=(shown := io.StringIO())))
    assert queue.work() == "SIGTERM"
    assert started == [third, fourth, second]
    assert not queue.failures  # what failed before is no failure of this call
    assert str(first.failure) in shown.getvalue()
    done("study", study, "--out", plan.folder, "--slurm")
    assert "#SBATCH --array=1,2,3" in (plan.folder / "slurm.sh").read_text()


def test_a_run_that_is_killed_again_and_again_says_so_in_the_results(plan, monkeypatch):
    def start(queue, run):
        run.failure.parent.mkdir(parents=True, exist_ok=True)
        queue._processes[run] = subprocess.Popen(["sh", "-c", "kill -9 $$"]), 0

    monkeypatch.setattr(Queue, "_start", start)
    killed = plan.runs[0]
    queue = Queue(plan, 1, 1, "cpu", Console(file=io.StringIO()), runs=[killed])
    assert queue.work() is None
    assert [*queue.failures] == [killed]
    assert "SIGKILL 3 times without a save between" in killed.failed
    assert not killed.ended
    assert Results(plan).failed == [killed]


@pytest.mark.slow
def test_a_killed_study_has_the_table_of_a_quiet_one(monkeypatch):
    monkeypatch.setattr("sys.argv", ["kill.py", "study", "--kills", "3", "--steps", "20"])
    assert kill.main() == 0


def hold(run, pipe):
    lock = locked(run)
    pipe.send(lock is not None)
    time.sleep(600)


def test_one_process_has_a_run_until_it_dies(tmp_path):
    run = run_of(tmp_path, "variant", 3)
    fork = multiprocessing.get_context("fork")
    here, there = fork.Pipe()
    holder = fork.Process(target=hold, args=(run, there))
    holder.start()
    assert here.recv()
    assert locked(run) is None
    holder.kill()
    holder.join()
    lock = locked(run)
    assert lock
    assert not is_free(run)
    lock.close()
    assert is_free(run)


def test_the_last_whole_record_tells_how_far_a_run_is(tmp_path):
    history = tmp_path / "history.jsonl"
    assert last_record(history) == (0, 0.0)
    lines = [json.dumps({"step": n, "seconds": n / 2, "loss": "x" * 100}) for n in range(1, 90)]
    for damaged in ('{"step": 90, "sec', '{"step": 90, "sec\n'):
        history.write_text("\n".join([*lines, damaged]))
        assert last_record(history) == (89, 44.5)


def test_an_exit_code_of_no_signal_ends_no_study():
    assert (_end(255), _end(-9)) == ("ended with exit code 255", "was ended by SIGKILL")
    assert [_signal(code) for code in (255, 137, -9, 1)] == [0, 9, 9, 0]  # others go on
