"""Exact views of a room of rectangles, by ray casting in NumPy.

The inverse depth of a rectangle, and its texture coordinates over depth, are affine in the pixel: no matrix product per
ray. Textures are filtered to the pixel's footprint (mip levels of Gaussian prefiltered images) and silhouettes are
antialiased with 8 samples per pixel, so that two views of a surface agree to about half a grey level.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np

from gavo_jax.camera import Camera
from gavo_jax.datasets.rendered.room import Faces, Room
from gavo_jax.datasets.rendered.textures import LEVELS, Atlas

_NEAR = 0.05
_SEAM = 1e-4
_TEXEL_PER_PIXEL = 1.0
_SUPERSAMPLES = np.array([[-7, -3], [-5, 3], [-3, -7], [-1, 7], [1, -1], [3, 5], [5, -5], [7, 1]], np.float32) / 16
_CHUNK = 16384


@dataclass(frozen=True)
class _View:
    """The faces that a camera sees, in pixels.

    forms: [F, 3, 3] float32; row @ (x, y, 1) gives the inverse depth q (1/m), q s and q t of a face at pixel (x, y);
    box: [F, 4] pixels x0, x1, y0, y1 that hold the face; distance: [F] metres from the camera to the face's plane;
    seen: indices of the faces in view, the nearest first.
    """

    forms: np.ndarray
    box: np.ndarray
    distance: np.ndarray
    seen: np.ndarray


@dataclass(frozen=True)
class _Hits:
    """The first hit of each ray: inverse depth q (0: no hit), q s and q t (s, t: metres along the face), face index."""

    inverse_depth: np.ndarray
    scaled_s: np.ndarray
    scaled_t: np.ndarray
    face: np.ndarray


def render(room: Room, camera: Camera, world_T_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Render one view by ray casting; the camera's distortion is ignored.

    Args:
        room: what is seen.
        camera: pinhole of H x W pixels.
        world_T_camera: [4, 4], camera to world, metres.

    Returns:
        grey: float32 [H, W], grey levels.
        depth: float32 [H, W], metres along the optical axis, exact at the pixels' centres; 0 where no face is hit.
        face: int32 [H, W], index of the face that each pixel's centre shows.
    """
    view = _look(room.faces, camera, world_T_camera)
    x = np.arange(camera.width, dtype=np.float32)[None, :]
    y = np.arange(camera.height, dtype=np.float32)[:, None]

    def grid_rays(face: int) -> tuple[np.ndarray, np.ndarray, tuple[slice, slice]]:
        x0, x1, y0, y1 = view.box[face]
        columns, rows = slice(x0, x1 + 1), slice(y0, y1 + 1)
        return x[:, columns], y[rows], (rows, columns)

    hits = _trace(room.faces, view, (camera.height, camera.width), grid_rays)
    grey = _shade(room.atlas, view, camera, hits, x, y)
    rows, columns = np.nonzero(_silhouettes(hits.face))
    for start in range(0, len(rows), _CHUNK):
        chunk = slice(start, start + _CHUNK)
        grey[rows[chunk], columns[chunk]] = _supersample(room, view, camera, columns[chunk], rows[chunk])
    hit = hits.inverse_depth > 0
    depth = np.divide(1.0, hits.inverse_depth, out=np.zeros_like(grey), where=hit)
    return grey, depth, hits.face


def _look(faces: Faces, camera: Camera, world_T_camera: np.ndarray) -> _View:
    rotation, position = world_T_camera[:3, :3], world_T_camera[:3, 3]
    u, v, normal = faces.u @ rotation, faces.v @ rotation, faces.normal @ rotation
    origin = (faces.origin - position) @ rotation
    # A point z r on the plane: n . (z r - o) = 0, so q = 1/z = n . r / n . o, and s q = u . r - (u . o) q.
    offset = np.einsum("fi,fi->f", normal, origin)
    facing = offset < -1e-6
    q = normal / np.where(facing, offset, 1.0)[:, None]
    s = u - np.einsum("fi,fi->f", u, origin)[:, None] * q
    t = v - np.einsum("fi,fi->f", v, origin)[:, None] * q
    fx, fy, cx, cy = (float(value) for value in (camera.fx, camera.fy, camera.cx, camera.cy))
    rays_from_pixels = np.array([[1 / fx, 0, -cx / fx], [0, 1 / fy, -cy / fy], [0, 0, 1]])
    forms = np.stack([q, s, t], axis=1) @ rays_from_pixels

    corners = (faces.corners() - position) @ rotation
    ahead = corners[..., 2] > _NEAR
    z = np.where(ahead, corners[..., 2], 1.0)
    px, py = fx * corners[..., 0] / z + cx, fy * corners[..., 1] / z + cy
    whole = np.array([0, camera.width - 1, 0, camera.height - 1])
    box = np.stack([np.floor(px.min(1)), np.ceil(px.max(1)), np.floor(py.min(1)), np.ceil(py.max(1))], axis=1)
    box = np.where(ahead.all(axis=1, keepdims=True), box, whole).astype(int)
    inside = (box[:, 1] >= 0) & (box[:, 3] >= 0) & (box[:, 0] <= whole[1]) & (box[:, 2] <= whole[3])
    seen = np.nonzero(facing & ahead.any(axis=1) & inside)[0]
    seen = seen[np.argsort(corners[seen, :, 2].min(1))]
    box = np.clip(box, 0, whole[[1, 1, 3, 3]])
    return _View(forms.astype(np.float32), box, np.abs(offset), seen)


