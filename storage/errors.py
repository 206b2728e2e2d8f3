"""What can go wrong with the data directory. Each message is one line: file, fault, what to do."""


class StorageError(Exception):
    """Base of all errors of the storage."""


class DataDirBusy(StorageError):
    """Another process writes to this data directory."""


class DataDirError(StorageError):
    """The directory is missing, is not revisitd's, or its parts do not belong together."""


class NewerFormat(StorageError):
    """Written by a newer revisitd, which this one must not touch."""


class DatabaseFileError(StorageError):
    """A database file cannot be opened, or is not a database."""


class ScanFileError(StorageError):
    """A scan file is missing, cut short, damaged, or from a newer revisitd."""
