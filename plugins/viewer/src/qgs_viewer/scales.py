"""What reports say of searched scales, and of the options that help."""

from collections.abc import Collection

from qgs.reconstruction.scale import FoundScale
from qgs.wording import counted


def summary(found: Collection[FoundScale], option: str = "--scale FACTOR") -> str:
    """One line on the scales of one or several windows, and the option that sets another."""
    first, ordered = next(iter(found)), sorted(scale.factor for scale in found)
    text, seconds = first.text, sum(scale.seconds for scale in found)
    if len(found) > 1:
        poor = sum(bool(scale.poor) for scale in found)
        mean = sum(scale.psnr for scale in found) / len(found)
        text = (
            f"scale {ordered[0]:.3g} to {ordered[-1]:.3g}, found on the inputs and photos beside "
            f"them in {len(found)} windows: {mean:.1f} dB"
        ) + f", no scale fits {counted(poor, 'window')}" * bool(poor)
    return f"{text}, in {seconds:.1f} s" + f"; {option} sets another" * bool(option)
