"""Landmarks and masks by MediaPipe, run as a script in its own environment.

`detect.py` never imports gsgan, and gsgan never imports it: MediaPipe pins numpy 1.
"""
