"""Figure: training curves of runs."""

from qgs_viewer.curves import curves_figure
from qgs_viewer.figures.exhibits import Exhibition, NothingToShowError
from qgs_viewer.figures.paper import WIDTH, Made, paper_style


def made(show: Exhibition) -> Made:
    """Loss and PSNR of the training views. Raises NothingToShowError where no run has a history."""
    curves = {e.name: e.curves for e in show.exhibits if e.curves is not None}
    without = [e.name for e in show.exhibits if e.curves is None]
    missing = f"{', '.join(without)}: no history.jsonl beside the checkpoint, so no training curve"
    if not curves:
        raise NothingToShowError(f"{missing}; run folders of `qgs train` have one")
    caption = (
        "Training loss and PSNR of the training views by seconds, or where a training took over "
        "two hours by steps: records of the history pale, their running mean strong."
        + (f" {missing}." if without else "")
    )
    with paper_style():
        figure = curves_figure(curves)
    figure.set_size_inches(WIDTH, 2.3)
    return Made(figure, caption)
