"""``gsgan.render``: drive an avatar with a motion, into images or a video."""
