"""`qgs view`."""

from __future__ import annotations

import socket
import webbrowser
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from qgs.cli.options import SET_HELP, Device, Size, parse_size
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
            help="Photos and cameras for a model; default: its recipe's data, of shipped models an "
            "unseen room."
        ),
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
        typer.Option("--set", help=SET_HELP),
    ] = None,
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
    device: Device = "auto",
) -> None:
    """Turn a reconstruction in the browser, pick a query, see its anchor and what it reads.

    Anchors are shown layer by layer, and the input photos can be changed.
    """
    if foreign := [text for text in overrides or () if not text.startswith("views.")]:
        raise ValueError(f"--set changes `views` alone here, got {listed(foreign)}: leave it out")
    pixels = parse_size(size)

    from qgs.engine.distributed import choose_device
    from qgs.io.files import refuse_existing, write_text
    from qgs_viewer.sources import Wanted, open_source

    if html is not None:
        refuse_existing(html)
    console = Console()
    wanted = Wanted(photos, scene, frames, inputs, pixels, overrides or (), choose_device(device))
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
            console.print(
                "The page can be turned; to pick queries in it, leave out --html, or choose one "
                "for the page with --query.",
                soft_wrap=True, highlight=False,
            )  # fmt: skip
        return

    from qgs_viewer.panel import Panel
    from qgs_viewer.server import quiet_server

    with quiet_server(host, port, opened.title) as server:
        panel = Panel(server, opened)
        refuse_missing(query, panel.look)
        if query is not None:
            panel.pick(query)
        name = "localhost" if host in {"127.0.0.1", "0.0.0.0"} else host
        port = server.get_port()
        where = f"http://{name}:{port}"
        others = f", for other machines http://{_own_address()}:{port}" if host == "0.0.0.0" else ""
        text = f"{opened.title}: {where}{others} (Ctrl-C ends it)"
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


def _own_address() -> str:
    """The address that this machine has for others; its name where no network is up."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # sends nothing: it only chooses the way out
        except OSError:
            return socket.gethostname()
        return str(probe.getsockname()[0])
