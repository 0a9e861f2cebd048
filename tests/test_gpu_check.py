"""The script for machines with a GPU, as far as it can be run without one."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import gpu_attention
import gpu_check
import pytest
import torch
import typer
from gpu_check import Step, run_all, steps
from typer.core import TyperGroup

from qgs.cli import app

SCRIPT = Path(__file__).parents[1] / "tools/gpu_check.sh"


def test_what_fails_or_hangs_is_recorded_and_the_others_go_on(tmp_path: Path) -> None:
    write = "import json; json.dump({'recipes': []}, open('found.json', 'w'))"
    found = [
        Step("breaks", [sys.executable, "-c", "import sys; print('so bad'); sys.exit(3)"]),
        Step("hangs", [sys.executable, "-c", "import time; time.sleep(60)"], limit=1),
        Step("is missing", ["no-such-program"]),
        Step("works", [sys.executable, "-c", write], result="found.json"),
    ]
    done = run_all(found, tmp_path)
    assert [one.code for one in done] == [3, None, 127, 0]
    report = json.loads((tmp_path / "report.json").read_text())
    assert [one["passed"] for one in report["steps"]] == [False, False, False, True]
    assert report["steps"][3]["found"] == {"recipes": []}
    text = (tmp_path / "report.md").read_text()
    assert "| works | passed |" in text
    assert "so bad" in text
    assert "ran past its limit" in text
    assert "## works" not in text


def test_every_command_of_qgs_is_one(tmp_path: Path) -> None:
    names = [step.name for step in steps(tmp_path)]
    assert len({*names}) == len(names) > 15
    tried = 0
    for step in steps(tmp_path):
        if step.command[0] == "qgs":
            command: typer.core.TyperGroup = typer.main.get_command(app)  # type: ignore[assignment]
            context = command.make_context("qgs", [*step.command[1:]])
            assert isinstance(command, TyperGroup)
            rest = [*context._protected_args, *context.args]
            name, command, rest = command.resolve_command(context, rest)
            command.make_context(name, rest, parent=context)
            tried += 1
    assert tried > 10


def test_the_tables_of_the_report(tmp_path: Path) -> None:
    seconds = {"median": 0.01, "ratio": {"median": 1.2}}
    measured = {
        "recipe": "locus", "precision": "bf16", "seconds": {"forward": seconds, "step": seconds},
        "memory": {"step": {"peak_bytes": 100 * 2**20}},
    }  # fmt: skip
    counted = [
        {"recipe": name, "precision": "bf16", "step": {}, "tensor_bytes": 90 * 2**20}
        for name in ("locus", "tokengs")
    ]
    found = {"latency, x": [measured], "predicted memory": counted}
    made = []
    for number, (name, recipes) in enumerate(found.items()):
        command = f"import json; json.dump({{'recipes': {recipes}}}, open('{number}.json', 'w'))"
        made.append(Step(name, [sys.executable, "-c", command], result=f"{number}.json"))
    run_all(made, tmp_path)
    text = (tmp_path / "report.md").read_text()
    assert "The paper's ratio is 1.19." in text
    assert "| locus | 10.00 | 1.200 | 10.00 | 1.200 |" in text
    assert "| locus | bf16 | 90 | 100 | -10.0 % |" in text
    assert "| tokengs | bf16 | 90 |  |  |" in text


def test_what_is_measured_is_predicted_by_the_same_names(tmp_path: Path) -> None:
    found = {"--memory": set(), "--predict": set()}
    for step in steps(tmp_path):
        for option, names in found.items():
            if option in step.command:
                words = [*step.command]
                at = words.index("--precision") + 1 if "--precision" in words else None
                precision = words[at] if at else "float32"
                names |= {(word, precision) for word in words if word.endswith(".yaml")}
    assert found["--memory"] == found["--predict"] != set()


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_it_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    command = ["bash", str(SCRIPT), str(tmp_path), str(tmp_path / "out")]
    done = subprocess.run(command, capture_output=True, text=True, env={"PYTHON": sys.executable,
                          "PATH": "/usr/bin:/bin"})  # fmt: skip
    assert done.returncode == 2
    assert "finds no GPU" in done.stderr
    assert not (tmp_path / "out").exists()
    monkeypatch.setattr(sys, "argv", ["gpu_check.py", str(tmp_path / "out")])
    assert gpu_check.main() == 2
    wrong = subprocess.run(["bash", str(SCRIPT)], capture_output=True, text=True)
    assert wrong.returncode == 64
    assert "WHEELS must be a folder" in wrong.stderr


def _attention(monkeypatch: pytest.MonkeyPatch, file: Path) -> tuple[int, list[dict[str, str]]]:
    words = ("--device", "cpu", "--size", "32x64", "--heads", "2", "--json", str(file))
    monkeypatch.setattr(sys, "argv", ["gpu_attention.py", *words])
    with pytest.raises(SystemExit) as ended:
        gpu_attention.main()
    return int(ended.value.code or 0), json.loads(file.read_text())["rows"]


def test_kernels_of_attention_are_held_against_float64(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    cases = gpu_attention.CASES.items()
    small = {n: replace(c, queries=min(c.queries, 60), tokens=min(c.tokens, 250)) for n, c in cases}
    monkeypatch.setattr(gpu_attention, "CASES", small)
    code, (unbiased, plain, blocks) = _attention(monkeypatch, tmp_path / "a.json")
    assert code == 0
    for row in (plain, blocks):
        for dtype, tolerance in gpu_attention.TOLERANCES.items():
            error = float(row[f"error, {str(dtype).removeprefix('torch.')}"].split()[0])
            assert tolerance / 100 < error <= tolerance
    assert [row["kernel"] for row in (unbiased, plain, blocks)] == ["no bias", "plain", "blocks"]


def test_a_kernel_that_is_wrong_or_fails_is_in_the_report(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = gpu_attention.biased_attention

    def wrong(*given: Any) -> torch.Tensor:
        q, k, v, bias, kernel = given
        return real(q, k, v * (1 + 1e-4 * (kernel == "plain")), bias, kernel)

    monkeypatch.delenv("TRITON_INTERPRET", raising=False)
    monkeypatch.setattr(gpu_attention, "biased_attention", wrong)
    monkeypatch.setattr(gpu_attention, "TOLERANCES", {torch.float32: 1e-5})
    cases = {name: case for name, case in gpu_attention.CASES.items() if name.endswith("query")}
    monkeypatch.setattr(gpu_attention, "CASES", cases)
    monkeypatch.setitem(gpu_attention.KERNELS, "cpu", ("plain",))
    code, (_, plain) = _attention(monkeypatch, tmp_path / "a.json")
    assert code == 1
    assert plain["error, float32"].startswith("1.0e-04 (")
    monkeypatch.setitem(gpu_attention.KERNELS, "cpu", ("triton", "blocks"))
    code, (_, triton, blocks) = _attention(monkeypatch, tmp_path / "a.json")
    assert code == 1
    assert "ValueError: the Triton kernel of attention cannot be used" in triton["failed"]
    assert "ms" not in triton
    assert float(blocks["error, float32"].split()[0]) < 1e-5
    assert "ms" in blocks
