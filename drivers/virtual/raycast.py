"""Rays against a world, by Embree: what each beam of each column meets, every column from its own pose."""

from dataclasses import dataclass

import numpy as np

from ..frame import Sensor
from .embree import Solid
from .mesh import Material, Mesh, merge, rotation
from .shapes import vehicle
from .worlds import World

MAX_RANGE_M = 120.0
MOVER_REACH_M = 70.0  # movers farther away are not cast
LEAF_JITTER_M = 0.02
SWAY = 0.012  # how far a plant leans in the wind of a pass: metres per metre of height
SWAYING = frozenset({"tree", "bush", "grass", "hedge"})
MIRROR_COS = 0.985  # a pane or puddle squarer to the beam than this answers by itself
PANE_CLARITY = 0.45  # share of the light left after going through a pane and back
RIPPLES = 0.3  # share of the light that a puddle does not scatter
SECOND_LEGS = 2  # panes or puddles in a row that a beam gets past


@dataclass(frozen=True, eq=False)
class Hits:
    """What the beams of one rotation met, free of noise; all (H, W), staggered."""

    range_m: np.ndarray  # float32, as the sensor measures it; inf where nothing within MAX_RANGE_M
    object_id: np.ndarray  # uint16, see World.kinds; 0 where nothing
    material: np.ndarray  # uint8, see mesh.Material; meaningless where nothing
    incidence: np.ndarray  # float32, |cos| of the angle between beam and surface normal
    clarity: np.ndarray  # float32, share of the light left after panes and puddles; 1 where there were none

    @property
    def range_mm(self) -> np.ndarray:
        """(H, W) uint32, 0 where nothing was met."""
        return np.where(np.isfinite(self.range_m), np.rint(self.range_m * 1e3), 0).astype(np.uint32)


