"""What things cost: the subjects of ``python -m gsgan.bench``."""
