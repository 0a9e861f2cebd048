"""Show reconstructions and their queries: a viewer in the browser, reports, figures for papers."""
