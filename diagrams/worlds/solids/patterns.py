"""Procedural colors of surfaces: a `Pattern` each."""

from collections.abc import Callable
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from splatpilot.diagrams.worlds.solids import textures
from splatpilot.diagrams.worlds.solids.textures import (
    BIRCH,
    OAK,
    PINE,
    fbm,
    hash_unit,
    mix,
    ramp,
    smoothstep,
    value_noise,
)

Array = NDArray[np.floating]
type Pattern = Callable[[Array, Array, int], Array]
"""Maps face coordinates uv (N, 2) [m] (v upwards on upright faces), points p (N, 3) [m] in the
solid's own frame and the solid's seed to colors (N, 3), sRGB in 0 to 1."""


def _tone(seed: int, strength: float = 0.35) -> Array:
    """Returns a factor (3,) of brightness and warmth for a solid."""
    bright, warm = (float(hash_unit([[seed]], k)[0]) - 0.5 for k in (71, 72))
    return (1 + strength * bright) * (1 + warm * np.array([0.16, 0.0, -0.18]))


def _cells(uv: Array, width: float, height: float, shift: float) -> tuple[Array, Array]:
    """Returns cells (N, 2) of a bond of courses, and distances (N,) [m] to their nearest edge."""
    row = np.floor(uv[:, 1] / height)
    u = uv[:, 0] / width + shift * (row % 2)
    column = np.floor(u)
    across = (0.5 - np.abs(u - column - 0.5)) * width
    up = (0.5 - np.abs(uv[:, 1] / height - row - 0.5)) * height
    return np.stack([column, row], axis=-1), np.minimum(across, up)


_BRICKS = (
    [(0.36, 0.16, 0.12), (0.56, 0.27, 0.19), (0.68, 0.41, 0.30)],
    [(0.55, 0.43, 0.26), (0.70, 0.57, 0.37), (0.80, 0.70, 0.51)],
    [(0.33, 0.32, 0.32), (0.48, 0.46, 0.44), (0.60, 0.58, 0.54)],
    [(0.78, 0.75, 0.68), (0.86, 0.84, 0.79), (0.62, 0.38, 0.28)],
)
BRICK = 0.30, 0.15  # [m], width and height of a brick with its mortar


def brick(uv: Array, p: Array, seed: int) -> Array:
    """`Pattern` of bricks in running bond with mortar, weathered; the seed picks the clay."""
    cell, edge = _cells(uv, *BRICK, 0.5)
    stone = ramp(_BRICKS[seed % len(_BRICKS)], hash_unit(cell, seed))
    stone = stone * (1 + 0.12 * value_noise(p * 30, seed=101))[:, None]
    weather = 0.5 + 0.5 * fbm(p * 0.5, 3, seed=102)
    stone = stone * (0.75 + 0.4 * weather)[:, None]
    mortar = np.array([0.50, 0.47, 0.43]) * _tone(seed, 0.3)
    return mix(mortar, stone, smoothstep(0.008, 0.016, edge))


def concrete(uv: Array, p: Array, seed: int) -> Array:
    """`Pattern` of cast concrete, streaked by rain, with joints every 2.4 m and 1.2 m."""
    gray = ramp(
        [(0.42, 0.41, 0.39), (0.60, 0.59, 0.57), (0.74, 0.73, 0.70)],
        0.5 + 0.55 * fbm(p * 0.7, 4, seed=111) + 0.12 * value_noise(p * 11, seed=112),
    )
    panel, joint = _cells(uv, 2.4, 1.2, 0.0)
    gray = gray * (0.9 + 0.2 * hash_unit(panel, seed))[:, None]
    streak = smoothstep(0.15, 0.5, fbm(np.stack([uv[:, 0] * 5, uv[:, 1] * 0.4], -1), 2, seed=113))
    gray = mix(gray, (0.29, 0.28, 0.25), 0.55 * streak)
    return mix((0.25, 0.24, 0.23), gray, smoothstep(0.01, 0.05, joint)) * _tone(seed)


