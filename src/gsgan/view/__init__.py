"""``gsgan.view``: an avatar in the browser."""
