"""Datasets: the bring-your-own layout, its reader, its splits, and the default person.

Import what you need from the modules: `gsgan.data.layout`, `gsgan.data.capture`,
`gsgan.data.datamodule`; the last one loads Lightning.
"""