def wood(uv: Array, p: Array, seed: int) -> Array:
    """`Pattern` of upright planks, 0.18 m wide and 1.6 m long; the seed picks the timber."""
    plank, joint = _cells(uv[:, ::-1], 1.6, 0.18, 0.37)
    pick = hash_unit(plank, seed)
    grain = fbm(np.stack([uv[:, 0] * 22 + 9 * pick, uv[:, 1] * 1.6 + 31 * pick], -1), 3, seed=121)
    palette = (
        [(0.36, 0.22, 0.12), (0.56, 0.37, 0.21), (0.72, 0.53, 0.33)],
        [(0.48, 0.38, 0.26), (0.66, 0.54, 0.38), (0.80, 0.69, 0.52)],
    )[seed % 2]
    wood = ramp(palette, 0.3 + 0.4 * pick + 0.35 * grain)
    return mix((0.13, 0.09, 0.06), wood, smoothstep(0.002, 0.012, joint)) * _tone(seed)


_PAINTS = np.array(
    [
        *((0.70, 0.16, 0.12), (0.13, 0.33, 0.55), (0.84, 0.60, 0.10), (0.19, 0.42, 0.24)),
        *((0.78, 0.77, 0.73), (0.86, 0.40, 0.10), (0.30, 0.32, 0.35), (0.10, 0.48, 0.50)),
    ]
)


def metal(uv: Array, p: Array, seed: int) -> Array:
    """`Pattern` of painted sheet, corrugated every 0.4 m, partly rusty."""
    paint = _PAINTS[seed % len(_PAINTS)]
    wave = 0.82 + 0.18 * np.sin(uv[:, 0] * (2 * np.pi / 0.4))
    sheet = paint * wave[:, None] * (1 + 0.1 * fbm(p * 1.5, 3, seed=131))[:, None]
    rust = smoothstep(0.15, 0.42, fbm(p * (1.4, 1.4, 0.8), 4, seed=132))
    brown = ramp([(0.24, 0.11, 0.06), (0.47, 0.24, 0.12)], 0.5 + fbm(p * 6, 2, seed=133))
    return mix(sheet, brown, 0.8 * rust) * _tone(seed, 0.2)


def hazard(uv: Array, p: Array, seed: int) -> Array:
    """`Pattern` of slanted warning stripes, worn; two pairs of colors."""
    stripe = smoothstep(-0.08, 0.08, np.sin((uv[:, 0] + uv[:, 1]) * (2 * np.pi / 0.7)))
    pair = (((0.88, 0.68, 0.08), (0.10, 0.10, 0.10)), ((0.86, 0.85, 0.82), (0.72, 0.12, 0.10)))
    light, dark = pair[seed % 2]
    color = mix(dark, np.broadcast_to(light, (len(uv), 3)), stripe)
    worn = smoothstep(0.2, 0.5, fbm(p * 2.5, 4, seed=141))
    return mix(color, (0.46, 0.45, 0.43), 0.7 * worn)


SIGN = 1.2, 0.6  # [m], width and height of one sign; larger faces repeat it
_WORDS = "EXIT", "GATE 7", "SPLATPILOT", "BAY 12", "SLOW", "NO ENTRY", "ROW C", "CAFE", "LEVEL 2"


