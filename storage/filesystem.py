"""What the data directory's file system must be able to do: SQLite's WAL and flock need a local one."""

from __future__ import annotations

from pathlib import Path

from .errors import DataDirError

MOUNTS = Path("/proc/self/mountinfo")
# Their locks or shared memory hold on one machine only, or not at all (sqlite.org/wal.html): databases were lost so.
NETWORK = {"nfs", "nfs4", "cifs", "smb3", "smbfs", "9p", "afs", "ceph", "lustre", "glusterfs", "ncpfs", "ocfs2"}
NETWORK_FUSE = {"sshfs", "glusterfs", "s3fs", "rclone", "gcsfuse", "davfs", "ceph"}


def refuse_network(path: Path) -> None:
    """Raises DataDirError where the path, which may not exist yet, lies on a network file system."""
    kind = kind_of(path)
    if kind in NETWORK or (kind.startswith("fuse.") and kind[5:] in NETWORK_FUSE):
        raise DataDirError(f"{path}: on a network file system ({kind}), where databases get damaged: use a local disk")


def kind_of(path: Path) -> str:
    """The type of the file system under a path, as the kernel names it; empty where it does not say."""
    path, best, kind = path.resolve(), Path(), ""
    try:
        lines = MOUNTS.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:  # no /proc
        return ""
    for line in lines:
        fields, _, rest = line.partition(" - ")
        mounted = Path(fields.split()[4].encode().decode("unicode_escape"))  # a space is \040
        # Of two mounts on one place the later one is seen.
        if (path == mounted or mounted in path.parents) and len(mounted.parts) >= len(best.parts):
            best, kind = mounted, rest.split()[0]
    return kind
