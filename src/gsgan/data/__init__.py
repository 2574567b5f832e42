"""Datasets: readers of their formats, splits and protocols, and the default person.

Import from the modules: `gsgan.data.layout` (the result of every reader), `gsgan.data.formats` (the
readers), `gsgan.data.dataset` (the torch dataset), `gsgan.data.datamodule`, which loads Lightning.
"""
