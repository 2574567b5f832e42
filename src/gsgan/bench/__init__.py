"""The time that an avatar takes: ``python -m gsgan.bench speed``."""