class Caster:
    """The static world of one pass as an Embree scene, and its movers as small scenes of their own."""

    def __init__(self, world: World, pass_index: int = 0, with_vehicle: bool = False):
        """with_vehicle: whether the sensor sees parts of the robot that carries it."""
        there = [(k + 1, item) for k, item in enumerate(world.items) if item.is_there(pass_index)]
        sizes = [len(item.mesh.faces) for _, item in there]
        self._static = Solid(_in_the_wind(world, [item for _, item in there], pass_index))
        self._face_object = np.repeat([k for k, _ in there], sizes).astype(np.uint16)
        self._terrain = world.terrain
        first = len(world.items) + 1
        self._movers = [
            (first + k, mover, [Solid(mesh) for mesh in mover.meshes])
            for k, mover in enumerate(world.movers)
            if mover.pass_index == pass_index
        ]
        self._vehicle = Solid(vehicle()) if with_vehicle else None
        self._vehicle_id = world.kinds.index("vehicle")

    def cast(self, sensor: Sensor, T_world_sensor: np.ndarray, t_s: np.ndarray | None = None):
        """-> range_mm (H, W) uint32 (0 = nothing met), object_id (H, W) uint16. Arguments as in `trace`."""
        hits = self.trace(sensor, T_world_sensor, t_s)
        return hits.range_mm, hits.object_id

    def trace(self, sensor: Sensor, T_world_sensor: np.ndarray, t_s: np.ndarray | None = None) -> Hits:
        """One rotation from one pose (4, 4) or from a pose for each column (W, 4, 4).

        t_s: (W,) seconds since the patrol's start, which place the movers; without it there are none.
        """
        height, width = sensor.shape
        origin, ray = rays(sensor, T_world_sensor)
        met = _Met.nothing(len(ray))
        self._cast_static(met, origin, ray)
        if t_s is not None:
            for number, mover, scenes in self._movers:
                self._add_mover(met, number, mover, scenes, origin, ray, np.asarray(t_s, float))
        if self._vehicle:
            own = (np.ascontiguousarray(a.transpose(1, 0, 2)).reshape(-1, 3) for a in (sensor.offset, sensor.direction))
            met.nearer(
                np.arange(len(ray)),
                self._vehicle.hit(*own, met.range_m),
                self._vehicle_id,
                self._vehicle.material,
            )
        met.range_m[met.object_id == 0] = np.inf
        return Hits(*(np.ascontiguousarray(a.reshape(width, height).T) for a in vars(met).values()))

    def _cast_static(self, met: "_Met", origin: np.ndarray, ray: np.ndarray) -> None:
        """The standing world, looking through panes and along the mirror image in puddles."""
        found, which = self._static.hit(origin, ray, met.range_m), np.arange(len(ray))
        met.nearer(which, found, self._face_object[found[0]], self._static.material)
        for _ in range(SECOND_LEGS):
            past = np.isin(met.material[which], (Material.GLASS, Material.WATER)) & (met.incidence[which] < MIRROR_COS)
            past &= met.object_id[which] > 0
            which, first = which[past], [part[past] for part in found]
            if not len(which):
                return
            start, ray, clarity = self._second_leg(origin[past], ray[past], *first)
            so_far = met.range_m[which]
            found = self._static.hit(start, ray, MAX_RANGE_M - so_far)
            origin, face = start, found[0]
            met.range_m[which] = so_far + found[1]
            met.object_id[which] = np.where(face >= 0, self._face_object[face], 0)
            met.material[which], met.incidence[which] = self._static.material[face], found[3]
            met.clarity[which] *= clarity

    def _second_leg(self, origin, ray, face, range_m, normal, cosine):
        """How beams go on from a pane (straight) or puddle (mirrored) -> start, direction, light left."""
        water = self._static.material[face] == Material.WATER
        mirrored = ray - 2 * np.einsum("ni,ni->n", ray, normal)[:, None] * normal
        onward = np.where(water[:, None], mirrored, ray).astype(np.float32)
        start = (origin + range_m[:, None] * ray + np.float32(1e-3) * onward).astype(np.float32)
        mirror = RIPPLES * (0.02 + 0.98 * (1 - cosine) ** 5) ** 2  # Schlick, there and back
        return start, onward, np.where(water, mirror, PANE_CLARITY).astype(np.float32)

    def _add_mover(self, met: "_Met", number, mover, scenes, origin, ray, t_s) -> None:
        """Overwrites what was met where the mover is nearer; it, too, moves on from column to column."""
        middle, height = len(t_s) // 2, len(ray) // len(t_s)
        xy, yaw = mover.place(t_s)
        z = float(self._terrain.height(xy[middle]))
        centre, scene = np.array([*xy[middle], z]), scenes[mover.mesh_at(t_s[middle])]
        if np.linalg.norm(centre - origin[len(origin) // 2]) > MOVER_REACH_M:
            return
        near = scene.in_view(origin, ray, centre, slack_m=0.3 + mover.speed_m_s * (t_s[-1] - t_s[0]))
        at = near // height
        turn = rotation(yaw).astype(np.float32)
        shift = np.concatenate([xy, np.full((len(xy), 1), z)], 1).astype(np.float32)
        local = np.einsum("ni,nij->nj", origin[near] - shift[at], turn[at])  # v @ R = R^T v: world to mover
        heading = np.einsum("ni,nij->nj", ray[near], turn[at])
        met.nearer(near, scene.hit(local, heading, met.range_m[near]), number, scene.material)


@dataclass(eq=False)
class _Met:
    """What each ray has met so far, nearest first; the fields of Hits, flat and writable."""

    range_m: np.ndarray
    object_id: np.ndarray
    material: np.ndarray
    incidence: np.ndarray
    clarity: np.ndarray

    @classmethod
    def nothing(cls, n: int) -> "_Met":
        far, dark, clear = (
            np.full(n, MAX_RANGE_M, np.float32),
            np.zeros(n, np.float32),
            np.ones(n, np.float32),
        )
        return cls(far, np.zeros(n, np.uint16), np.zeros(n, np.uint8), dark, clear)

    def nearer(self, which: np.ndarray, found, object_id, material: np.ndarray) -> None:
        """Take over, for the rays `which`, what a cast (Solid.hit) limited to the ranges so far has found.

        object_id: one, or one for each ray; material: of each face.
        """
        face, range_m, _, cosine = found
        seen = face >= 0
        which = which[seen]
        self.range_m[which], self.incidence[which], self.clarity[which] = range_m[seen], cosine[seen], 1.0
        self.object_id[which] = np.broadcast_to(object_id, seen.shape)[seen]
        self.material[which] = material[face[seen]]


def rays(sensor: Sensor, T_world_sensor: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Origin and direction (W * H, 3) float32 of each beam, world frame; one pose or one for each column.

    Column by column, so that neighbours in memory are neighbours in space.
    """
    pose = np.broadcast_to(np.asarray(T_world_sensor, float), (sensor.shape[1], 4, 4))
    turn = pose[:, :3, :3].transpose(0, 2, 1).astype(np.float32)
    origin = sensor.offset.transpose(1, 0, 2) @ turn + pose[:, None, :3, 3].astype(np.float32)
    return origin.reshape(-1, 3), (sensor.direction.transpose(1, 0, 2) @ turn).reshape(-1, 3)


def _in_the_wind(world: World, items: list, pass_index: int) -> Mesh:
    """The items as one mesh, the plants as the wind of this pass holds them."""
    mesh = merge([item.mesh for item in items])
    rng = np.random.default_rng([world.seed, pass_index, 7])
    vertices, start = mesh.vertices.copy(), 0
    for item in items:
        stop = start + len(item.mesh.vertices)
        if item.kind in SWAYING:
            above = item.mesh.vertices[:, 2:] - item.mesh.vertices[:, 2].min()
            vertices[start:stop, :2] += above * rng.normal(0, SWAY, 2)
        start = stop
    # Leaves are loose triangles: each shifts whole.
    leaf = mesh.faces[mesh.material == Material.LEAF]
    vertices[leaf] += rng.normal(0, LEAF_JITTER_M, (len(leaf), 1, 3)).astype(np.float32)
    return Mesh(vertices, mesh.faces, mesh.material)
