"""Plug-in for looking at results: viewer in the browser, report pages, figures for papers."""