def _trace(faces: Faces, view: _View, shape: tuple[int, ...], rays: Callable) -> _Hits:
    """The nearest face along each ray; `rays(face)` gives x, y and place in `shape` of the rays that may meet it."""
    q, s, t = (np.zeros(shape, np.float32) for _ in range(3))
    hits = _Hits(q, s, t, np.zeros(shape, np.int32))
    for face in view.seen:
        x, y, place = rays(face)
        (qx, qy, q1), (sx, sy, s1), (tx, ty, t1) = view.forms[face]
        size_s, size_t = (np.float32(size + _SEAM) for size in faces.size[face])
        q = qx * x + (qy * y + q1)
        s = sx * x + (sy * y + s1)
        t = tx * x + (ty * y + t1)
        seam = np.float32(-_SEAM) * q
        first = (q > hits.inverse_depth[place]) & (s >= seam) & (t >= seam) & (s <= size_s * q) & (t <= size_t * q)
        for buffer, value in zip((hits.inverse_depth, hits.scaled_s, hits.scaled_t), (q, s, t), strict=True):
            buffer[place] = np.where(first, value, buffer[place])
        hits.face[place] = np.where(first, face, hits.face[place])
    return hits


def _shade(atlas: Atlas, view: _View, camera: Camera, hits: _Hits, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Grey of every hit: the texture filtered to the pixel's footprint, between the two nearest mip levels."""
    z = 1 / np.maximum(hits.inverse_depth, np.float32(1e-6))
    rx, ry = (x - np.float32(camera.cx)) / np.float32(camera.fx), (y - np.float32(camera.cy)) / np.float32(camera.fy)
    # The cone of a pixel meets a plane at distance d in an ellipse of long axis z^2 |r|^2 / (f d), r = (rx, ry, 1).
    focal = math.sqrt(float(camera.fx) * float(camera.fy))
    bias = np.log2(_TEXEL_PER_PIXEL / (focal * np.maximum(view.distance, 1e-6) * atlas.texel)).astype(np.float32)
    lod = np.log2(z * z * (rx * rx + ry * ry + 1)) + bias[hits.face]
    lod = np.clip(lod, 0, LEVELS - 1.001)
    level = lod.astype(np.int32)
    first = hits.face * LEVELS + level
    s, t = hits.scaled_s * z, hits.scaled_t * z
    fine = _sample(atlas, first, s, t)
    return fine + (_sample(atlas, first + 1, s, t) - fine) * (lod - level)


def _sample(atlas: Atlas, index: np.ndarray, s: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Bilinear look-up at (s, t) metres in image `index` = face * LEVELS + level."""
    scale = (1 / (atlas.texel[:, None] * 2.0 ** np.arange(LEVELS))).astype(np.float32).ravel()[index]
    first = (atlas.corner.reshape(-1, 2) - 0.5).astype(np.float32)
    column, row = s * scale + first[:, 0][index], t * scale + first[:, 1][index]
    return cv2.remap(atlas.image, column, row, cv2.INTER_LINEAR)


def _silhouettes(face: np.ndarray) -> np.ndarray:
    """Pixels that have a neighbour on another face, bool [H, W]."""
    edge = np.zeros(face.shape, bool)
    across, down = face[:, 1:] != face[:, :-1], face[1:] != face[:-1]
    edge[:, 1:] |= across
    edge[:, :-1] |= across
    edge[1:] |= down
    edge[:-1] |= down
    return edge


def _supersample(room: Room, view: _View, camera: Camera, columns: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Grey of some pixels as the mean over several rays in each; columns, rows (rising): [n] -> [n]."""
    x, y = (c.astype(np.float32)[:, None] + _SUPERSAMPLES[:, i] for i, c in enumerate((columns, rows)))

    def listed_rays(face: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the pixels of the face's rows (they come row by row) that the face reaches into."""
        start, stop = np.searchsorted(rows, view.box[face, 2:] + [-1, 2])
        centre = np.stack([columns[start:stop], rows[start:stop], np.ones(stop - start)]).astype(np.float32)
        q, s, t = view.forms[face] @ centre
        slack_q, slack_s, slack_t = np.abs(view.forms[face, :, :2]).sum(axis=1) / 2 + np.float32(_SEAM)
        size_s, size_t = room.faces.size[face]
        reached = (q > -slack_q) & (s > -slack_s) & (t > -slack_t)
        reached &= (s < size_s * (q + slack_q) + slack_s) & (t < size_t * (q + slack_q) + slack_t)
        place = start + np.flatnonzero(reached)
        return x[place], y[place], place

    hits = _trace(room.faces, view, x.shape, listed_rays)
    return _shade(room.atlas, view, camera, hits, x, y).mean(axis=1)
