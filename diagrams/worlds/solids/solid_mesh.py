"""Solids as textured triangles: the faces of a spec, packed into one picture."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from splatpilot.diagrams.worlds.solids.shading import Illumination, shade
from splatpilot.diagrams.worlds.solids.solid import MATERIALS, Face, Solid, WorldSpec, faces_of
from splatpilot.diagrams.worlds.solids.surfaces import GROUND_REACH
from splatpilot.systems.collision.shapes import HalfSpace
from splatpilot.systems.splats.scene import GaussianScene

Array = NDArray[np.floating]
type Indices = NDArray[np.integer]

_SAGITTA = 0.002
"""[m], how far a triangle of a curved face may be from the surface."""
_PAD = 2  # [px] around each face in the picture, so that filters see no neighbor
_LIGHT_STEP = 6  # [px] between places where light is computed; it varies more slowly than patterns
_PAGE = 4096  # [px] width and height of a picture
GROUND_BELT = 6.0
"""[m], width of the belt of ground around the volume that is drawn finely."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles with one picture."""

    vertices: Array  # (V, 3) [m], in W
    uv: Array  # (V, 2) in [0, 1], from the upper left corner of the picture
    triangles: Indices  # (T, 3), counter-clockwise seen from outside
    picture: NDArray[np.uint8]  # (H, W, 3), sRGB red, green, blue
    smooth: bool = True  # whether the picture is interpolated between its pixels


@dataclass(frozen=True, eq=False)
class _Tile:
    solid: Solid
    face: Face
    offset: Array  # (2,) [m], of the tile's corner on the face
    size: Array  # (2,) [m]
    pixels: NDArray[np.integer]  # (2,) width and height, with padding


def mesh_of(spec: WorldSpec, light: Illumination, texel: float) -> list[Mesh]:
    """Triangles and pictures of all solids, `texel` [m] a pixel; signs are finer."""
    tiles = [
        tile
        for solids, step in ((spec.solids, texel), (spec.scenery, 4 * texel))
        for solid in solids
        for face in faces_of(solid.shape, spec.lower_W, spec.upper_W)
        for tile in _tiles(solid, face, step)
    ]
    tiles.sort(key=lambda tile: (-tile.pixels[1], -tile.pixels[0]))  # stable: same in, same out
    meshes = []
    for page, height in _shelves(tiles):
        picture = np.zeros((height, _PAGE, 3), dtype=np.uint8)
        parts = []
        for tile, (x, y) in page:
            picture[y : y + tile.pixels[1], x : x + tile.pixels[0]] = _paint(tile, spec, light)
            parts.append(_triangulate(tile, x, y, height))
        counts = np.cumsum([0, *(len(vertices) for vertices, _, _ in parts)])
        meshes.append(
            Mesh(
                np.concatenate([vertices for vertices, _, _ in parts]),
                np.concatenate([uv for _, uv, _ in parts]),
                np.concatenate([t + n for (_, _, t), n in zip(parts, counts[:-1], strict=True)]),
                picture,
            )
        )
    return meshes


