"""Ground truth of a simulated patrol: poses, change objects, whose return each pixel is."""

import json
import zipfile
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from .worlds import World

VOXEL_M = 0.05
CONFIRM_M = 0.15  # a surface point this near to a look through the thing can be confirmed by it


class Truth:
    """Collects frame by frame; `write` finishes. Map frame = the sensor's pose at the end of frame 0.

    poses.txt: TUM lines, the pose at each frame's end on the sensor's clock.
    changes.json: of each change its id, kind, polarity, the first pass that shows it, the object's id, the
    change it is part of (the place that an opened door left) or null, its centroid, how many returns the
    sensor got from it in the last pass before (disappeared) or the first after (appeared), these returns'
    points at 5 cm voxels, and for each point whether the pass on the other side of the change looked through
    it (1) or not (0).
    objects.json: the kind of each object id.
    labels.npz: for each frame (member "000000", ...) the object id (H, W) of each return, staggered; 0 = no
    return.
    """

    def __init__(self, folder: Path, world: World):
        folder.mkdir(parents=True, exist_ok=True)
        self._folder, self._world = folder, world
        self._labels = zipfile.ZipFile(folder / "labels.npz", "w", zipfile.ZIP_DEFLATED, compresslevel=1)
        self._poses: dict[int, tuple[int, np.ndarray]] = {}
        self._seen: dict[tuple[int, int], list[np.ndarray]] = {}  # by (object, pass): parts (K, 3)
        self._looks: dict[tuple[int, int], list[np.ndarray]] = {}

    def add(self, shot) -> None:
        """shot: worker.Shot of one frame; in any order."""
        with self._labels.open(f"{shot.index:06d}.npy", "w") as member:
            np.lib.format.write_array(member, shot.labels)
        self._poses[shot.index] = (shot.stamp_ns, shot.T_world_sensor)
        for rows, book in ((shot.surface, self._seen), (shot.looks, self._looks)):
            for number in np.unique(rows[:, 0]).astype(int):
                book.setdefault((number, shot.pass_index), []).append(rows[rows[:, 0] == number, 1:])

    def write(self) -> None:
        """Write poses.txt, changes.json, objects.json; labels.npz is complete after this."""
        self._labels.close()
        T_map_world = np.linalg.inv(self._poses[0][1])
        lines = [_tum_line(stamp, T_map_world @ pose) for _, (stamp, pose) in sorted(self._poses.items())]
        (self._folder / "poses.txt").write_text("".join(lines))
        changes = [self._change(k, T_map_world) for k in range(len(self._world.changes))]
        (self._folder / "changes.json").write_text(json.dumps(changes, indent=1))
        (self._folder / "objects.json").write_text(json.dumps(self._world.kinds))

    def _change(self, index: int, T_map_world: np.ndarray) -> dict:
        change = self._world.changes[index]
        before, after = change.pass_index - 1, change.pass_index
        seen_in, absent_in = (after, before) if change.polarity == "appeared" else (before, after)
        returns = _gathered(self._seen, change.object_id, seen_in)
        surface = thin(returns, VOXEL_M)
        looks = thin(_gathered(self._looks, change.object_id, absent_in), VOXEL_M)
        confirmable = (
            cKDTree(looks).query(surface)[0] < CONFIRM_M
            if len(looks) and len(surface)
            else np.zeros(len(surface), bool)
        )
        middle = surface.mean(0) if len(surface) else self._world.items[change.object_id - 1].mesh.vertices.mean(0)
        centroid, surface = (points @ T_map_world[:3, :3].T + T_map_world[:3, 3] for points in (middle, surface))
        return {
            "id": index,
            "kind": change.kind,
            "polarity": change.polarity,
            "pass": change.pass_index,
            "object": change.object_id,
            "part_of": change.part_of,
            "centroid": centroid.round(3).tolist(),
            "n_visible_returns": len(returns),
            "points": surface.round(3).tolist(),
            "confirmable": confirmable.astype(int).tolist(),
        }


def _gathered(book: dict, number: int, pass_index: int) -> np.ndarray:
    return np.concatenate(book.get((number, pass_index), [np.zeros((0, 3))]))


def thin(points: np.ndarray, cell_m: float) -> np.ndarray:
    """points: (N, 3) -> (M, 3), the mean of the points in each voxel."""
    if not len(points):
        return points
    _, group = np.unique(np.floor(points / cell_m).astype(np.int64), axis=0, return_inverse=True)
    group = group.ravel()
    count = np.bincount(group)
    return np.stack([np.bincount(group, points[:, k]) / count for k in range(3)], 1)


def _tum_line(stamp_ns: int, T_map_sensor: np.ndarray) -> str:
    x, y, z = T_map_sensor[:3, 3]
    q = Rotation.from_matrix(T_map_sensor[:3, :3]).as_quat()
    seconds = f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d}"
    return f"{seconds} {x:.6f} {y:.6f} {z:.6f} {q[0]:.9f} {q[1]:.9f} {q[2]:.9f} {q[3]:.9f}\n"
