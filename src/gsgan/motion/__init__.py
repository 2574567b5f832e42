"""Motions: readers of motion files, and retargeting to the subject and to rigged characters."""
