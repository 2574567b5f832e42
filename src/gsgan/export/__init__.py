"""``gsgan.export``: an avatar in the formats of other programs."""
