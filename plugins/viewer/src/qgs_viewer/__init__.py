"""Viewer, reports and figures: reconstructions in the browser, report pages, figures for papers."""
