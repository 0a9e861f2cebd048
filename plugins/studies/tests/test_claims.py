"""Claims: one process has a run, the dead lose theirs, the living keep them."""

import json
import os
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import pytest
from qgs_studies import claims
from qgs_studies.claims import Claim, host, owner, take
from qgs_studies.plan import Run, run_of


def never() -> None:
    pytest.fail("the claim was lost")


@pytest.fixture
def run(tmp_path: Path) -> Run:
    return run_of(tmp_path, "variant", 3)


def files(run: Run) -> list[str]:
    return sorted(path.name for path in run.folder.parent.iterdir())


def test_a_claimed_run_is_free_again_when_it_was_released(run: Run) -> None:
    claim = take(run, never)
    assert claim
    assert owner(run) == f"pid {os.getpid()} on {host()}"
    assert take(run, never) is None
    claim.release()
    assert owner(run) is None
    again = take(run, never)
    assert again
    again.release()
    assert files(run) == ["seed-3.claim-1", "seed-3.claim-2"]
    last = take(run, never)
    assert last
    last.release()
    assert files(run) == ["seed-3.claim-2", "seed-3.claim-3"]


def test_a_heart_goes_on_when_the_folder_was_away(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    beaten = threading.Event()
    tries = iter([OSError(116, "Stale file handle"), None])

    def touch(path: Path) -> None:
        if error := next(tries, None):
            raise error
        beaten.set()

    monkeypatch.setattr(claims, "BEAT_SECONDS", 0.01)
    monkeypatch.setattr(os, "utime", touch)
    claim = take(run, never)
    assert claim
    assert beaten.wait(10)
    claim.release()


def test_of_many_at_once_one_has_it(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(claims, "BEAT_SECONDS", 60)
    for _ in range(20):
        won: list[Claim] = []
        gate = threading.Barrier(8)

        def grab(gate: threading.Barrier = gate, won: list[Claim] = won) -> None:
            gate.wait()
            if claim := take(run, never):
                won.append(claim)

        threads = [threading.Thread(target=grab) for _ in range(8)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert len(won) == 1
        won[0].release()


def test_a_dead_process_loses_its_run_at_once(run: Run) -> None:
    code = (
        "import os, sys; from pathlib import Path; from qgs_studies.claims import take;"
        "from qgs_studies.plan import run_of;"
        f"assert take(run_of(Path({str(run.folder.parents[2])!r}), 'variant', 3), print);"
        "os._exit(0)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    assert owner(run) is None
    claim = take(run, never)
    assert claim
    claim.release()


def written(run: Run, content: str, age: float) -> Path:
    run.folder.parent.mkdir(parents=True)
    path = run.folder.with_name("seed-3.claim-1")
    path.write_text(content)
    then = path.stat().st_mtime - age
    os.utime(path, (then, then))
    return path


@pytest.mark.parametrize("content", [json.dumps({"host": "another", "pid": 1}), ""])
def test_elsewhere_only_a_silent_heart_is_dead(run: Run, content: str) -> None:
    path = written(run, content, claims.STALE_SECONDS - 60)
    assert owner(run)
    assert take(run, never) is None
    then = path.stat().st_mtime - 120
    os.utime(path, (then, then))
    assert owner(run) is None
    assert take(run, never)


def test_who_was_taken_over_stops(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(claims, "BEAT_SECONDS", 0.02)
    stopped = threading.Event()
    stop: Callable[[], None] = stopped.set
    assert take(run, stop)
    assert not stopped.wait(0.1)
    run.folder.with_name("seed-3.claim-2").write_text("{}")  # another machine thought it dead
    assert stopped.wait(5)
