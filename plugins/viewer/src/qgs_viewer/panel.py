"""The controls beside the scene: what is shown, which query, which input photos."""

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from threading import RLock
from typing import Any, get_args

import numpy as np
import viser

from qgs.reconstruction.scenes import frame_list
from qgs_viewer.choice import Choice, Others, anchor_colors, painted
from qgs_viewer.look import Look
from qgs_viewer.pictures import PARTS, attention_pictures_of, sheet
from qgs_viewer.placement import hit, near_ray
from qgs_viewer.server import stand
from qgs_viewer.sources import ModelSource, Source
from qgs_viewer.stage import Stage

MOST_BOXES = 24  # photos that each have a check box; more are named in a line of text
PHOTO_SIDE = 192  # pixels on the longer side of photos that show attention
NONE = -1  # in the field `query` while none is picked
_CAPTIONS = {
    "content": "content: logits of what patches show",
    "geometry": "geometry: what rays and anchor add",
    "result": "result: softmax of the sum",
}


class Panel:
    """The viewer of one source: its scene, its controls, and what is chosen in them."""

    def __init__(self, server: viser.ViserServer, source: Source) -> None:
        self.server, self.source = server, source
        self.stage = Stage(server.scene)
        self.look: Look = source.look(source.frames)
        self.choice = Choice(layer=self.look.depth)
        self._lock, self._resetting = RLock(), False
        server.gui.configure_theme(show_logo=False, show_share_button=False)
        server.gui.main_panel.dock_right()
        stand(server, self.look)
        self._head()
        if self.look.queries:
            self._query()
        if source.labels:
            self._inputs()
        if source.notes:
            with server.gui.add_folder("remarks", expand_by_default=False):
                server.gui.add_markdown("\n\n".join(map(plain, source.notes)))
        self.stage.put(self.look, self.choice, source.cameras())
        if self.look.queries:
            server.scene.on_click()(self._clicked)

    def _head(self) -> None:
        gui, queries = self.server.gui, self.look.queries
        text = f"**{plain(self.source.title)}**\n\n{self.look.gaussians.count:,} Gaussians"
        if queries:
            text += f" of {queries:,} queries. Click on one (or on an anchor), or type its number; "
            text += "Esc, or a click beside everything, shows all again."
        gui.add_markdown(text)
        if queries:
            names = ("of the scene", "by query")
            self.colors = gui.add_dropdown("colours", names, initial_value=names[0])
            self._on(self.colors, lambda: {"by_query": self.colors.value == names[1]})
        if self.look.views is not None:
            self.photos = gui.add_checkbox("cameras", True)
            self._on(self.photos, lambda: {"photos": self.photos.value})

    def _query(self) -> None:
        gui, depth = self.server.gui, self.look.depth
        with gui.add_folder("query"):
            last = self.look.queries - 1
            hint = f"0 to {last}, or {NONE} for all"
            self.number = gui.add_number("query", NONE, min=NONE, max=last, step=1, hint=hint)
            self._on(self.number, self._picked)
            self.everything = gui.add_button("Show all (Esc)", visible=False)
            self.everything.on_click(lambda _: self.pick(None))
            escape = gui.add_command("Show all queries", hotkey="escape")
            escape.on_trigger(lambda _: self.pick(None))
            self.others = gui.add_dropdown("other queries", get_args(Others), initial_value="faint")
            self._on(self.others, lambda: {"others": self.others.value})
            hint = "Supports are those after this layer; 0 is the start."
            self.layer = gui.add_slider("layer", 0, depth, 1, depth, hint=hint)
            self._on(self.layer, lambda: {"layer": int(self.layer.value)})
            hint = "Lines to the patches that the query attends to most; broad and strong is much."
            self.patches = gui.add_slider("patches", 0, 96, 1, self.choice.patches, hint=hint)
            self._on(self.patches, lambda: {"patches": int(self.patches.value)})
            if self.look.support(0) is not None:
                self.anchors = gui.add_checkbox("all anchors", True)
                self._on(self.anchors, lambda: {"anchors": self.anchors.value})
            self._text = gui.add_markdown("")
            blank = np.full((8, 8, 3), 255, np.uint8)
            add = partial(gui.add_image, blank, visible=False, format="png")
            self.pictures = {part: add(label=_CAPTIONS[part]) for part in PARTS}

    def _picked(self) -> dict[str, Any]:
        """What is typed arrives key by key: numbers that no query has change nothing."""
        number = int(self.number.value)
        if number == NONE:
            return {"query": None}
        return {"query": number} if 0 <= number < self.look.queries else {}

    def _inputs(self) -> None:
        gui, labels = self.server.gui, self.source.labels
        self.boxes: list[Any] = []
        with gui.add_folder("reconstructed from"):
            if len(labels) <= MOST_BOXES:
                gui.add_markdown("Ticked photos are the inputs. Tick others to change them.")
                chosen = set(self.source.frames)
                self.boxes = [gui.add_checkbox(x, f in chosen) for f, x in enumerate(labels)]
                for box in self.boxes:
                    box.on_update(self._reframed)
            else:
                text = ",".join(map(str, self.source.frames))
                hint = f"Numbers or file names, commas between; 0 to {len(labels) - 1}."
                self.frames = gui.add_text("input photos", text, hint=hint)
                gui.add_button("Reconstruct").on_click(self._reframed)

    def _on(self, control: Any, change: Callable[[], dict[str, Any]]) -> None:
        @control.on_update
        def _(event: Any) -> None:
            with self._lock:
                self.choose(**change())

    def choose(self, **changes: Any) -> None:
        """Change the choice (see `Choice`) and draw it."""
        with self._lock:
            choice = replace(self.choice, **changes)
            if choice == self.choice:
                return
            with self.server.atomic():
                self.stage.update(self.look, choice)
                self._read(self.look, choice)
            self.choice = choice

    def pick(self, query: int | None) -> None:
        """Pick a query, or none: then all are shown."""
        self.number.value = NONE if query is None else query  # calls back

    def take(self, frames: Sequence[int]) -> None:
        """Reconstruct from these frames. Raises ValueError where they do not fit, and OSError."""
        with self._lock:
            if tuple(frames) == tuple(self.look.frames):
                return
            look = self.source.look(frames)
            with self.server.atomic():
                self.stage.put(look, self.choice, self.source.cameras())
                self._read(look, self.choice)
            self.look = look

    def _read(self, look: Look, choice: Choice) -> None:
        """The attention of the picked query, and where it stands."""
        if not look.queries:
            return
        query, layer = choice.query, choice.layer
        found = {} if query is None else attention_pictures_of(look, query, layer, PHOTO_SIDE)
        for part, handle in self.pictures.items():
            handle.visible = part in found
            if part in found:
                handle.image = sheet(found[part])
        self.everything.visible = query is not None
        self._text.content = "" if query is None else description(look, query, layer)

    def _reframed(self, event: Any) -> None:
        """Reconstruct from the chosen photos; if they do not fit, reset the boxes, not the text."""
        with self._lock:
            if self._resetting:
                return
            try:
                if self.boxes:
                    self.take([frame for frame, box in enumerate(self.boxes) if box.value])
                else:
                    assert isinstance(self.source, ModelSource)
                    self.take(frame_list(self.frames.value, "frames", self.source.scene))
            except (ValueError, OSError) as error:
                self._resetting = True
                for frame, box in enumerate(self.boxes):
                    box.value = frame in self.look.frames
                self._resetting = False
                if event.client is not None:
                    event.client.add_notification("Not reconstructed", str(error), color="red")

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        with self._lock:
            query = self.under(np.array(event.ray_origin), np.array(event.ray_direction))
            self.pick(query)

    def under(self, origin: np.ndarray, direction: np.ndarray) -> int | None:
        """The query under a ray of what is shown: by its anchor, or by its Gaussians."""
        found = self.look.support(self.choice.layer) if self.choice.anchors else None
        if found is not None:
            numbers, _ = anchor_colors(self.look, self.choice)
            centers = found.centers[0].numpy()[numbers]
            anchor = near_ray(centers, origin, direction, self.stage.anchor_radius)
            if anchor is not None:
                return int(numbers[anchor])
        gaussian = hit(painted(self.look, self.choice), origin, direction)
        return None if gaussian is None else self.look.query_of(gaussian)


