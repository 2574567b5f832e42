"""Files, console, errors, config, pickles: independent of the method."""
