"""The tables of index.db and changes.db, from the first version to the newest.

A migration is never edited once released: a change of the schema is a new one at the end. Conventions: *_ns are
integer nanoseconds, of the sensor's clock unless the name says host (ns since 1970); the sensor's clock may start
at its power-up, so times of different sessions are ordered by (session_id, *_ns). Lengths are metres, positions
are in the map frame: x forward, y left, z up at the end of the first accepted scan of the map's first session.
"""

INDEX_V1 = """
CREATE TABLE store (                   -- which data directory this file belongs to
    only_row        INTEGER PRIMARY KEY CHECK (only_row = 1),
    uuid            TEXT NOT NULL,     -- as in revisitd.json
    created_host_ns INTEGER NOT NULL
) STRICT;

CREATE TABLE sessions (                -- one run of the odometry, without a break
    session_id       INTEGER PRIMARY KEY AUTOINCREMENT,
    map_id           INTEGER NOT NULL REFERENCES sessions (session_id) DEFERRABLE INITIALLY DEFERRED,
                                       -- the session whose first scan is the map's origin; itself: a new map
    source           TEXT NOT NULL,    -- host name or file
    started_host_ns  INTEGER NOT NULL,
    ended_host_ns    INTEGER,          -- NULL: goes on, or the process was killed
    sensor_digest    TEXT NOT NULL,    -- sensors/<digest>.json
    serial           TEXT NOT NULL,
    product          TEXT NOT NULL,
    firmware         TEXT NOT NULL,
    profile          TEXT NOT NULL,    -- of the lidar packets
    clock_source     TEXT NOT NULL,    -- what the sensor's time counts
    config           TEXT NOT NULL,    -- the settings in force, TOML
    software_version TEXT NOT NULL
) STRICT;

CREATE TABLE scans (                   -- one key scan; its ranges are in scans/<session>/<scan_id // 1000>/
    scan_id    INTEGER PRIMARY KEY AUTOINCREMENT,  -- grows with time, never used twice
    session_id INTEGER NOT NULL REFERENCES sessions,
    stamp_ns   INTEGER NOT NULL,       -- of the pose: the last valid column
    host_ns    INTEGER NOT NULL,
    x REAL NOT NULL, y REAL NOT NULL, z REAL NOT NULL,                       -- pose of the sensor in the map
    qx REAL NOT NULL, qy REAL NOT NULL, qz REAL NOT NULL, qw REAL NOT NULL,  -- unit quaternion
    aligned    INTEGER NOT NULL CHECK (aligned IN (0, 1)),  -- 1: registered to stored scans
    residual_m REAL,                   -- of that registration
    bytes      INTEGER NOT NULL        -- size of the file
) STRICT;
CREATE INDEX scans_by_session ON scans (session_id);

CREATE TABLE descriptors (             -- apart from scans, so that a walk over the poses need not read them
    scan_id    INTEGER PRIMARY KEY REFERENCES scans ON DELETE CASCADE,
    model_id   TEXT NOT NULL,          -- descriptors of different models must not be compared
    descriptor BLOB NOT NULL           -- float32, little endian, unit length
) STRICT;

CREATE TABLE scenes (                  -- a place: a convex hull of positions, grown by a margin
    scene_id        INTEGER PRIMARY KEY AUTOINCREMENT,
    map_id          INTEGER NOT NULL REFERENCES sessions (session_id),
    hull            TEXT NOT NULL CHECK (json_valid(hull)),  -- [[x, y], ...] counter-clockwise, map frame
    margin_m        REAL NOT NULL,
    area_m2         REAL NOT NULL,     -- of the grown hull
    created_host_ns INTEGER NOT NULL
) STRICT;
CREATE INDEX scenes_by_map ON scenes (map_id);

CREATE TABLE visits (                  -- one stay in a scene
    visit_id   INTEGER PRIMARY KEY AUTOINCREMENT,
    scene_id   INTEGER NOT NULL REFERENCES scenes,
    number     INTEGER NOT NULL CHECK (number >= 1),  -- 1 is the visit that made the scene
    session_id INTEGER NOT NULL REFERENCES sessions,
    t_in_ns    INTEGER NOT NULL,
    t_out_ns   INTEGER,                -- NULL: the robot is still there
    UNIQUE (scene_id, number)
) STRICT;

CREATE TABLE visit_scans (
    visit_id INTEGER NOT NULL REFERENCES visits ON DELETE CASCADE,
    scan_id  INTEGER NOT NULL REFERENCES scans ON DELETE CASCADE,
    PRIMARY KEY (visit_id, scan_id)
) STRICT, WITHOUT ROWID;
CREATE INDEX visit_scans_by_scan ON visit_scans (scan_id);

CREATE TABLE instances (               -- one run of change detection: a visit against the visits before it
    instance_id          INTEGER PRIMARY KEY AUTOINCREMENT,
    scene_id             INTEGER NOT NULL REFERENCES scenes,
    visit_id             INTEGER NOT NULL REFERENCES visits,
    status               TEXT NOT NULL CHECK (status IN ('done', 'rejected', 'dropped', 'failed')),
    reason               TEXT NOT NULL,     -- why it is not done; empty where it is
    seconds              REAL NOT NULL,
    stage_seconds        TEXT NOT NULL CHECK (json_valid(stage_seconds)),  -- {"load": 0.5, ...}
    n_cumulative_scans   INTEGER NOT NULL,  -- of the visits before
    n_recent_scans       INTEGER NOT NULL,  -- of this visit
    n_candidates         INTEGER NOT NULL,  -- points
    n_confirmed          INTEGER NOT NULL,  -- points left by the filters
    n_changes            INTEGER NOT NULL,  -- objects
    alignment_residual_m REAL,
    finished_host_ns     INTEGER NOT NULL
) STRICT;
CREATE INDEX instances_by_scene ON instances (scene_id);
"""

