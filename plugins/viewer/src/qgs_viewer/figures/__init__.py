"""Figures as papers show them: one module each, whose `figure` draws and needs no command."""
