"""The scene as one HTML page that needs no network: for reports, mails, talks."""

from collections.abc import Iterable, Mapping
from importlib.resources import files

from qgs.drawing import page_environment
from qgs.types import Gaussians, Views
from qgs_viewer.choice import Choice
from qgs_viewer.drawing import Drawing, distance_to
from qgs_viewer.query_scene import NEUTRAL, Background, QueryScene
from qgs_viewer.server import quiet_server, stand

DATA = '__VISER_EMBED_DATA__="'


def scene_html(
    scene: QueryScene,
    choice: Choice | None = None,
    start: QueryScene | None = None,
) -> str:
    """Return a page to turn `scene` and to record it: 0.8 MB, and 40 bytes a Gaussian.

    choice: by default the scene with the anchors of the last layer. start: scene that gives the
    first view and the size of photos, by default its own.
    """
    start = start or scene
    with quiet_server() as server:
        stand(server, start)
        choice = choice or Choice(layer=scene.depth)
        Drawing(server.scene).put(scene, choice, unit=distance_to(start))
        page = server.get_scene_serializer().as_html()
    head = files("qgs_viewer") / "template" / "head.html"
    # before viser's code, which reads what it changes
    return page.replace("<head>", f"<head>{head.read_text(encoding='utf-8')}", 1)


def scenes_html(scenes: Mapping[str, QueryScene], choices: Mapping[str, Choice]) -> str:
    """Return a page of scenes side by side, by name, all seen from `shared_start` at first.

    choices: for scenes without one as in `scene_html`. The page is dark where the page or the
    system around it is.
    """
    start = shared_start(scenes.values())
    data = {}
    shell = ("", "")
    for name, scene in scenes.items():
        before, _, rest = scene_html(scene, choices.get(name), start=start).partition(DATA)
        data[name], after = rest.split('"', 1)
        # all pages have the same code of viser, so one page holds it once
        shell = (before + DATA, '"' + after)
    template = page_environment("qgs_viewer").get_template("scenes.html")
    return template.render(shell=shell, scenes=[*data.items()])


def gaussians_html(gaussians: Gaussians, views: Views, background: Background = NEUTRAL) -> str:
    """Return a page of Gaussians (1, G) and the cameras of some photos (1, V) in their world."""
    return scene_html(QueryScene(gaussians, views, background=background))


def shared_start(scenes: Iterable[QueryScene]) -> QueryScene:
    """Return the scene whose first view shows all well: the one nearest to its cameras."""
    return min(scenes, key=distance_to)
