"""Landmarks and masks by MediaPipe, run as a script in an environment of its own.

`detect.py` never imports gsgan, and gsgan never imports it: MediaPipe pins numpy 1.
"""
