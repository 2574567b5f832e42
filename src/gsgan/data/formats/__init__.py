"""One reader a format; each makes a `gsgan.data.layout.Found` and hands it to `assemble`."""