def _tiles(solid: Solid, face: Face, texel: float) -> list[_Tile]:
    """Pieces of a face small enough for a picture; far ground is coarse."""
    size, texel = np.array(face.size), min(texel, 0.5 * MATERIALS[solid.material].spacing)
    if isinstance(solid.shape, HalfSpace):
        belt = GROUND_REACH - GROUND_BELT
        cuts = [np.array([0.0, belt, s - belt, s]) for s in size]
        pieces = [
            (np.array([cuts[0][i], cuts[1][j]]), np.array([cuts[0][i + 1], cuts[1][j + 1]]))
            for i in range(3)
            for j in range(3)
        ]
        texels = [texel if k == 4 else 8 * texel for k in range(9)]
    else:
        pieces, texels = [(np.zeros(2), size)], [texel]
    tiles = []
    for (low, high), step in zip(pieces, texels, strict=True):
        limit = (_PAGE // 2) * step  # [m]
        n = np.ceil((high - low) / limit).astype(int)
        part = (high - low) / n
        for i, j in np.ndindex(*n):
            pixels = np.maximum(np.ceil(part / step).astype(int), 2) + 2 * _PAD
            tiles.append(_Tile(solid, face, low + part * (i, j), part, pixels))
    return tiles


def _shelves(tiles: list[_Tile]) -> list[tuple[list[tuple[_Tile, tuple[int, int]]], int]]:
    """Packs tiles, highest first, row by row into pages: tiles with places, and a page's height."""
    pages, page, x, y, shelf = [], [], 0, 0, 0
    for tile in tiles:
        width, height = (int(n) for n in tile.pixels)
        if x + width > _PAGE:
            x, y, shelf = 0, y + shelf, 0
        if y + height > _PAGE:
            pages.append((page, y))
            page, x, y, shelf = [], 0, 0, 0
        page.append((tile, (x, y)))
        x, shelf = x + width, max(shelf, height)
    pages.append((page, y + shelf))
    return pages


def _paint(tile: _Tile, spec: WorldSpec, light: Illumination) -> NDArray[np.uint8]:
    """The tile's part of the picture (H, W, 3), u to the right and v downwards."""
    width, height = (int(n) for n in tile.pixels)

    def at(columns, rows):
        """Face coordinates (columns x rows, 2) [m] of pixels."""
        steps = ((columns - _PAD) / (width - 2 * _PAD), (rows - _PAD) / (height - 2 * _PAD))
        st = np.stack(np.meshgrid(*steps), axis=-1).reshape(-1, 2)
        return tile.offset + np.clip(st, 0, 1) * tile.size

    uv = at(np.arange(width) + 0.5, np.arange(height) + 0.5)
    p, *_ = tile.face.at(uv)
    albedo = np.clip(tile.solid.albedo(uv, p), 0, 1)
    coarse = max(2, -(-width // _LIGHT_STEP)), max(2, -(-height // _LIGHT_STEP))
    columns, rows = (
        (np.arange(n) + 0.5) * size / n for n, size in zip(coarse, (width, height), strict=True)
    )
    q, n, _ = tile.face.at(at(columns, rows))
    falls = light.irradiance(q, n).astype(np.float32).reshape(coarse[1], coarse[0], 3)
    falls = np.asarray(cv2.resize(falls, (width, height)), dtype=np.float32).reshape(-1, 3)
    colors = shade(albedo, falls, light.haze, spec.plan.outside(p))
    return np.round(255 * np.clip(colors, 0, 1)).astype(np.uint8).reshape(height, width, 3)


def _triangulate(tile: _Tile, x: int, y: int, page_height: int) -> tuple[Array, Array, Indices]:
    """Vertices (V, 3), their places in the picture (V, 2) and triangles (T, 3) of one tile."""
    n = []
    for size, radius in zip(tile.size, tile.face.curved, strict=True):
        if np.isfinite(radius):
            chord = 2 * np.sqrt(2 * _SAGITTA * radius)
            n.append(max(8, int(np.ceil(size / chord))))
        else:
            n.append(1)
    s, t = np.meshgrid(np.linspace(0, 1, n[0] + 1), np.linspace(0, 1, n[1] + 1), indexing="ij")
    st = np.stack([s, t], axis=-1).reshape(-1, 2)
    p, normal, _ = tile.face.at(tile.offset + st * tile.size)
    inner = tile.pixels - 2 * _PAD
    uv = (np.array([x, y]) + _PAD + st * inner) / (_PAGE, page_height)
    k = np.arange(len(st)).reshape(n[0] + 1, n[1] + 1)
    a, b, c, d = (q.ravel() for q in (k[:-1, :-1], k[1:, :-1], k[1:, 1:], k[:-1, 1:]))
    triangles = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    corners = p[triangles]
    facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inwards = np.einsum("tk,tk->t", facing, normal[triangles].mean(axis=1)) < 0
    triangles[inwards] = triangles[inwards][:, ::-1]
    whole = np.linalg.norm(facing, axis=1) > 1e-12  # none at poles
    return p, uv, triangles[whole]


def mesh_of_gaussians(scene: GaussianScene) -> Mesh:
    """Flat Gaussians, leaves, as opaque diamonds, each in the color of one pixel."""
    N = len(scene)
    columns = int(np.ceil(np.sqrt(max(N, 1))))
    picture = np.zeros((columns, columns, 3), dtype=np.uint8)
    pixel = np.arange(N)
    picture[pixel // columns, pixel % columns] = np.round(255 * scene.base_colors)
    w, x, y, z = scene.quats.T.astype(float)
    R = Rotation.from_quat(np.column_stack([x, y, z, w])).as_matrix()
    along, across = (1.9 * scene.scales[:, k, None] * R[..., k] for k in (0, 1))
    p = scene.means[:, None] + np.stack([along, across, -along, -across], axis=1)
    center = (np.column_stack([pixel % columns, pixel // columns]) + 0.5) / columns
    a = 4 * pixel
    front = np.concatenate([np.column_stack([a, a + 1, a + 2]), np.column_stack([a, a + 2, a + 3])])
    return Mesh(
        vertices=p.reshape(-1, 3),
        uv=np.repeat(center, 4, axis=0),
        triangles=front,
        picture=picture,
        smooth=False,
    )
