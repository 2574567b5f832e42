"""Checks a dataset before training: its contents, what is wrong, which frames are doubtful.

`gsgan.check.run.check_data` is the entry point.
"""
