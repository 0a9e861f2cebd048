"""Data tools for qgs: what is wrong with a data set, and data sets as chunks."""
