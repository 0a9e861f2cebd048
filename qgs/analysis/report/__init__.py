"""report.html: what was trained and how it compares, in one self-contained page."""

from qgs.analysis.report.contents import Baseline, Contender, Report
from qgs.analysis.report.page import report_html

__all__ = ["Baseline", "Contender", "Report", "report_html"]
