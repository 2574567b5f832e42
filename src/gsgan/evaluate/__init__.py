"""Scores of runs and of any method's predictions: protocols, tables, files."""
