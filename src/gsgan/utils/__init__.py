"""Files, console, errors, config, pickles: knows nothing of the method."""
