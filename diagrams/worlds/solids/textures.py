"""Procedural textures: colors as pure functions of position.

Colors are sRGB in 0 to 1. Positions are in meters; scale them before the call to stretch a pattern.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.floating]

_PRIMES = np.array([0x9E3779B1, 0x85EBCA77, 0xC2B2AE3D], dtype=np.uint32)


def hash_unit(cell: ArrayLike, seed: int = 0) -> Array:
    """Returns a pseudo-random number in [0, 1) for every lattice cell (..., d), d = 1 to 3, by the
    `lowbias32` hash."""
    cell = np.asarray(cell).astype(np.int64).astype(np.uint32)  # wraps negative cells
    h = np.full(cell.shape[:-1], _seeded(seed), dtype=np.uint32)
    for axis in range(cell.shape[-1]):
        h = _mix_bits(h ^ (cell[..., axis] * _PRIMES[axis]))
    return _unit(h)


def _seeded(seed: int) -> int:
    return (seed * 0x27D4EB2F + 0x165667B1) & 0xFFFFFFFF


def _unit(h: NDArray[np.uint32]) -> Array:
    return (h >> np.uint32(8)).astype(np.float32) * np.float32(2**-24)


def _mix_bits(h: NDArray[np.uint32]) -> NDArray[np.uint32]:
    h = (h ^ (h >> np.uint32(16))) * np.uint32(0x7FEB352D)
    h = (h ^ (h >> np.uint32(15))) * np.uint32(0x846CA68B)
    return h ^ (h >> np.uint32(16))


def value_noise(p: ArrayLike, seed: int = 0) -> Array:
    """Computes smooth noise in [-1, 1] with a period of about two units at (..., d), d = 1 to 3.
    Random values on the integer lattice are blended with 6 t^5 - 15 t^4 + 10 t^3."""
    p = np.asarray(p, dtype=np.float64)
    # Weight and hash of each corner of a cell, axis by axis.
    corners = [(np.float32(1.0), np.uint32(_seeded(seed)))]
    for along, prime in zip(p.reshape(-1, p.shape[-1]).T, _PRIMES, strict=False):
        cell = np.floor(along)
        t = (along - cell).astype(np.float32)
        fade = t * t * t * (t * (t * 6 - 15) + 10)
        near = cell.astype(np.int64).astype(np.uint32) * prime
        ends = (1 - fade, near), (fade, near + prime)
        corners = [
            (weight * part, _mix_bits(h ^ end)) for weight, h in corners for part, end in ends
        ]
    total = sum(weight * _unit(h) for weight, h in corners)
    return (2 * total - 1).reshape(p.shape[:-1])


def fbm(p: ArrayLike, octaves: int, seed: int = 0) -> Array:
    """Sums octaves of `value_noise`, (...,) in [-1, 1], each twice as fine and half as strong."""
    p = np.asarray(p, dtype=np.float64)
    total = np.zeros(p.shape[:-1], dtype=np.float32)
    for octave in range(octaves):
        total += 0.5**octave * value_noise(p * 2.0**octave, seed + octave)
    return total / (2 - 0.5 ** (octaves - 1))


def smoothstep(low: float, high: float, x: ArrayLike) -> Array:
    """Rises from 0 at `low` to 1 at `high` with zero slope at both ends; falls if low > high."""
    t = np.clip((np.asarray(x, dtype=np.float32) - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def mix(a: ArrayLike, b: ArrayLike, t: ArrayLike) -> Array:
    """Blends the colors a (..., 3) and b (..., 3) by the weight t (...,) of b."""
    t = np.asarray(t, dtype=np.float32)[..., None]
    return np.asarray(a, dtype=np.float32) * (1 - t) + np.asarray(b, dtype=np.float32) * t


def ramp(colors: ArrayLike, t: ArrayLike) -> Array:
    """Interpolates a palette: t (...,) in [0, 1] runs through `colors` (M, 3)."""
    colors = np.asarray(colors, dtype=np.float32)
    t, position = np.asarray(t, dtype=np.float32), np.linspace(0, 1, len(colors))
    return np.stack([np.interp(t, position, c) for c in colors.T], axis=-1).astype(np.float32)


# Materials. Bark takes points p (..., 3) in a frame whose z axis runs along the trunk.

OAK, PINE, BIRCH = range(3)


def bark(species: int, p: ArrayLike) -> Array:
    """Returns the color of bare bark at p (..., 3) of the species OAK, PINE or BIRCH."""
    p = np.asarray(p, dtype=np.float64)
    patches = fbm(p * (1.6, 1.6, 0.9), 3, seed=11)
    grain = fbm(p * (24, 24, 5), 2, seed=12)
    if species == BIRCH:
        white = mix((0.80, 0.78, 0.72), (0.50, 0.47, 0.43), smoothstep(-0.25, 0.45, patches))
        # Old wood near the ground breaks up into dark scales.
        scales = smoothstep(-0.1, 0.35, fbm(p * (5, 5, 2.5), 3, seed=13) + 0.75 - 1.1 * p[..., 2])
        return mix(white, (0.22, 0.19, 0.17), scales) * (1 + 0.10 * grain[..., None])
    if species == PINE:
        plates = ramp([(0.34, 0.27, 0.23), (0.49, 0.39, 0.32), (0.58, 0.48, 0.40)], 0.5 + patches)
        # Pines turn orange and papery with height.
        high = smoothstep(2.5, 6.5, p[..., 2] + patches)
        plates = mix(plates, (0.63, 0.43, 0.29), 0.65 * high)
    else:
        plates = ramp([(0.31, 0.28, 0.25), (0.46, 0.42, 0.37), (0.58, 0.54, 0.48)], 0.5 + patches)
    lichen = smoothstep(0.25, 0.45, fbm(p * (3, 3, 2), 3, seed=14))
    plates = mix(plates, (0.62, 0.66, 0.56), 0.45 * lichen)
    return plates * (1 + 0.22 * grain[..., None])


def fissure(species: int, p: ArrayLike) -> Array:
    """Returns the color in the cracks between the plates of the bark at p (..., 3)."""
    if species == BIRCH:
        return bark(BIRCH, p)
    tint = (0.60, 0.53, 0.48) if species == PINE else (0.50, 0.47, 0.44)
    return bark(species, p) * np.asarray(tint, dtype=np.float32)


def moss(p: ArrayLike) -> Array:
    """Returns the color of moss at p (..., 3)."""
    p = np.asarray(p, dtype=np.float64)
    return ramp(
        [(0.19, 0.24, 0.10), (0.31, 0.36, 0.15), (0.45, 0.46, 0.22)],
        0.5 + 0.6 * fbm(p * 4, 3, seed=21),
    )


def stone(p: ArrayLike) -> Array:
    """Returns the color of weathered rock at p (..., 3)."""
    p = np.asarray(p, dtype=np.float64)
    gray = ramp(
        [(0.24, 0.24, 0.23), (0.36, 0.35, 0.33), (0.48, 0.46, 0.43)],
        0.5 + 0.7 * fbm(p * 5, 4, seed=31),
    )
    return mix(gray, (0.56, 0.56, 0.45), 0.4 * smoothstep(0.2, 0.4, fbm(p * 7, 2, seed=32)))


def forest_floor(p: ArrayLike) -> tuple[Array, Array]:
    """Returns the color of soil, needles and moss at p (..., 2), and the weight of moss (...,)."""
    p = np.asarray(p, dtype=np.float64)
    litter = ramp(
        [(0.25, 0.18, 0.12), (0.40, 0.29, 0.19), (0.53, 0.40, 0.26)],
        0.5 + 0.55 * fbm(p * 0.8, 4, seed=41) + 0.2 * value_noise(p * 9, seed=42),
    )
    mossy = smoothstep(0.02, 0.32, fbm(p * 0.45, 4, seed=43))
    green = moss(np.concatenate([p, np.zeros_like(p[..., :1])], axis=-1))
    return mix(litter, green, 0.85 * mossy), mossy


def fallen_leaf(p: ArrayLike) -> Array:
    """Returns the color of the dead leaf at p (..., 2), one per cell of 5 mm."""
    palette = [
        *((0.30, 0.19, 0.11), (0.47, 0.30, 0.16), (0.62, 0.42, 0.21)),
        *((0.70, 0.52, 0.27), (0.55, 0.25, 0.11), (0.74, 0.61, 0.26)),
    ]
    return ramp(palette, hash_unit(np.floor(np.asarray(p) / 0.005), seed=51))


def leaf(species: int, p: ArrayLike) -> Array:
    """Returns the color of living leaves or needles at p (..., 3)."""
    p = np.asarray(p, dtype=np.float64)
    palettes = {
        OAK: [(0.20, 0.32, 0.09), (0.34, 0.46, 0.14), (0.50, 0.58, 0.20)],
        PINE: [(0.13, 0.23, 0.12), (0.21, 0.33, 0.16), (0.32, 0.43, 0.20)],
        BIRCH: [(0.36, 0.45, 0.12), (0.52, 0.58, 0.18), (0.68, 0.68, 0.25)],
    }
    shade = 0.5 + 0.5 * fbm(p * 0.7, 2, seed=61) + 0.25 * value_noise(p * 5, seed=62)
    return ramp(palettes[species], shade)
