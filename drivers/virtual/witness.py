"""What a pass says of the changing things: returns from those there, looks through those that are not."""

import numpy as np

from ..frame import Sensor
from .embree import Solid
from .raycast import Hits, rays
from .worlds import World

WITHIN_M = 30.0  # a return or a look from farther away does not count
BEHIND_M = 0.3  # a beam that came this much farther than the absent thing has looked through it


class Witness:
    """Watches the changing things of a world during one pass."""

    def __init__(self, world: World, pass_index: int):
        watched = sorted({change.object_id for change in world.changes})
        self._there = np.array([k for k in watched if world.items[k - 1].is_there(pass_index)], np.uint16)
        self._absent = [
            (k, world.items[k - 1].mesh.vertices.mean(0), Solid(world.items[k - 1].mesh))
            for k in watched
            if not world.items[k - 1].is_there(pass_index)
        ]

    def surface(self, sensor: Sensor, pose: np.ndarray, hits: Hits, labels: np.ndarray) -> np.ndarray:
        """Returns of the things that are there -> (K, 4) float64: object id and the point met, world frame.

        pose: (W, 4, 4) T_world_sensor; labels: (H, W) whose return each pixel is.
        """
        seen = np.isin(labels, self._there) & (labels == hits.object_id) & (hits.range_m < WITHIN_M)
        row, column = np.nonzero(seen)
        local = (
            sensor.direction[row, column].astype(float) * hits.range_m[row, column, None] + sensor.offset[row, column]
        )
        point = np.einsum("kij,kj->ki", pose[column, :3, :3], local) + pose[column, :3, 3]
        return np.concatenate([labels[row, column, None], point], 1)

    def looks(self, sensor: Sensor, pose: np.ndarray, range_mm: np.ndarray) -> np.ndarray:
        """Where beams went through absent things -> (K, 4) float64: object id and point, world frame.

        range_mm: (H, W) as measured; a beam without a return has seen nothing.
        """
        here = pose[len(pose) // 2, :3, 3]
        close = [part for part in self._absent if np.linalg.norm(part[1] - here) < WITHIN_M]
        if not close:
            return np.zeros((0, 4))
        origin, ray = rays(sensor, pose)
        measured = range_mm.T.reshape(-1) * np.float32(1e-3)
        found = []
        for number, _, solid in close:
            near = solid.in_view(origin, ray)
            near = near[measured[near] > 0]
            face, range_m, _, _ = solid.hit(origin[near], ray[near], np.minimum(measured[near] - BEHIND_M, WITHIN_M))
            near, range_m = near[face >= 0], range_m[face >= 0]
            point = origin[near] + range_m[:, None] * ray[near]
            found.append(np.concatenate([np.full((len(near), 1), number), point], 1))
        return np.concatenate(found)
