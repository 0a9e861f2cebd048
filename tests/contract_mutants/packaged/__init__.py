"""A package whose components are sound, and which lists a folder when it is imported."""

import os

BESIDE = os.listdir(os.curdir)
