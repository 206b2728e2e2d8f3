"""Small scans, sessions and changes for the tests of the storage."""

import numpy as np

from revisitd.storage.changerows import Change
from revisitd.storage.scans import Scan

SESSION = {
    "source": "patrol.pcap",
    "sensor_digest": "0123456789abcdef",
    "serial": "122201000998",
    "product": "OS-1-128",
    "firmware": "v3.1.0",
    "profile": "RNG19_RFL8_SIG16_NIR16",
    "clock_source": "TIME_FROM_INTERNAL_OSC",
    "config": "[scenes]\nalpha_m2 = 120.0\n",
    "software_version": "0.1.0",
}


def pose(x=0.0, y=0.0, z=0.0, yaw=0.0):
    """(4, 4) float64."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0, x], [s, c, 0, y], [0, 0, 1, z], [0, 0, 0, 1.0]])


def make_scan(scan_id=1, session=1, shape=(16, 64), **fields):
    """A scan of random content, the same for the same id."""
    rng = np.random.default_rng(scan_id)
    height, width = shape
    column_valid = rng.random(width) < 0.9
    column_valid[-1] = True
    column_ns = np.where(column_valid, 991_000_000_000 + scan_id * 100_000_000 + np.arange(width) * 97_656, 0)
    descriptor = rng.normal(size=256).astype(np.float32)
    values = {
        "scan_id": scan_id,
        "session": session,
        "stamp_ns": int(column_ns[-1]),
        "host_ns": 1_760_000_000_000_000_000 + scan_id * 100_000_000,
        "frame_id": scan_id % 65536,
        "sensor_digest": SESSION["sensor_digest"],
        "range_mm": rng.integers(0, 120_000, shape).astype(np.uint32) * column_valid,
        "reflectivity": rng.integers(0, 256, shape).astype(np.uint8),
        "column_ns": column_ns,
        "column_valid": column_valid,
        "T_map_sensor": pose(*rng.normal(size=3), yaw=rng.normal()),
        "T_odom_sensor": pose(*rng.normal(size=3), yaw=rng.normal()),
        "T_start_end": pose(0.1, 0.0, 0.0, yaw=0.01),
        "descriptor": descriptor / np.linalg.norm(descriptor),
        "model_id": "feedc0ffee00",
        "aligned": True,
        "alignment_residual_m": 0.03,
    }
    return Scan(**{**values, **fields})


def make_change(polarity="appeared", at=(0.0, 0.0, 0.0), n_points=50, **fields):
    """A change whose points fill a box of 1 m, no two of them within 5 cm."""
    grid = np.stack(np.meshgrid(*[np.arange(10)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    points = np.asarray(at) + (grid[:n_points] - 4.5) * 0.1
    values = {
        "polarity": polarity,
        "map_id": 1,
        "session": 1,
        "scene": 1,
        "visit": 2,
        "first_seen_ns": 1_000_000_000_000,
        "first_seen_host_ns": 1_760_000_000_000_000_000,
        "points": points.astype(np.float32),
        "confidence": 0.8,
        "evidence": {"n_scans_confirming": 4, "confirmed_share": 0.7},
        "alignment_residual_m": 0.04,
        "model_id": "feedc0ffee00",
        "config_digest": "abcdef012345",
    }
    return Change(**{**values, **fields})


def add_visit(store, scene, number, session, n_scans, at=(0.0, 0.0), step_m=0.5, first_ns=0, after_each=None, **fields):
    """A visit of some scans in a row along x, with their files; the ids. The scene is made with its first visit."""
    if number == 1:
        store.index.add_scene(scene, session, np.array([at]), 2.5, 20.0)
    stamps = [first_ns + i * 500_000_000 for i in range(n_scans)]
    visit = store.index.open_visit(scene, number, session, stamps[0])
    ids = []
    for i, stamp_ns in enumerate(stamps):
        T_map_sensor = pose(at[0] + step_m * i, at[1])
        scan = make_scan(store.new_scan_id(), session, T_map_sensor=T_map_sensor, stamp_ns=stamp_ns, **fields)
        store.add_scan(scan, [visit])
        ids.append(scan.scan_id)
        if after_each is not None:
            after_each(scan.scan_id)
    store.index.close_visit(visit, stamps[-1])
    return ids
