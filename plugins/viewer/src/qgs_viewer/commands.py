"""`qgs view`."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from qgs.cli.options import Device, Size, parse_size
from qgs.wording import listed

app = typer.Typer(help="See a reconstruction in the browser.")


@app.command()
def view(
    source: Annotated[
        str,
        typer.Argument(
            help="Run folder, checkpoint, PLUGIN/NAME, PLY, or what qgs reconstruct wrote."
        ),
    ],
    photos: Annotated[
        str | None,
        typer.Argument(help="Photos and cameras for a model; default: the data of its recipe."),
    ] = None,
    scene: Annotated[
        str | None, typer.Option(help="Name of the scene, where there are several.")
    ] = None,
    inputs: Annotated[
        int | None, typer.Option(min=1, help="Number of input views; default: the recipe's.")
    ] = None,
    frames: Annotated[
        str | None, typer.Option(help="Input photos, by number or file name, such as 0,8,x.jpg.")
    ] = None,
    size: Size = None,
    overrides: Annotated[
        list[str] | None,
        typer.Option("--set", help="Override of `views`, such as views.scale=auto; repeatable."),
    ] = None,
    html: Annotated[
        Path | None, typer.Option(help="Write the scene as one HTML page instead of serving it.")
    ] = None,
    host: Annotated[
        str, typer.Option(help="Address to serve at; 0.0.0.0 lets other machines see it.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port; the next free one.")] = 8080,
    device: Device = "auto",
) -> None:
    """Turn a reconstruction, pick a query, see its anchor layer by layer and what it reads."""
    if foreign := [text for text in overrides or () if not text.startswith("views.")]:
        raise ValueError(f"--set changes `views` alone here, got {listed(foreign)}: leave it out")
    pixels = parse_size(size)

    from qgs.engine.distributed import choose_device
    from qgs_viewer.sources import Wanted, open_source

    console = Console()
    wanted = Wanted(photos, scene, frames, inputs, pixels, overrides or (), choose_device(device))
    opened = open_source(source, wanted)
    for note in opened.notes:
        console.print(note, soft_wrap=True, highlight=False, markup=False)
    if html is not None:
        from qgs.io.files import write_text
        from qgs_viewer.page import scene_html

        write_text(html, scene_html(opened.look(opened.frames)))
        console.print(f"wrote {html}", soft_wrap=True)
        return

    from qgs_viewer.panel import Panel
    from qgs_viewer.server import quiet_server

    with quiet_server(host, port, opened.title) as server:
        Panel(server, opened)
        name = "localhost" if host in {"127.0.0.1", "0.0.0.0"} else host
        where = f"http://{name}:{server.get_port()}"
        console.print(f"{opened.title}: {where} (Ctrl-C ends it)", soft_wrap=True, highlight=False)
        with suppress(KeyboardInterrupt):
            server.sleep_forever()
