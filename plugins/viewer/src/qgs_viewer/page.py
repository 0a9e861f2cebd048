"""The scene as one HTML page that needs no network: for reports, mails, talks."""

from collections.abc import Iterable, Mapping

from qgs.drawing import page_environment
from qgs.types import Gaussians, Views
from qgs_viewer.choice import Choice
from qgs_viewer.look import NEUTRAL, Background, Look
from qgs_viewer.server import quiet_server, stand
from qgs_viewer.stage import Stage, distance_to

_DATA = '__VISER_EMBED_DATA__="'
# Pages of file://, and frames in them, may not have workers of blobs, which Chromium reports only
# after the worker was made. viser makes another one where that fails at once; without a worker
# it never sorts Gaussians anew.
_WORKERS = """<script>
if (origin === "null") window.Worker = class extends Worker {
  constructor(url, options) {
    if (String(url).startsWith("blob:")) throw new Error("no workers of blobs here");
    super(url, options);
  }
};
</script>"""

_RECORD = """<script>
addEventListener("DOMContentLoaded", () => {
  const button = document.createElement("button");
  button.id = "record";
  button.textContent = "record";
  button.style = "position: fixed; left: 1em; bottom: 1em; z-index: 99";
  let film = null;
  button.onclick = () => {
    if (film) return film.stop();
    const drawn = document.querySelector("canvas[data-engine]");  // the other is an overlay
    const mimeType = ["video/mp4", "video/webm"].find(kind => MediaRecorder.isTypeSupported(kind));
    if (!drawn || !mimeType) return;  // the scene is still being read
    const file = `scene.${mimeType.slice(6)}`;
    film = new MediaRecorder(drawn.captureStream(), {mimeType, videoBitsPerSecond: 2e7});
    film.ondataavailable = ({data}) => {
      const link = document.createElement("a");
      link.href = URL.createObjectURL(data);
      link.download = file;
      link.click();
      film = null;
      button.textContent = "record";
    };
    film.start();
    button.textContent = `stop, and save ${file}`;
  };
  document.body.append(button);
});
</script>"""


def scene_html(
    look: Look, choice: Choice | None = None, *, dark: bool = False, start: Look | None = None
) -> str:
    """A page on which `look` can be turned, and that records it: 0.8 MB, and 40 bytes a Gaussian.

    choice: by default the scene with the anchors of the last layer. start: look that gives the
    first view and the size of photos, by default its own.
    """
    start = start or look
    with quiet_server() as server:
        stand(server, start)
        choice = choice or Choice(layer=look.depth)
        Stage(server.scene).put(look, choice, unit=distance_to(start))
        page = server.get_scene_serializer().as_html(dark)
    return page.replace("<head>", f"<head>{_WORKERS}{_RECORD}", 1)


def scenes_html(looks: Mapping[str, Look], choices: Mapping[str, Choice] | None = None) -> str:
    """A page of scenes side by side, by name, all seen from `shared_start` at first.

    choices: by default as in `scene_html`. The page holds viser's code once, and is dark where the
    page or the system around it is.
    """
    start = shared_start(looks.values())
    chosen = choices or {}
    pages = [
        scene_html(look, chosen.get(name), start=start).partition(_DATA)
        for name, look in looks.items()
    ]
    data, ends = zip(*(rest.split('"', 1) for _, _, rest in pages), strict=True)
    shell = (pages[0][0] + _DATA, '"' + ends[0])
    template = page_environment("qgs_viewer").get_template("scenes.html")
    return template.render(shell=shell, scenes=[*zip(looks, data, strict=True)])


def gaussians_html(gaussians: Gaussians, views: Views, background: Background = NEUTRAL) -> str:
    """A page of Gaussians (1, G) and the cameras of some photos (1, V) in their world."""
    frames = range(views.images.shape[1])
    return scene_html(Look(gaussians, views, [""] * len(frames), frames, background=background))


def shared_start(looks: Iterable[Look]) -> Look:
    """Whose first view shows all of `looks` well: the one that is nearest to its cameras."""
    return min(looks, key=distance_to)
