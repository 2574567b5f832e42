"""Scores of trained runs and of any method's predictions."""
