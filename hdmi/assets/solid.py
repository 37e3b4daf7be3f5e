"""A triangle mesh as a solid: which points are inside of it, and where its surface is nearest."""

from __future__ import annotations

import numpy as np
import trimesh

_MERGE = 1e-6  # of the mesh's size: vertices this near to each other are one


class Solid:
    """Signed distances from a mesh, in memory that grows with points plus faces, not with their product.

    Inside and outside do not depend on how the file orders the corners of its triangles. Each closed shell is solid,
    whichever way it faces, and so is what is inside of it. Faces that enclose nothing by themselves (a scan without a
    bottom, shells with cracks) are taken to face outwards or inwards together; inside is then where the generalized
    winding number (Jacobson et al., 2013) exceeds one half, which closes holes as a soap film would.

    Raises:
        ImportError: without libigl (extra `retarget`).
    """

    def __init__(self, mesh: trimesh.Trimesh):
        try:
            import igl
        except ImportError as error:
            raise ImportError("distances from meshes need libigl: pip install 'hdmi[retarget]'") from error
        self._igl = igl
        mesh = mesh.copy()
        digits = int(np.ceil(-np.log10(_MERGE * mesh.scale)))
        mesh.merge_vertices(merge_tex=True, merge_norm=True, digits_vertex=digits)
        # doubled faces, once for each side, would cancel each other
        mesh.update_faces(mesh.unique_faces() & mesh.nondegenerate_faces())
        mesh.remove_unreferenced_vertices()
        self._vertices = np.ascontiguousarray(mesh.vertices, dtype=np.float64)
        self._faces = self._outwards(np.ascontiguousarray(mesh.faces, dtype=np.int64))
        self._bounds = np.stack([self._vertices.min(axis=0), self._vertices.max(axis=0)])
        self._tree = igl.AABB()
        self._tree.init(self._vertices, self._faces)

    def nearest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The surface's points nearest to the given ones, and how far they are, negative inside.

        Args:
            points: m. [N, 3]

        Returns:
            Distances, m [N], and points of the surface. [N, 3]
        """
        points = np.ascontiguousarray(points, dtype=np.float64)
        if not len(points):
            return np.zeros(0), np.zeros((0, 3))
        squared, _, nearest = self._tree.squared_distance(self._vertices, self._faces, points)
        distance = np.sqrt(np.reshape(squared, -1).clip(min=0))
        low, high = self._bounds
        near = np.flatnonzero(((points >= low) & (points <= high)).all(axis=1))
        if near.size:
            turns = np.reshape(self._igl.fast_winding_number(self._vertices, self._faces, points[near]), -1)
            distance[near[turns > 0.5]] *= -1
        return distance, np.reshape(nearest, (-1, 3))

    def _outwards(self, faces: np.ndarray) -> np.ndarray:
        """The faces with their normals outwards. [F, 3]"""
        given = faces
        faces, patch = self._igl.bfs_orient(faces)  # alike within each patch of neighbours
        patch = np.reshape(patch, -1)
        count = patch.max() + 1
        edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]], axis=-1).reshape(-1, 2)
        edges, uses = np.unique(np.column_stack([edges, np.repeat(patch, 3)]), axis=0, return_counts=True)
        is_open = np.bincount(edges[:, 2], uses != 2, count) > 0
        corners = self._vertices[faces]  # [F, 3, 3]
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1)
        kept = (faces == given).all(axis=1)
        # what is open keeps the way that most of it faces in the file
        flip = np.where(
            is_open,
            np.bincount(patch, area * np.where(kept, 1, -1), count),
            np.bincount(patch, _volume(corners), count),
        )
        sign = np.where(flip < 0, -1, 1)
        loose = is_open[patch]
        if loose.any():
            centre = np.average(corners[loose].mean(axis=1), axis=0, weights=area[loose])
            if (_volume(corners[loose] - centre) * sign[patch[loose]]).sum() < 0:
                sign[is_open] *= -1
        turned = sign[patch] < 0
        faces = np.array(faces)
        faces[turned] = faces[turned][:, ::-1]
        return np.ascontiguousarray(faces)


def _volume(corners: np.ndarray) -> np.ndarray:
    """Six times the signed volumes of the tetrahedra between triangles and the origin. [F, 3, 3] -> [F]"""
    return np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