@cache
def _sign_board(seed: int) -> Array:
    """Draws a sign, (96, 192, 3) in 0 to 1, first row at the top."""
    ground = _PAINTS[seed % len(_PAINTS)]
    ink = (255, 250, 240) if ground.mean() < 0.6 else (20, 26, 41)
    board = np.full((96, 192, 3), np.round(255 * ground), dtype=np.uint8)
    cv2.rectangle(board, (4, 4), (187, 91), ink, 3, cv2.LINE_AA)
    word = _WORDS[seed // len(_PAINTS) % len(_WORDS)]
    (width, height), _ = cv2.getTextSize(word, cv2.FONT_HERSHEY_DUPLEX, 1.0, 4)
    scale = min(160 / width, 34 / height)
    size = round(width * scale), round(height * scale)
    origin = 96 - size[0] // 2, 44 + size[1] // 2 - 8
    cv2.putText(board, word, origin, cv2.FONT_HERSHEY_DUPLEX, scale, ink, 4, cv2.LINE_AA)
    cv2.arrowedLine(board, (40, 74), (152, 74), ink, 5, cv2.LINE_AA, 0, 0.16)
    return board / 255.0


def signage(uv: Array, p: Array, seed: int) -> Array:
    """`Pattern` of signs of `SIGN` [m], one word and an arrow each; the seed picks the word."""
    board = _sign_board(seed % (len(_PAINTS) * len(_WORDS)))
    u, v = (uv / SIGN % 1.0).T
    rows = np.minimum(((1 - v) * board.shape[0]).astype(int), board.shape[0] - 1)
    columns = np.minimum((u * board.shape[1]).astype(int), board.shape[1] - 1)
    return board[rows, columns]


def plaster(uv: Array, p: Array, seed: int) -> Array:
    """`Pattern` of painted plaster with a darker dado up to 1 m above the foot of the face."""
    walls = (0.86, 0.83, 0.75), (0.74, 0.80, 0.80), (0.83, 0.74, 0.66), (0.80, 0.82, 0.70)
    color = np.array(walls[seed % len(walls)]) * (1 + 0.08 * fbm(p * 1.1, 4, seed=151))[:, None]
    low = smoothstep(1.02, 0.98, uv[:, 1])
    color = mix(color, color * (0.55, 0.62, 0.66), low)
    line = smoothstep(0.04, 0.02, np.abs(uv[:, 1] - 1.0))
    return mix(color, (0.25, 0.22, 0.20), line)


def tiles(uv: Array, p: Array, seed: int) -> Array:
    """`Pattern` of floor tiles of 0.5 m, light and dark in turn."""
    cell, edge = _cells(uv, 0.5, 0.5, 0.0)
    odd = cell.sum(axis=-1) % 2
    light, dark = (
        ((0.80, 0.77, 0.70), (0.52, 0.38, 0.30)),
        ((0.78, 0.80, 0.82), (0.36, 0.42, 0.48)),
    )[seed % 2]
    tile = mix(dark, np.broadcast_to(light, (len(uv), 3)), odd)
    tile = tile * (0.85 + 0.3 * hash_unit(cell, seed + 1))[:, None]
    tile = tile * (1 + 0.1 * fbm(p * 3, 3, seed=161))[:, None]
    return mix((0.35, 0.33, 0.31), tile, smoothstep(0.004, 0.016, edge))


def ceiling(uv: Array, p: Array, seed: int) -> Array:
    """`Pattern` of ceiling panels of 1.2 m by 0.6 m, partly stained."""
    cell, edge = _cells(uv, 1.2, 0.6, 0.0)
    panel = (0.80 + 0.12 * hash_unit(cell, seed))[:, None] * np.array([1.0, 0.99, 0.95])
    stain = smoothstep(0.3, 0.6, fbm(p * 0.9, 3, seed=162))
    panel = mix(panel, (0.62, 0.54, 0.40), 0.5 * stain)
    return mix((0.42, 0.42, 0.42), panel, smoothstep(0.008, 0.03, edge))


def foliage(uv: Array, p: Array, seed: int) -> Array:
    """`Pattern` of a clipped hedge: leaves in clumps, dark between them."""
    clump = 0.5 + 0.6 * fbm(p * 2.2, 3, seed=171) + 0.35 * value_noise(p * 13, seed=172)
    green = textures.leaf((OAK, PINE, BIRCH)[seed % 3], p)
    return green * (0.35 + 0.95 * np.clip(clump, 0, 1))[:, None]


def grass(uv: Array, p: Array, seed: int) -> Array:
    """`Pattern` of a lawn, partly bare; depends on x and y of the points only."""
    q = p[:, :2]
    blade = 0.5 + 0.45 * fbm(q * 0.6, 4, seed=181) + 0.22 * value_noise(q * 8, seed=182)
    green = ramp([(0.22, 0.29, 0.10), (0.38, 0.44, 0.16), (0.58, 0.58, 0.28)], blade)
    bare = smoothstep(0.16, 0.36, fbm(q * 0.33, 4, seed=183))
    return mix(green, ramp([(0.36, 0.28, 0.19), (0.56, 0.46, 0.33)], blade), 0.9 * bare)


def paving(uv: Array, p: Array, seed: int) -> Array:
    """`Pattern` of slabs of 0.8 m, every other row shifted by half a slab."""
    cell, edge = _cells(uv, 0.8, 0.8, 0.5)
    slab = ramp([(0.40, 0.38, 0.36), (0.55, 0.53, 0.50), (0.68, 0.64, 0.58)], hash_unit(cell, 5))
    slab = slab * (0.9 + 0.25 * fbm(p[:, :2] * 0.8, 4, seed=191))[:, None]
    return mix((0.24, 0.24, 0.20), slab, smoothstep(0.008, 0.03, edge))


def forest_floor(uv: Array, p: Array, seed: int) -> Array:
    """`Pattern` of soil, needles and moss, see `textures.forest_floor`."""
    return textures.forest_floor(p[:, :2])[0]


def stone(uv: Array, p: Array, seed: int) -> Array:
    """`Pattern` of weathered rock, see `textures.stone`."""
    return textures.stone(p) * _tone(seed)


def cable(uv: Array, p: Array, seed: int) -> Array:
    """`Pattern` of black rubber with a colored sleeve every 1.5 m along z."""
    sleeve = smoothstep(0.38, 0.42, np.abs(p[:, 2] / 1.5 % 1.0 - 0.5))
    return mix((0.10, 0.10, 0.11), np.broadcast_to(_PAINTS[seed % 3], (len(p), 3)), sleeve)


def fabric(uv: Array, p: Array, seed: int) -> Array:
    """`Pattern` of woven upholstery with soft folds."""
    weave = 0.85 + 0.15 * np.sin(uv * (2 * np.pi / 0.12)).prod(axis=-1)
    fold = 1 + 0.35 * fbm(p * 3, 3, seed=201)
    return _PAINTS[(seed + 3) % len(_PAINTS)] * (0.85 * weave * fold)[:, None]


def crate(uv: Array, p: Array, seed: int) -> Array:
    """`Pattern` of cardboard with a strip of tape every 0.8 m."""
    color = np.array((0.66, 0.50, 0.33)) * (1 + 0.1 * fbm(p * 4, 3, seed=211))[:, None]
    tape = smoothstep(0.05, 0.04, np.abs(uv[:, 0] % 0.8 - 0.4))
    return mix(color * _tone(seed), (0.80, 0.74, 0.60), tape)


def bark(species: int, uv: Array, p: Array, seed: int) -> Array:
    """`Pattern` of the bark of a species OAK, PINE or BIRCH; z is along the trunk."""
    plates = textures.bark(species, p)
    cracks = value_noise(p * (34, 34, 6), seed=15) + 0.5 * value_noise(p * (60, 60, 14), seed=16)
    dark = plates * (0.80 if species == BIRCH else 0.52)
    rough = mix(dark, plates, smoothstep(-0.6, 0.2, cracks))
    if species == BIRCH:
        lines = smoothstep(0.52, 0.62, value_noise(np.stack([uv[:, 0] * 5, uv[:, 1] * 36], -1), 17))
        rough = mix(rough, (0.20, 0.18, 0.17), 0.85 * lines)
    return rough * _tone(seed, 0.42)
