"""Controls of the viewer: what is shown, which query is picked, which photos are inputs."""

import re
import socket
import webbrowser
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from functools import partial
from threading import RLock
from typing import Any, get_args

import numpy as np
import viser
from rich.console import Console

from qgs.terminal import print_lines
from qgs_viewer.drawing import Choice, Drawing, Others, painted
from qgs_viewer.opening import FixedSource, Source
from qgs_viewer.page import harmonics_script, quiet_server, stand
from qgs_viewer.placement import Splats, hit
from qgs_viewer.queries import PARTS, attention_pictures_of, sheet
from qgs_viewer.query_scene import QueryScene

# Photos whose check boxes are seen at once; more would hide the other controls.
MOST_BOXES = 24
# Pixels on the longer side of photos that show attention.
PHOTO_SIDE = 192
# In the field `query` while none is picked.
NONE = -1


class Panel:
    """The viewer of one `Source`: its scene, its controls, and the user's choices."""

    def __init__(self, server: viser.ViserServer, source: Source) -> None:
        self.server = server
        self.source = source
        self.drawing = Drawing(server.scene)
        self.scene = source.scene_of(source.frames)
        self.choice = Choice(layer=self.scene.depth)
        # viser calls back from several threads, also while a control is set here
        self._lock = RLock()
        server.gui.configure_theme(show_logo=False, show_share_button=False)
        server.gui.main_panel.dock_right()
        stand(server, self.scene)
        self._add_head()
        if self.scene.queries:
            self._add_query()
        # a PLY has no photos to choose from
        if source.labels:
            self._add_inputs()
        if source.notes:
            with server.gui.add_folder("remarks", expand_by_default=False):
                server.gui.add_markdown("\n\n".join(map(plain, source.notes)))
        self.drawing.put(self.scene, self.choice)
        if self.scene.queries:
            server.scene.on_click()(self._clicked)

    def _add_head(self) -> None:
        gui = self.server.gui
        queries = self.scene.queries
        text = f"**{plain(self.source.title)}**\n\n{self.scene.gaussians.count:,} Gaussians"
        if queries:
            text += f" of {queries:,} queries. Click on a Gaussian or an anchor to pick its query, "
            text += "or type a query's number. Esc, or a click on the background, shows all again."
        gui.add_markdown(text)
        if queries:
            self._bind("by_query", gui.add_checkbox("colours by query", False))
        if self.scene.views is not None:
            self._bind("photos", gui.add_checkbox("cameras", True))

    def _add_query(self) -> None:
        gui = self.server.gui
        depth = self.scene.depth
        with gui.add_folder("query"):
            last = self.scene.queries - 1
            hint = f"0 to {last}, or {NONE} for all"
            self.number = gui.add_number("query", NONE, min=NONE, max=last, step=1, hint=hint)
            self.number.on_update(self._typed)
            escape = gui.add_command("Show all queries", hotkey="escape")
            escape.on_trigger(lambda _: self.pick(None))
            self._bind(
                "others",
                gui.add_dropdown("other queries", get_args(Others), initial_value="faint"),
            )
            hint = "Show anchors and attention of this decoder layer. 0: before the first layer."
            self.layer = gui.add_slider("layer", 0, depth, 1, depth, hint=hint)
            self._bind("layer", self.layer)
            hint = "Number of lines to the patches that the query attends to most."
            patches = gui.add_slider("patches", 0, 96, 1, self.choice.patches, hint=hint)
            self._bind("patches", patches)
            if self.scene.support(0) is not None:
                self._bind("anchors", gui.add_checkbox("all anchors", True))
            self._text = gui.add_markdown("")
            blank = np.full((8, 8, 3), 255, np.uint8)
            add = partial(gui.add_image, blank, visible=False, format="png")
            self.pictures = {part: add(label=label) for part, label in PARTS.items()}

    def _add_inputs(self) -> None:
        gui = self.server.gui
        labels = self.source.labels
        self.boxes: list[Any] = []
        with gui.add_folder("reconstructed from", expand_by_default=len(labels) <= MOST_BOXES):
            gui.add_markdown("Ticked photos are the inputs. Tick or untick photos to change them.")
            for frame, label in enumerate(labels):
                box = gui.add_checkbox(label, frame in self.source.frames)
                box.on_update(self._reframed)
                self.boxes.append(box)

    def _bind(self, name: str, control: Any) -> None:
        """Let `control` set the field `name` of `self.choice` whenever the user changes it."""
        control.on_update(lambda _: self.choose(**{name: control.value}))

    def _typed(self, event: Any) -> None:
        number = self.number.value
        if number == NONE:
            self.choose(query=None)
        # what is typed arrives key by key: numbers that no query has change nothing
        elif 0 <= number < self.scene.queries:
            self.choose(query=number)

    def choose(self, **changes: Any) -> None:
        """Change fields of `self.choice`, and draw again what depends on them."""
        with self._lock:
            choice = replace(self.choice, **changes)
            if choice != self.choice:
                self._show(self.drawing.update, self.scene, choice)

    def pick(self, query: int | None) -> None:
        """Pick the query with the index `query`; None shows all queries."""
        # setting the field calls `_typed`
        self.number.value = NONE if query is None else query

    def _show(self, draw: Callable[..., None], scene: QueryScene, choice: Choice) -> None:
        """Draw a scene, describe the picked query, and store `scene` and `choice`.

        If drawing fails, the stored scene and choice do not change.
        """
        with self.server.atomic():
            draw(scene, choice)
            if scene.queries:
                query = choice.query
                layer = choice.layer
                pictures = {}
                if query is not None:
                    pictures = attention_pictures_of(scene, query, layer, PHOTO_SIDE)
                for part, handle in self.pictures.items():
                    handle.visible = part in pictures
                    if part in pictures:
                        handle.image = sheet(pictures[part])
                self._text.content = "" if query is None else description(scene, query, layer)
        self.scene = scene
        self.choice = choice

    def _reframed(self, event: Any) -> None:
        """Reconstruct from the ticked photos, and show the result.

        If this fails, the last scene stays, and a notification in the browser gives the error.
        """
        with self._lock:
            frames = tuple(frame for frame, box in enumerate(self.boxes) if box.value)
            try:
                if frames != tuple(self.scene.frames):
                    self._show(self.drawing.put, self.source.scene_of(frames), self.choice)
            # the model cannot take these photos, or one is unreadable
            except (ValueError, OSError) as error:
                if event.client is not None:
                    event.client.add_notification("Not reconstructed", str(error), color="red")

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        with self._lock:
            query = self.under(np.array(event.ray_origin), np.array(event.ray_direction))
            self.pick(query)

    def under(self, origin: np.ndarray, direction: np.ndarray) -> int | None:
        """Return the query whose anchor or Gaussian a ray hits; None if the ray hits nothing.

        origin, direction: start and direction of the ray, both (3,) in the viewer's world. An
        anchor is hit before any Gaussian.
        """
        # anchors are drawn over Gaussians, so they are hit first
        found = self.scene.support(self.choice.layer) if self.choice.anchors else None
        if found is not None:
            centers = found.centers[0].numpy()
            # opaque, and nearly clear at the rim of their dots
            spread = (self.drawing.anchor_radius / 3) ** 2 * np.eye(3)
            covariances = np.broadcast_to(spread, (len(centers), 3, 3))
            dots = Splats(centers, covariances, np.ones((len(centers), 1)), centers)
            anchor = hit(dots, origin, direction)
            if anchor is not None:
                return anchor
        gaussian = hit(painted(self.scene, self.choice), origin, direction)
        return None if gaussian is None else self.scene.query_of(gaussian)