INDEX_V2 = """
ALTER TABLE sessions ADD COLUMN continues INTEGER REFERENCES sessions (session_id);
                                       -- the session that found its place in this one's map and went on as this one;
                                       -- its own map was given up. NULL: this one began with a new odometry
"""

INDEX_V3 = """
CREATE TABLE garbage (                 -- files that are to be deleted: no rows of scans any more
    scan_id    INTEGER PRIMARY KEY,
    session_id INTEGER NOT NULL
) STRICT;
CREATE TABLE usage (                   -- kept by the triggers: adding up a million scans takes too long
    only_row   INTEGER PRIMARY KEY CHECK (only_row = 1),
    scan_bytes INTEGER NOT NULL        -- of all scan files, each rounded up to blocks of 4096
) STRICT;
INSERT INTO usage SELECT 1, coalesce(sum((bytes + 4095) / 4096 * 4096), 0) FROM scans;
CREATE TRIGGER usage_grows AFTER INSERT ON scans BEGIN
    UPDATE usage SET scan_bytes = scan_bytes + (NEW.bytes + 4095) / 4096 * 4096;
END;
CREATE TRIGGER usage_shrinks AFTER DELETE ON scans BEGIN
    UPDATE usage SET scan_bytes = scan_bytes - (OLD.bytes + 4095) / 4096 * 4096;
END;
"""

