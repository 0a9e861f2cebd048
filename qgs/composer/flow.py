"""requires and provides, followed in the order in which a forward pass runs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

from qgs.composer.decode import Chosen
from qgs.composer.errors import Problems
from qgs.composer.nodes import Path
from qgs.composer.providers import fix_mismatch, fix_unmet
from qgs.composer.registry import Registry
from qgs.composer.slots import LAYER_SLOTS
from qgs.contracts import Fields, FieldSpec, Supervision


@dataclass(frozen=True)
class Step:
    """One component's turn. layer: None in the decoder's own course, else the decoded layer."""

    chosen: Chosen | None
    layer: int | None = None


def decoded_layers(chosen: Chosen | None, depth: int) -> set[int]:
    """Numbers of the layers that are decoded: the supervised ones and the last."""
    if chosen is None:
        return {depth}
    supervision = chosen.component(chosen.config)  # type: ignore[call-arg]
    assert isinstance(supervision, Supervision)
    return {*supervision.weights(), depth}


def execution_order(
    parts: Mapping[Path, Chosen | None], depth: int, decoded: set[int]
) -> Iterator[Step]:
    """Every component's turn in a training step."""
    yield Step(parts["model", "encoder"])
    yield Step(parts["model", "queries"])
    for index in range(depth):
        for name in LAYER_SLOTS:
            yield Step(parts["model", "decoder", "layers", str(index), name])
        if index + 1 in decoded:
            for name in ("head", "centers", "renderer"):
                yield Step(parts["model", name], index + 1)
            for path, loss in parts.items():
                if path[0] == "losses":
                    yield Step(loss, index + 1)


def check_flow(steps: Sequence[Step], registry: Registry, problems: Problems) -> None:
    """Report fields that are read before they are written, or not as they are written.

    After a component that could not be decoded nothing is reported as missing: it might have
    provided it.
    """
    written: dict[str, tuple[FieldSpec, Chosen]] = {}
    branch, layer, uncertain = dict(written), None, False
    for position, step in enumerate(steps):
        if step.layer is None:
            fields = written
        else:
            if step.layer != layer:
                branch, layer = dict(written), step.layer
            fields = branch
        if step.chosen is None:
            uncertain = True
            continue
        _check_step(steps, position, fields, uncertain, registry, problems)
        lacking = set(_requires(step.chosen)) - set(fields)
        for name, spec in step.chosen.component.provides(step.chosen.config).items():
            if name not in lacking:
                fields[name] = (spec, step.chosen)


def _check_step(
    steps: Sequence[Step],
    position: int,
    fields: Mapping[str, tuple[FieldSpec, Chosen]],
    uncertain: bool,
    registry: Registry,
    problems: Problems,
) -> None:
    chosen = steps[position].chosen
    assert chosen is not None
    missing = {n: spec for n, spec in _requires(chosen).items() if n not in fields}
    if missing and not uncertain:
        before = [step.chosen for step in steps[:position] if step.chosen]
        after = [step.chosen for step in steps[position + 1 :] if step.chosen]
        fix = fix_unmet(missing, chosen, before, registry)
        problems.add(
            chosen.place.origin, chosen.written_at, _why_unmet(missing, chosen, after), fix
        )
    for name, spec in _requires(chosen).items():
        if name in fields and fields[name][0] != spec:
            found, writer = fields[name]
            reason = (
                f"`{chosen.type}` reads {name} as {spec}, "
                f"`{writer.type}` at {writer.written_at} writes it as {found}"
            )
            problems.add(
                chosen.place.origin, chosen.written_at, reason, fix_mismatch(chosen, writer)
            )


def _why_unmet(missing: Fields, chosen: Chosen, after: Sequence[Chosen]) -> str:
    named = " and ".join(f"{name} ({spec})" for name, spec in missing.items())
    reason = f"`{chosen.type}` needs {named}, which nothing before it provides"
    for name in missing:
        later = next((c for c in after if _originates(c, name)), None)
        if later:
            what = "it" if len(missing) == 1 else name
            reason += f"; `{later.type}` at {later.written_at} provides {what} too late"
    return reason


def _requires(chosen: Chosen) -> Fields:
    return chosen.component.requires(chosen.config)


def _originates(chosen: Chosen, name: str) -> bool:
    """Whether `chosen` provides a field without needing it itself."""
    return name in chosen.component.provides(chosen.config) and name not in _requires(chosen)
