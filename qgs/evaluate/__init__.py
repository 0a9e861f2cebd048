"""Evaluation: which views are judged, by which protocol, and the scores."""