def serve(
    source: Source, query: int | None, host: str, port: int, show: bool, console: Console
) -> None:
    """Show `source` in the browser until Ctrl-C.

    query: index of the picked query; None shows all. show: whether to open the browser of this
    machine. Raises ValueError for a query that does not exist.
    """
    # the page of a model stays while the user chooses other Gaussians
    head = harmonics_script(source.fixed) if isinstance(source, FixedSource) else ""
    with quiet_server(host, port, source.title, head) as server:
        panel = Panel(server, source)
        panel.scene.refuse_missing(query)
        if query is not None:
            panel.pick(query)
        # others reach this machine by its name, not by the address that stands for all
        names = {"127.0.0.1": "localhost", "0.0.0.0": socket.gethostname()}
        # the wanted port may be taken, and then the server has chosen another
        address = f"http://{names.get(host, host)}:{server.get_port()}"
        print_lines(console, [f"{source.title}: {address} (Ctrl-C ends it)"])
        if show:
            webbrowser.open(address)
        # Ctrl-C is how a user ends it, no error
        with suppress(KeyboardInterrupt):
            server.sleep_forever()


def plain(text: str) -> str:
    """Escape `text` for Markdown: no HTML and no formatting, on one line."""
    return re.sub(r"[^\w\s]|_", lambda sign: f"&#{ord(sign[0])};", " ".join(text.split()))


def description(scene: QueryScene, query: int, layer: int) -> str:
    """Describe a query in Markdown: its Gaussians, and its anchor after `layer`.

    If the query's attention cannot be shown, the text says why.
    """
    members = scene.members(query)
    lines = [
        f"**query {query}**, layer {layer}",
        f"Gaussians {members.start} to {members.stop - 1}",
    ]
    found = scene.support(layer)
    if found is not None:
        place = ", ".join(f"{x:.3f}" for x in found.centers[0, query].tolist())
        sizes = ", ".join(f"{x:.3f}" for x in found.axes[0, query].norm(dim=0).tolist())
        lines.append(f"anchor at {place}; semi-axes {sizes}")
    if layer and scene.attention(query, layer) is None:
        patches = scene.inside is None or scene.inside.memory.grid is not None
        silent = "the model's decoder does not report its attention"
        lines.append(silent if patches else "the query attends to latents, not to photo patches")
    return "\n\n".join(lines)
