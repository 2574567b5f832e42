"""Scored runs gathered into tables: what is there, what may stand together, how it is shown."""
