"""The scene as one HTML page that needs no network: for reports, mails, talks."""

from qgs_viewer.choice import Choice
from qgs_viewer.look import Look
from qgs_viewer.server import quiet_server, stand
from qgs_viewer.stage import Stage


def scene_html(look: Look, choice: Choice | None = None, *, dark: bool = False) -> str:
    """A page on which `look` can be turned: Gaussians, photos, anchors, and a picked query.

    choice: what is shown of it; by default the scene with the anchors of the last layer. Some
    0.7 MB for viser's own code, and about 25 bytes more a Gaussian.
    """
    with quiet_server() as server:
        stand(server, look)
        Stage(server.scene).put(look, choice or Choice(layer=look.depth))
        return server.get_scene_serializer().as_html(dark)
