"""Commands of qgs_photos. Heavy modules are imported when a command runs, so --help is fast."""


def refuse_no_time(option: str, value: float | None) -> None:
    """Raise ValueError if the value of a time option is infinite or not above 0; None passes."""
    if value is not None and not 0 < value < float("inf"):
        raise ValueError(f"{option} must be a finite time above 0, got {value:g}")
