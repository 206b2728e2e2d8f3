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


class DatabaseCorrupt(DatabaseFileError):
    """A database file is damaged. The next opening by a writer moves it aside and puts a good one in its place."""


class ScanFileError(StorageError):
    """A scan file is missing, cut short, damaged, or from a newer revisitd."""


class StorageUnavailable(StorageError):
    """The disk or a database cannot be used now. Nothing was written, all that was acknowledged stands, and the
    same call may succeed later: a daemon drops what it wanted to write, counts it and goes on."""


class StorageFull(StorageUnavailable):
    """No space is left, on the disk or in the user's share of it."""


class StorageReadOnly(StorageUnavailable):
    """The file system takes no writes: mounted so, or turned so by a failing disk."""


class StorageBusy(StorageUnavailable):
    """Another program holds the database's write lock."""
