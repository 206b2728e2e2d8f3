"""Rays against a world, by Embree: what each beam of each column meets, every column from its own pose."""

from dataclasses import dataclass

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore import EmbreeDevice
from embreex.rtcore_scene import EmbreeScene

from ..frame import Sensor
from .mesh import Material, Mesh, merge, rotation
from .worlds import World

MAX_RANGE_M = 120.0
MOVER_REACH_M = 70.0  # movers farther away are not cast
LEAF_JITTER_M = 0.02
SWAY = 0.012  # how far a plant leans in the wind of a pass: metres per metre of height
SWAYING = frozenset({"tree", "bush", "grass", "hedge"})


@dataclass(frozen=True, eq=False)
class Hits:
    """What the beams of one rotation met, free of noise; all (H, W), staggered."""

    range_m: np.ndarray  # float32; inf where nothing within MAX_RANGE_M
    object_id: np.ndarray  # uint16, see World.kinds; 0 where nothing
    material: np.ndarray  # uint8, see mesh.Material; meaningless where nothing
    incidence: np.ndarray  # float32, |cos| of the angle between beam and surface normal

    @property
    def range_mm(self) -> np.ndarray:
        """(H, W) uint32, 0 where nothing was met."""
        return np.where(np.isfinite(self.range_m), np.rint(self.range_m * 1e3), 0).astype(np.uint32)


