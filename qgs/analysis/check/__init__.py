"""check.html: what `qgs data check` found, with pictures of cameras and of the worst pairs."""

from qgs.analysis.check.page import check_html

__all__ = ["check_html"]