def plain(text: str) -> str:
    """`text` as Markdown that shows it as it is: no HTML, no formats, one line."""
    return re.sub(r"[^\w\s]|_", lambda sign: f"&#{ord(sign[0])};", " ".join(text.split()))


def description(look: Look, query: int, layer: int) -> str:
    """A query's Gaussians, its anchor after a layer, and why no attention is shown, as Markdown."""
    members, lines = look.members(query), [f"**query {query}**, layer {layer}"]
    lines.append(f"Gaussians {members.start} to {members.stop - 1}")
    found = look.support(layer)
    if found is not None:
        x, y, z = found.centers[0, query].tolist()
        sizes = found.axes[0, query].norm(dim=0).tolist()
        shape = f"radius {sizes[0]:.3f}"
        if max(sizes) > 1.001 * min(sizes):
            shape = "semi-axes " + ", ".join(f"{size:.3f}" for size in sizes)
        lines.append(f"anchor at {x:.3f}, {y:.3f}, {z:.3f}; {shape}")
        if layer and (before := look.support(layer - 1)) is not None:
            moved = (found.centers[0, query] - before.centers[0, query]).norm()
            lines.append(f"moved by {float(moved):.3f} in this layer")
    if layer and look.attention(query, layer) is None:
        patches = look.inside is None or look.inside.memory.grid is not None
        silent = "this component does not report its attention"
        lines.append(silent if patches else "it reads latents, not patches of the photos")
    return "\n\n".join(lines)