class Caster:
    """The static world of one pass as an Embree scene, and its movers as small scenes of their own."""

    def __init__(self, world: World, pass_index: int = 0):
        there = [(k + 1, item) for k, item in enumerate(world.items) if item.is_there(pass_index)]
        sizes = [len(item.mesh.faces) for _, item in there]
        mesh = _in_the_wind(world, there, pass_index)
        self._static = _Scene(mesh)
        self._face_object = np.repeat([k for k, _ in there], sizes).astype(np.uint16)
        first = len(world.items) + 1
        self._terrain = world.terrain
        self._movers = [
            (first + k, mover, [_Scene(mesh) for mesh in mover.meshes])
            for k, mover in enumerate(world.movers) if mover.pass_index == pass_index
        ]

    def cast(self, sensor: Sensor, T_world_sensor: np.ndarray, t_s: np.ndarray | None = None):
        """-> range_mm (H, W) uint32 (0 = nothing met), object_id (H, W) uint16. Arguments as in `trace`."""
        hits = self.trace(sensor, T_world_sensor, t_s)
        return hits.range_mm, hits.object_id

    def trace(self, sensor: Sensor, T_world_sensor: np.ndarray, t_s: np.ndarray | None = None) -> Hits:
        """One rotation from one pose (4, 4) or from a pose for each column (W, 4, 4).

        t_s: (W,) seconds since the patrol's start, which place the movers; without it there are none.
        """
        height, width = sensor.shape
        pose = np.broadcast_to(np.asarray(T_world_sensor, float), (width, 4, 4))
        turn = pose[:, :3, :3].transpose(0, 2, 1).astype(np.float32)
        # Rays lie column by column, (W, H, 3), so that neighbours in memory are neighbours in space.
        origin = sensor.offset.transpose(1, 0, 2) @ turn + pose[:, None, :3, 3].astype(np.float32)
        ray = sensor.direction.transpose(1, 0, 2) @ turn
        origin, ray = (np.ascontiguousarray(a, np.float32).reshape(-1, 3) for a in (origin, ray))
        range_m, face, material, incidence = self._static.hit(origin, ray, np.full(len(ray), MAX_RANGE_M, np.float32))
        object_id = np.where(face >= 0, self._face_object[face], 0).astype(np.uint16)
        met = [range_m, object_id, material, incidence]
        if t_s is not None:
            column = np.repeat(np.arange(width), height)
            for number, mover, scenes in self._movers:
                self._add_mover(met, number, mover, scenes, origin, ray, np.asarray(t_s, float), column)
        range_m, object_id, material, incidence = (np.ascontiguousarray(a.reshape(width, height).T) for a in met)
        return Hits(np.where(object_id > 0, range_m, np.float32(np.inf)), object_id, material, incidence)

    def _add_mover(self, met, number, mover, scenes, origin, ray, t_s, column) -> None:
        """Overwrites what was met where the mover is nearer; the mover, too, moves on from column to column."""
        middle = len(t_s) // 2
        xy, yaw = mover.place(t_s)
        z = float(self._terrain.height(xy[middle]))
        centre = np.array([*xy[middle], z + 0.9]) - origin[len(origin) // 2]
        distance = np.linalg.norm(centre)
        if distance > MOVER_REACH_M:
            return
        scene = scenes[mover.mesh_at(t_s[middle])]
        reach = scene.radius_m + 0.3 + mover.speed_m_s * (t_s[-1] - t_s[0])
        within = np.cos(np.arcsin(min(1.0, reach / distance))) if reach < distance else -1.0
        near = np.flatnonzero(ray @ (centre / distance).astype(np.float32) > within)
        if not len(near):
            return
        at = column[near]
        back = rotation(yaw).astype(np.float32)  # v @ R = R^T v: world to mover
        shift = np.concatenate([xy, np.full((len(xy), 1), z)], 1).astype(np.float32)
        local = np.einsum("ni,nij->nj", origin[near] - shift[at], back[at])
        heading = np.einsum("ni,nij->nj", ray[near], back[at])
        range_m, face, material, incidence = scene.hit(local, heading, met[0][near])
        seen = face >= 0
        for values, new in zip(met, (range_m, np.full(len(near), number), material, incidence), strict=True):
            values[near[seen]] = new[seen]


class _Scene:
    """One mesh in Embree."""

    def __init__(self, mesh: Mesh):
        self._device = EmbreeDevice()  # the scene does not keep it alive
        self._scene = EmbreeScene(self._device)
        self._mesh = TriangleMesh(self._scene, mesh.vertices, mesh.faces)
        self._material = mesh.material
        low, high = mesh.vertices.min(0), mesh.vertices.max(0)
        self.radius_m = float(np.linalg.norm(np.maximum(np.abs(low), np.abs(high)) - [0, 0, 0.9]))

    def hit(self, origin: np.ndarray, ray: np.ndarray, limit_m: np.ndarray):
        """(N, 3), (N, 3), (N,) float32 -> range (N,) float32, face (N,) int32 (-1: none), material, |cos| incidence."""
        found = self._scene.run(origin, ray, dists=limit_m, output=True)
        face, normal = found["primID"], found["Ng"]
        size = np.sqrt(np.einsum("ni,ni->n", normal, normal))
        cosine = np.abs(np.einsum("ni,ni->n", normal, ray)) / np.maximum(size, 1e-12)
        return found["tfar"], face, self._material[face], cosine.astype(np.float32)


def _in_the_wind(world: World, there, pass_index: int) -> Mesh:
    """The items that are there as one mesh, with the plants as the wind of this pass holds them."""
    mesh = merge([item.mesh for _, item in there])
    rng = np.random.default_rng([world.seed, pass_index, 7])
    vertices = mesh.vertices.copy()
    start = 0
    for _, item in there:
        stop = start + len(item.mesh.vertices)
        if item.kind in SWAYING:
            above = item.mesh.vertices[:, 2:] - item.mesh.vertices[:, 2].min()
            vertices[start:stop, :2] += above * rng.normal(0, SWAY, 2)
        start = stop
    # Leaves are loose triangles: each shifts whole.
    leaf = mesh.faces[mesh.material == Material.LEAF]
    vertices[leaf] += rng.normal(0, LEAF_JITTER_M, (len(leaf), 1, 3)).astype(np.float32)
    return Mesh(vertices, mesh.faces, mesh.material)
