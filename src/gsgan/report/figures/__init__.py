"""Figures of the paper, of any run."""
