"""Config groups for gsgan."""
