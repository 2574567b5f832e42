"""Errors that are shown to the user as one sentence, without a traceback."""


class GsganError(Exception):
    """An error that the user can fix: the message names what, where and what to do."""


class DataError(GsganError):
    """A file or folder is missing, damaged or has unexpected content."""


class ConfigError(GsganError):
    """A config value is unknown or contradicts another."""
