"""Datasets: readers of their formats, splits and protocols, and the default person.

Import what you need from the modules: `gsgan.data.layout` (what every reader yields),
`gsgan.data.formats` (the readers), `gsgan.data.dataset` (the torch dataset),
`gsgan.data.datamodule`; the last one loads Lightning.
"""
