"""`qgs view`."""

from __future__ import annotations

import socket
import webbrowser
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from qgs.cli.options import (
    Device,
    Frames,
    Inputs,
    Scale,
    SceneName,
    Size,
    Threads,
    ViewsSettings,
    parse_size,
    scale_settings,
    use_threads,
)
from qgs.wording import listed

if TYPE_CHECKING:
    from qgs_viewer.look import Look

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
        typer.Argument(
            help="Photos or a video for a model; default: its recipe's data, of shipped models an "
            "unseen room."
        ),
    ] = None,
    scene: SceneName = None,
    inputs: Inputs = None,
    frames: Frames = None,
    size: Size = None,
    scale: Scale = None,
    overrides: ViewsSettings = None,
    query: Annotated[
        int | None, typer.Option(min=0, help="Query that is picked at first; default: none.")
    ] = None,
    html: Annotated[
        Path | None,
        typer.Option(
            help="Write the scene as one new HTML page to turn; serve nothing. Queries cannot be "
            "picked in it: --query chooses one."
        ),
    ] = None,
    host: Annotated[
        str, typer.Option(help="Address to serve at; 0.0.0.0 lets other machines see it.")
    ] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port, or the next free one.")] = (
        8080
    ),
    show: Annotated[
        bool, typer.Option("--open/--no-open", help="Open it in the browser of this machine.")
    ] = True,
    threads: Threads = None,
    device: Device = "auto",
) -> None:
    """Turn a reconstruction in the browser, pick a query, see its anchor and what it reads.

    Anchors are shown layer by layer, and the input photos can be changed.
    """
    if foreign := [text for text in overrides or () if not text.startswith("views.")]:
        raise ValueError(f"--set changes `views` alone here, got {listed(foreign)}: leave it out")
    pixels = parse_size(size)

    from qgs.files import refuse_existing, write_text
    from qgs.train.distributed import choose_device
    from qgs_viewer.sources import Wanted, open_source

    if html is not None:
        refuse_existing(html)
    use_threads(threads)
    console = Console()
    settings = [*(overrides or ()), *scale_settings(scale)]
    wanted = Wanted(photos, scene, frames, inputs, pixels, settings, choose_device(device))
    opened = open_source(source, wanted)
    for note in opened.notes:
        console.print(note, soft_wrap=True, highlight=False, markup=False)
    if html is not None:
        from qgs_viewer.choice import Choice
        from qgs_viewer.page import scene_html

        look = opened.look(opened.frames)
        refuse_missing(query, look)
        page = scene_html(look, Choice(query=query, layer=look.depth))
        refuse_existing(html)
        write_text(html, page)
        console.print(f"wrote {html}", soft_wrap=True)
        if look.queries:
            console.print("--query picks a query in it; without --html the viewer does.")
        return

    from qgs_viewer.panel import Panel
    from qgs_viewer.server import quiet_server

    with quiet_server(host, port, opened.title) as server:
        panel = Panel(server, opened)
        refuse_missing(query, panel.look)
        if query is not None:
            panel.pick(query)
        name, port = {"127.0.0.1": "localhost"}.get(host, host), server.get_port()
        where = f"http://{socket.gethostname() if host == '0.0.0.0' else name}:{port}"
        text = f"{opened.title}: {where} (Ctrl-C ends it)"
        console.print(text, soft_wrap=True, highlight=False, markup=False)
        if show:
            webbrowser.open(where)
        with suppress(KeyboardInterrupt):
            server.sleep_forever()


def refuse_missing(query: int | None, look: Look) -> None:
    """Raise ValueError for a query that `look` does not have."""
    if query is not None and query >= look.queries:
        there = f"there are 0 to {look.queries - 1}" if look.queries else "no query is known of it"
        raise ValueError(f"--query {query} cannot be picked: {there}")
