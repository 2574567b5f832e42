"""One reader per format: a subclass of `common.FolderReader` whose ``find`` returns `DatasetFiles`.

A new format is one module here and one file in conf/data, which names the reader by ``_target_``.
"""
