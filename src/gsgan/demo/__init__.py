"""``gsgan.demo``: a picture and a video of the avatar that comes with gsgan, without training."""
