"""Comparing this framework with files of numbers computed by the published code.

files: reading them. recording: what a model computes on the way. losses: what losses compute.
comparison: the largest errors and whether they are small enough.
"""
