"""Embree: rays against one mesh. By embreex, or by open3d where embreex has no wheel (aarch64)."""

import numpy as np

from .mesh import Mesh

try:
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore import EmbreeDevice
    from embreex.rtcore_scene import EmbreeScene

    open3d = None
except ModuleNotFoundError as _missing:
    try:
        import open3d
    except ModuleNotFoundError:
        raise _missing from None

NO_FACE = -1


class Solid:
    """One mesh, ready for rays."""

    def __init__(self, mesh: Mesh):
        self._scene = _Open3dScene(mesh) if open3d else _EmbreexScene(mesh)
        self.material = mesh.material  # (M,) of each face
        low, high = mesh.vertices.min(0), mesh.vertices.max(0)
        self._middle, self._radius_m = (low + high) / 2, float(np.linalg.norm(high - low)) / 2

    def hit(self, origin: np.ndarray, ray: np.ndarray, limit_m: np.ndarray):
        """origin, ray: (N, 3), limit_m: (N,) -> face (N,) int32 (NO_FACE where none within limit_m), range
        (N,) float32 (limit_m where none), unit normal (N, 3) float32, |cos| of ray and normal (N,) float32.
        """
        if not len(ray):
            nothing = np.zeros(0, np.float32)
            return np.zeros(0, np.int32), nothing, np.zeros((0, 3), np.float32), nothing
        origin, ray, limit_m = (np.ascontiguousarray(part, np.float32) for part in (origin, ray, limit_m))
        face, range_m, normal = self._scene.hit(origin, ray, limit_m)
        normal /= np.maximum(np.sqrt(np.einsum("ni,ni->n", normal, normal)), np.float32(1e-12))[:, None]
        return face, range_m, normal, np.abs(np.einsum("ni,ni->n", normal, ray))

    def in_view(self, origin: np.ndarray, ray: np.ndarray, shift=(0.0, 0.0, 0.0), slack_m: float = 0.3) -> np.ndarray:
        """Indices of the rays that may meet the mesh moved by `shift`; the origins must lie close together."""
        centre = self._middle + shift - origin[len(origin) // 2]
        distance, reach = np.linalg.norm(centre), self._radius_m + slack_m
        if distance <= reach:
            return np.arange(len(ray))
        cosine = np.sqrt(1 - (reach / distance) ** 2)
        return np.flatnonzero(ray @ (centre / distance).astype(np.float32) > cosine)


class _EmbreexScene:
    def __init__(self, mesh: Mesh):
        self._device = EmbreeDevice()  # the scene does not keep it alive
        self._scene = EmbreeScene(self._device)
        self._mesh = TriangleMesh(self._scene, mesh.vertices, mesh.faces)

    def hit(self, origin, ray, limit_m):
        found = self._scene.run(origin, ray, dists=limit_m, output=True)
        return found["primID"], found["tfar"], found["Ng"]


class _Open3dScene:
    def __init__(self, mesh: Mesh):
        self._scene = open3d.t.geometry.RaycastingScene(nthreads=1)
        self._scene.add_triangles(mesh.vertices, mesh.faces.astype(np.uint32))

    def hit(self, origin, ray, limit_m):
        found = self._scene.cast_rays(open3d.core.Tensor(np.concatenate([origin, ray], 1)))
        range_m = found["t_hit"].numpy()
        near = range_m < limit_m
        face = np.where(near, found["primitive_ids"].numpy().astype(np.int32), np.int32(NO_FACE))
        return face, np.where(near, range_m, limit_m), found["primitive_normals"].numpy().copy()
