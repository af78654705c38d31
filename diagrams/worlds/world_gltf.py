"""Worlds as glTF files: textured triangles of all solids, for engines that render meshes."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from splatpilot.diagrams.worlds.solids.solid import MATERIALS, Face, Solid, WorldSpec, cut_faces
from splatpilot.diagrams.worlds.solids.surfaces import GROUND_REACH, merge
from splatpilot.diagrams.worlds.solids.textures import Illumination, shade
from splatpilot.systems.collision.esdf_build import esdf_from_distance_field
from splatpilot.systems.collision.field_mesh import add_primitive, data_uri
from splatpilot.systems.collision.shapes import HalfSpace
from splatpilot.systems.common.files import write_text
from splatpilot.systems.splats.scene import GaussianScene

Array = NDArray[np.floating]
type Indices = NDArray[np.integer]

_SAGITTA = 0.002  # [m] maximum distance of a triangle from a curved face
_PAD = 2  # [px] around each face in the picture, so that filters see no neighbor
_LIGHT_STEP = 6  # [px] between points where light is computed, which varies slowly
_PAGE = 4096  # [px] width and height of a picture
_GROUND_BELT = 6.0  # [m] width of the belt of ground around the volume that is drawn finely
_NEAREST, _LINEAR, _CLAMP = 9728, 9729, 33071  # glTF samplers


@dataclass(frozen=True, eq=False)
class _Mesh:
    """Triangles with one picture."""

    vertices: Array  # (V, 3) [m], in W
    uv: Array  # (V, 2) in [0, 1], from the upper left corner of the picture
    triangles: Indices  # (T, 3), counter-clockwise seen from outside
    picture: NDArray[np.uint8]  # (H, W, 3), sRGB
    smooth: bool = True  # true if the picture is interpolated between its pixels


@dataclass(frozen=True, eq=False)
class _Tile:
    """A rectangle of a face."""

    solid: Solid
    face: Face
    offset: Array  # (2,) [m], of its corner on the face
    size: Array  # (2,) [m]
    pixels: NDArray[np.integer]  # (2,) width and height, with padding


def write_gltf(spec: WorldSpec, path: Path, texel: float = 0.02) -> None:
    """Writes the world of a spec as one self-contained .gltf file, y up. Light is baked into
    emissive pictures with pixels of `texel` [m] on the solids."""
    light = spec.light(esdf_from_distance_field(spec.distance_field, spec.voxel_size))
    meshes = _solid_meshes(spec, light, texel)
    if surroundings := spec.surroundings():
        meshes.append(_diamonds(merge(surroundings)))
    write_text(path, json.dumps(_document(meshes)))


def _document(meshes: list[_Mesh]) -> dict[str, Any]:
    """Returns a glTF 2.0 document that embeds everything."""
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "splatpilot"},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(meshes)))}],
        "samplers": [
            {"magFilter": f, "minFilter": f, "wrapS": _CLAMP, "wrapT": _CLAMP}
            for f in (_NEAREST, _LINEAR)
        ],
        "nodes": [{"mesh": k} for k in range(len(meshes))],
        "textures": [{"source": k, "sampler": int(m.smooth)} for k, m in enumerate(meshes)],
        "images": [{"uri": _picture_uri(mesh)} for mesh in meshes],
        "materials": [
            {
                "pbrMetallicRoughness": {
                    "baseColorFactor": [0, 0, 0, 1],
                    "metallicFactor": 0,
                    "roughnessFactor": 1,
                },
                "emissiveFactor": [1, 1, 1],
                "emissiveTexture": {"index": k},
                "doubleSided": not mesh.smooth,
            }
            for k, mesh in enumerate(meshes)
        ],
    }
    document["meshes"] = [
        {"primitives": [add_primitive(document, m.vertices, m.uv, m.triangles) | {"material": k}]}
        for k, m in enumerate(meshes)
    ]
    return document


def _picture_uri(mesh: _Mesh) -> str:
    """Encodes the picture as JPEG, or as PNG if pixels must not blend."""
    kind, options = ("jpeg", [cv2.IMWRITE_JPEG_QUALITY, 92]) if mesh.smooth else ("png", [])
    _, content = cv2.imencode(f".{kind}", mesh.picture[..., ::-1], options)
    return data_uri(f"image/{kind}", content.tobytes())


def _solid_meshes(spec: WorldSpec, light: Illumination, texel: float) -> list[_Mesh]:
    """Draws all solids, at most `texel` [m] a pixel."""
    tiles = [
        tile
        for solids, step in ((spec.solids, texel), (spec.scenery, 4 * texel))
        for solid in solids
        for face in cut_faces(solid.shape, spec.lower_W, spec.upper_W)
        for tile in _tiles(solid, face, step)
    ]
    tiles.sort(key=lambda tile: (-tile.pixels[1], -tile.pixels[0]))
    meshes = []
    for page, height in _pages(tiles):
        picture = np.zeros((height, _PAGE, 3), dtype=np.uint8)
        parts, count = [], 0
        for tile, (x, y) in page:
            picture[y : y + tile.pixels[1], x : x + tile.pixels[0]] = _paint(tile, spec, light)
            p, uv, corners = _triangulate(tile, x, y, height)
            parts.append((p, uv, corners + count))
            count += len(p)
        p, uv, corners = map(np.concatenate, zip(*parts, strict=True))
        meshes.append(_Mesh(p, uv, corners, picture))
    return meshes


def _tiles(solid: Solid, face: Face, texel: float) -> list[_Tile]:
    """Cuts a face into pieces small enough for a picture; distant ground is coarse."""
    size, texel = np.array(face.size), min(texel, 0.5 * MATERIALS[solid.material].spacing)
    pieces = [(np.zeros(2), size, texel)]
    if isinstance(solid.shape, HalfSpace):
        belt = GROUND_REACH - _GROUND_BELT
        cuts = np.stack([np.zeros(2), np.full(2, belt), size - belt, size], axis=1)  # (2, 4)
        pieces = [
            (cuts[(0, 1), (i, j)], cuts[(0, 1), (i + 1, j + 1)], texel * (1 if i == j == 1 else 8))
            for i, j in np.ndindex(3, 3)
        ]
    tiles = []
    for low, high, step in pieces:
        n = np.ceil((high - low) / ((_PAGE // 2) * step)).astype(int)
        part = (high - low) / n
        for i, j in np.ndindex(*n):
            pixels = np.maximum(np.ceil(part / step).astype(int), 2) + 2 * _PAD
            tiles.append(_Tile(solid, face, low + part * (i, j), part, pixels))
    return tiles


def _pages(tiles: list[_Tile]) -> list[tuple[list[tuple[_Tile, tuple[int, int]]], int]]:
    """Packs tiles, highest first, row by row: tiles with their positions, and a page's height."""
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
    """Draws the tile's part of the picture (H, W, 3), u to the right and v downwards."""
    width, height = (int(n) for n in tile.pixels)

    def at(columns, rows):
        """Returns face coordinates (columns x rows, 2) [m] of pixels."""
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
    """Returns vertices (V, 3), their picture coordinates (V, 2) and triangles (T, 3) of a tile."""
    n = [
        max(8, int(np.ceil(size / (2 * np.sqrt(2 * _SAGITTA * radius))))) if radius < np.inf else 1
        for size, radius in zip(tile.size, tile.face.curved, strict=True)
    ]
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
    return p, uv, triangles[np.linalg.norm(facing, axis=1) > 1e-12]  # empty at poles


def _diamonds(scene: GaussianScene) -> _Mesh:
    """Draws flat Gaussians, such as leaves, as opaque diamonds with the color of one pixel each."""
    N = len(scene)
    columns = int(np.ceil(np.sqrt(max(N, 1))))
    picture = np.zeros((columns, columns, 3), dtype=np.uint8)
    pixel = np.arange(N)
    picture[pixel // columns, pixel % columns] = np.round(255 * scene.base_colors)
    R = Rotation.from_quat(scene.quats.astype(float), scalar_first=True).as_matrix()
    along, across = (1.9 * scene.scales[:, k, None] * R[..., k] for k in (0, 1))
    p = scene.means[:, None] + np.stack([along, across, -along, -across], axis=1)
    center = (np.column_stack([pixel % columns, pixel // columns]) + 0.5) / columns
    a = 4 * pixel
    front = np.concatenate([np.column_stack([a, a + 1, a + 2]), np.column_stack([a, a + 2, a + 3])])
    return _Mesh(p.reshape(-1, 3), np.repeat(center, 4, axis=0), front, picture, smooth=False)