CHANGES_V1 = """
CREATE TABLE store (                   -- which data directory this file belongs to
    only_row        INTEGER PRIMARY KEY CHECK (only_row = 1),
    uuid            TEXT NOT NULL,     -- as in revisitd.json
    created_host_ns INTEGER NOT NULL
) STRICT;

CREATE TABLE changes (                 -- one object that appeared or disappeared between two visits
    id                   INTEGER PRIMARY KEY AUTOINCREMENT,  -- grows with time, never used twice
    revision             INTEGER NOT NULL UNIQUE,  -- grows with each new or altered row: read on from the last seen
    polarity             TEXT NOT NULL CHECK (polarity IN ('appeared', 'disappeared')),
    state                TEXT NOT NULL DEFAULT 'present' CHECK (state IN ('present', 'ended')),
                                       -- ended: undone since; what appeared has gone, what disappeared is back
    superseded_by        INTEGER REFERENCES changes (id),  -- the change that ended this one, if there is one
    map_id               INTEGER NOT NULL,  -- this and the next three: ids of index.db
    session_id           INTEGER NOT NULL,
    scene_id             INTEGER NOT NULL,
    visit                INTEGER NOT NULL,  -- number of the scene's visit that found it
    first_seen_ns        INTEGER NOT NULL,  -- the new state was first seen, in session session_id
    first_seen_host_ns   INTEGER NOT NULL,  -- the same moment by the host's clock
    last_before_session  INTEGER,      -- the old state was last seen: it changed in between.
    last_before_ns       INTEGER,      -- NULL: not known
    x REAL NOT NULL, y REAL NOT NULL, z REAL NOT NULL,                          -- mean of the points
    min_x REAL NOT NULL, min_y REAL NOT NULL, min_z REAL NOT NULL,              -- their box
    max_x REAL NOT NULL, max_y REAL NOT NULL, max_z REAL NOT NULL,
    n_points             INTEGER NOT NULL CHECK (n_points > 0),  -- at most one in 5 cm
    points               BLOB NOT NULL,  -- n_points x (x, y, z) float32, little endian, not compressed
    confidence           REAL NOT NULL CHECK (confidence BETWEEN 0 AND 1),
    evidence             TEXT NOT NULL CHECK (json_valid(evidence)),  -- what each filter saw
    alignment_residual_m REAL,         -- of the visit to the visits before it
    model_id             TEXT NOT NULL,  -- of the descriptor that chose the scans
    config_digest        TEXT NOT NULL,  -- of the settings in force
    detected_host_ns     INTEGER NOT NULL,
    updated_host_ns      INTEGER NOT NULL
) STRICT;
CREATE INDEX changes_by_place ON changes (map_id, min_x, max_x);

CREATE TABLE observations (            -- the history of each change: every visit that had something to say of it
    observation_id INTEGER PRIMARY KEY AUTOINCREMENT,
    change_id      INTEGER NOT NULL REFERENCES changes (id),
    kind           TEXT NOT NULL CHECK (kind IN ('appeared', 'disappeared', 'still', 'gone')),
                                       -- the first is the polarity; still: seen again so; gone: undone
    session_id     INTEGER NOT NULL,
    scene_id       INTEGER NOT NULL,
    visit          INTEGER NOT NULL,
    time_ns        INTEGER NOT NULL    -- in session session_id
) STRICT;
CREATE INDEX observations_by_change ON observations (change_id);

CREATE VIEW change_list AS             -- for people: every change, without its points
SELECT id, polarity, state,
       round(x, 2) AS x, round(y, 2) AS y, round(z, 2) AS z,
       round(max_x - min_x, 2) AS length_x, round(max_y - min_y, 2) AS length_y, round(max_z - min_z, 2) AS height,
       n_points, round(confidence, 2) AS confidence,
       strftime('%Y-%m-%d %H:%M:%S', first_seen_host_ns / 1000000000, 'unixepoch') AS first_seen_utc,
       map_id, session_id, scene_id, visit, superseded_by
FROM changes ORDER BY id;

CREATE VIEW present_changes AS         -- for people: what is different now
SELECT * FROM change_list WHERE state = 'present';

CREATE VIEW change_history AS          -- for people: which visit saw which change, in which state
SELECT o.change_id, c.polarity, o.kind AS seen_as, o.session_id, o.scene_id, o.visit, o.time_ns,
       round(c.x, 2) AS x, round(c.y, 2) AS y, round(c.z, 2) AS z
FROM observations AS o JOIN changes AS c ON c.id = o.change_id ORDER BY o.observation_id;
"""

