"""``gsgan.export``: what leaves the project, and what files say about their origin."""
