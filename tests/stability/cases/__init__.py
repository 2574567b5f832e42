"""Numerically hard cases by name: float32 must be right in values and gradients, or refuse."""
