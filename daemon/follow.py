"""`revisitd changes --follow`: new and altered changes as lines of JSON, as soon as they are committed."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

from ..storage.changerows import ChangeObject, MergedChange
from ..storage.changes import ChangeStore
from .report import change_fields

POLL_S = 0.5


def entry_json(entry: ChangeObject | MergedChange, with_points: bool) -> str:
    """One line. Of a change all that `changes --format json` has, and its state; of a merge the two ids."""
    if isinstance(entry, MergedChange):
        return json.dumps({"revision": entry.revision, "event": "merged", "id": entry.id, "into": entry.into_id})
    head = {"revision": entry.revision, "event": "changed"}
    return json.dumps({**head, **change_fields(entry, with_points), **_state(entry)})


def _state(change: ChangeObject) -> dict:
    return {
        "state": change.state,
        "superseded_by": change.superseded_by,
        "confidence": round(change.confidence, 4),
        "first_seen_host_ns": change.first_seen_host_ns,
        "map": change.map_id,
    }


def follow(path: Path, since: int, with_points: bool, emit: Callable[[str], None], forever: bool) -> None:
    """Emit a line for each entry after a revision, in their order; forever, or for those that are there.

    path: changes.db. A file that the daemon has put in the place of a damaged one is followed from where the old one
    was left: revisions go on. Raises DatabaseFileError, NewerFormat, StorageUnavailable.
    """
    while True:
        inode = path.stat().st_ino
        with closing(ChangeStore.open_reader(path)) as store:
            while True:
                for entry in store.since(since, with_points):
                    emit(entry_json(entry, with_points))
                    since = entry.revision
                if not forever:
                    return
                time.sleep(POLL_S)
                if not path.exists() or path.stat().st_ino != inode:
                    break
        while not path.exists():
            time.sleep(POLL_S)