CHANGES_V2 = """
CREATE TABLE observations_2 (          -- the history of each change: every visit to its place
    observation_id INTEGER PRIMARY KEY AUTOINCREMENT,
    change_id      INTEGER NOT NULL REFERENCES changes (id),
    kind           TEXT NOT NULL CHECK (kind IN ('appeared', 'disappeared', 'still', 'gone', 'unseen')),
                                       -- the first is the polarity; still: seen again so; gone: undone;
                                       -- unseen: the visit did not see the place (hidden, out of view, no return)
    session_id     INTEGER NOT NULL,
    scene_id       INTEGER NOT NULL,
    visit          INTEGER NOT NULL,
    time_ns        INTEGER NOT NULL,   -- in session session_id
    share_still    REAL,               -- of the change's points: seen in the state that the change left
    share_undone   REAL                -- ... seen in the state before it; the rest was not seen. NULL: not asked
) STRICT;
INSERT INTO observations_2 SELECT observation_id, change_id, kind, session_id, scene_id, visit, time_ns, NULL, NULL
    FROM observations;
DROP VIEW change_history;
DROP TABLE observations;
ALTER TABLE observations_2 RENAME TO observations;
CREATE INDEX observations_by_change ON observations (change_id);
CREATE TABLE merged_changes (          -- changes that turned out to be parts of others, and are no rows any more
    part_id        INTEGER PRIMARY KEY,
    whole_id       INTEGER NOT NULL REFERENCES changes (id),
    merged_host_ns INTEGER NOT NULL
) STRICT;
CREATE VIEW change_history AS          -- for people: which visit saw which change, in which state
SELECT o.change_id, c.polarity, o.kind AS seen_as, o.session_id, o.scene_id, o.visit, o.time_ns,
       round(o.share_still, 2) AS share_still, round(o.share_undone, 2) AS share_undone,
       round(c.x, 2) AS x, round(c.y, 2) AS y, round(c.z, 2) AS z
FROM observations AS o JOIN changes AS c ON c.id = o.change_id ORDER BY o.observation_id;
"""

CHANGES_V3 = """
ALTER TABLE store ADD COLUMN last_revision INTEGER NOT NULL DEFAULT 0;
                                       -- the highest revision ever given, to a change or to a merge
ALTER TABLE merged_changes ADD COLUMN revision INTEGER;
                                       -- of the merge: in one order with the revisions of changes
UPDATE merged_changes SET revision = (SELECT coalesce(max(revision), 0) FROM changes)
    + (SELECT count(*) FROM merged_changes AS other WHERE other.part_id <= merged_changes.part_id);
CREATE UNIQUE INDEX merged_changes_by_revision ON merged_changes (revision);
UPDATE store SET last_revision = max((SELECT coalesce(max(revision), 0) FROM changes),
                                     (SELECT coalesce(max(revision), 0) FROM merged_changes));

CREATE VIEW change_feed AS             -- for programs that wait: WHERE revision > :the_last_one_seen ORDER BY revision
SELECT revision,
       'changed' AS event,             -- changed: a new change, or an altered one as it is now
                                       -- merged: id is no change any more, but a part of merged_into
       id, NULL AS merged_into, polarity, state, superseded_by, x, y, z, n_points, confidence,
       first_seen_ns, first_seen_host_ns, map_id, session_id, scene_id, visit
FROM changes
UNION ALL
SELECT revision, 'merged', part_id, whole_id, NULL, NULL, NULL, NULL, NULL, NULL, NULL, NULL,
       NULL, NULL, NULL, NULL, NULL, NULL
FROM merged_changes;
"""

INDEX_MIGRATIONS = (INDEX_V1, INDEX_V2, INDEX_V3)
CHANGES_MIGRATIONS = (CHANGES_V1, CHANGES_V2, CHANGES_V3)
