"""From calibrated, synchronised videos to a capture that `data=capture` reads."""
