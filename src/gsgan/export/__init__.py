"""``gsgan.export``: write an avatar in the formats of other programs."""
