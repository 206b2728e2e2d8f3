"""Which stored scans are needed least: the order in which retention deletes them.

A scan may be part of visits to several scenes; the one that needs it most decides. Thinning spreads what it keeps of
a visit evenly over its path, which at a scene's size represents it nearly as well as OptMap's choice, and needs no
descriptors of a million scans.
"""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass
from enum import IntEnum

from . import database
from .datadir import DataDir
from .schema import CHANGES_MIGRATIONS, INDEX_MIGRATIONS


class Tier(IntEnum):
    """Why a scan is kept; the lowest go first."""

    SURPLUS = 0  # of a visit that has more scans than a submap needs
    OUTSIDE = 1  # in no scene
    OLD_VISIT = 2  # neither its scene's first nor its latest
    EVIDENCE_SURPLUS = 3  # of a visit before or after a change
    EVIDENCE = 4
    REFERENCE = 5  # of a scene's first visit, to which later ones are registered, or of its latest
    RECENT = 6  # of visits that go on, which the index does not know yet


@dataclass(frozen=True)
class Victim:
    """A scan that may go."""

    session: int
    scan_id: int
    bytes: int
    tier: Tier


ORDER = """
WITH evidence AS (                          -- the visits that showed a change, and the last ones before it
    SELECT v.visit_id FROM precious.changes AS c JOIN visits AS v ON v.scene_id = c.scene_id AND v.number = c.visit
    UNION
    SELECT v.visit_id FROM precious.changes AS c JOIN visits AS v
        ON v.scene_id = c.scene_id AND v.session_id = c.last_before_session
        AND c.last_before_ns BETWEEN v.t_in_ns AND v.t_out_ns
),
steps AS (                             -- a scan counts like 0.1 m of way: a robot that stands still sees little new
    SELECT visit_id, scan_id, 0.1 + abs(x - lag(x, 1, x) OVER visit) + abs(y - lag(y, 1, y) OVER visit) AS step_m
    FROM visit_scans JOIN scans USING (scan_id) WINDOW visit AS (PARTITION BY visit_id ORDER BY scan_id)
),
ways AS (
    SELECT visit_id, scan_id, count(*) OVER whole AS n,
           CAST(:kept * (sum(step_m) OVER (whole ORDER BY scan_id) - 0.05) / sum(step_m) OVER whole AS INTEGER) AS part
    FROM steps WINDOW whole AS (PARTITION BY visit_id)
),
members AS (                           -- the first scan of each of `kept` equal parts of the way stays
    SELECT visit_id, scan_id, n > :kept AND part IS lag(part) OVER (PARTITION BY visit_id ORDER BY scan_id) AS spare
    FROM ways
),
needs AS (
    SELECT scan_id, max(latest_id) AS seen_last, max(visit_id) AS visit_id, max(CASE
               WHEN NOT spare AND (number = 1 OR visit_id = latest_id) THEN 5
               WHEN visit_id IN evidence THEN iif(spare, 3, 4)
               WHEN spare THEN 0
               ELSE 2 END) AS tier
    FROM (SELECT members.*, number,
                 (SELECT visit_id FROM visits AS other WHERE other.scene_id = v.scene_id ORDER BY number DESC LIMIT 1)
                 AS latest_id
          FROM members JOIN visits AS v USING (visit_id))
    GROUP BY scan_id
),
newest AS (
    SELECT session_id, max(stamp_ns) AS stamp_ns FROM scans WHERE session_id = (SELECT max(session_id) FROM sessions)
),
ordered AS (
    SELECT s.session_id, s.scan_id, s.bytes,
           CASE WHEN s.session_id = newest.session_id AND s.stamp_ns >= newest.stamp_ns - :recent_ns THEN 6
                ELSE coalesce(tier, 1) END AS tier,
           CASE tier WHEN 5 THEN seen_last ELSE visit_id END AS age
    FROM scans AS s CROSS JOIN newest LEFT JOIN needs USING (scan_id)
)
SELECT session_id, scan_id, bytes, tier FROM ordered
WHERE tier = (SELECT min(tier) FROM ordered) ORDER BY age, scan_id LIMIT :n
"""


def least_useful(data_dir: DataDir, n: int, kept_per_visit: int, recent_ns: int) -> list[Victim]:
    """At most n scans of the lowest tier there is, the first to go first.

    kept_per_visit: scans that stand for a visit. recent_ns: scans of the newest session younger than this may belong
    to a visit that goes on. Reads both databases on a connection of its own, in C and without the interpreter's lock:
    beside the frame loop. Raises StorageUnavailable, DatabaseFileError.
    """
    with closing(database.open_reader(data_dir.index_path, len(INDEX_MIGRATIONS))) as db:
        db.attach(data_dir.changes_path, "precious", len(CHANGES_MIGRATIONS))
        db.write("PRAGMA temp_store = MEMORY")  # not on the disk, which may be full: 16 MB for 100 000 scans
        values = {"kept": kept_per_visit, "recent_ns": recent_ns, "n": n}
        return [Victim(*row[:3], Tier(row[3])) for row in db.tuples(ORDER, values)]
