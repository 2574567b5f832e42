"""The errors that reach a user as one sentence, without a traceback."""

from __future__ import annotations


class GsganError(Exception):
    """Something a user can put right: the message names what, where and what to do."""


class DataError(GsganError):
    """A dataset on disk is missing, damaged or not what its layout promises."""


class ConfigError(GsganError):
    """A config value is unknown or does not fit the others."""
