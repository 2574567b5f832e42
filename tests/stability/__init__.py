"""A package, because other folders of tests hold modules of the same names."""
