"""``gsgan.render``: motions of other people, cameras, frames and videos."""
