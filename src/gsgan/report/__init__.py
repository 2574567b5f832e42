"""Tables of scored runs and figures of one run."""
