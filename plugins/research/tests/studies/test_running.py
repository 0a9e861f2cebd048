"""Studies that run: queues on one folder, kills, what is added later. Trainings of seconds."""

import multiprocessing
import os
import signal
import sys
import time

import pytest
from commands import done
from fuzzing import kill
from photo_formats import put
from qgs_research.studies import running
from qgs_research.studies.plan import planned, run_of
from qgs_research.studies.results import Results
from qgs_research.studies.study import read_study
from tables import must_refuse, text_console

STUDY = """study: 1
base: tiny/locus.yaml
overlay:
  data: {image_size: [32, 32], scenes: 50, samples: 1}
  model: {width: 32, heads: 2, queries: {count: 32}, head: {gaussians_per_query: 4}}
  optimizer: {warmup: 2}
  training: {batch_size: 1, save_every: 5}
  evaluation: {scenes: 4}
variants:
  locus:
  flat: {model: {decoder: {cross_attention: {type: qgs/content}}}}
reference: locus
seeds: [0, 1]
budget: {steps: 12}
evaluations: {more: {views: {inputs: 3}}}
hypotheses: [flat < locus]
"""


@pytest.fixture
def study(tmp_path):
    (tmp_path / "study.yaml").write_text(STUDY)
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
    assert "6 runs, 2 missing" in done(f"study {study} --out {out} --only 4 --device cpu").output
    assert begun(out) == {**runs, "locus/seed-2": 1}

    changed = study.read_text().replace("qgs/content}", "locus/ray_biased, bandwidth: fixed}")
    study.write_text(changed)
    must_refuse("`flat`", done, f"study {study} --out {out} --workers 0")


def trained(plan, workers):
    console = text_console()
    ended = running.train_missing(
        plan, plan.runs, workers=workers, threads=1, device="cpu", console=console
    )
    return *ended, console.file.getvalue()


def stub(monkeypatch, code):
    """In place of a training, with its arguments in `words`."""
    start = f"import os, sys, time; folder, variant, seed, *words = sys.argv[1:]; {code}"
    monkeypatch.setattr(running, "WORK", (sys.executable, "-c", start))


def test_each_run_is_tried_once_a_call_and_a_failed_one_when_its_file_is_deleted(
    study, plan, monkeypatch
):
    first, second, *_ = plan.runs
    put(first.failure, b"CollapseError: training collapsed at step 7: it\nLikely causes")
    say = "print('threads', os.environ['OMP_NUM_THREADS'], words, flush=True)"
    stub(monkeypatch, f"{say}; os.kill(os.getpid(), 9)")
    failed, stopped, told = trained(plan, 2)
    assert {*failed} == {*plan.runs}
    assert stopped is None
    assert str(first.failure) in told
    assert told.count("ended with exit code -9") == 3
    assert not first.log.exists()
    assert second.log.read_text() == "threads 1 ['cpu', '', 'more']\n"
    assert Results(plan).failed == [first]
    done(f"slurm study {study} --out {plan.folder}")
    assert "#SBATCH --array=1,2,3\n" in (plan.folder / "slurm.sh").read_text()


def test_a_signal_ends_the_processes_and_the_call(plan, monkeypatch):
    stub(monkeypatch, f"os.kill({os.getpid()}, 15); time.sleep(600)")
    failed, stopped, _ = trained(plan, 1)
    assert failed == []
    assert stopped == signal.SIGTERM


@pytest.mark.slow
def test_a_killed_study_has_the_table_of_a_quiet_one(tmp_path):
    assert kill.study(tmp_path, 3, steps=20) == 0


def hold(run, pipe):
    with running.lock_of(run):
        pipe.send(True)
        time.sleep(600)


def test_one_process_has_a_run_until_it_dies(tmp_path):
    run = run_of(tmp_path, "variant", 3)
    fork = multiprocessing.get_context("fork")
    here, there = fork.Pipe()
    holder = fork.Process(target=hold, args=(run, there))
    holder.start()
    assert here.recv()
    assert not running.is_free(run)
    running.main(str(tmp_path), run.variant, str(run.seed), "cpu", "")
    assert not run.failed
    holder.kill()
    holder.join()
    assert running.is_free(run)
