"""Procedural textures, sRGB in 0 to 1 as functions of position [m], and their illumination."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from splatpilot.systems.collision.esdf import Esdf

Array = NDArray[np.floating]

_PRIMES = np.array([0x9E3779B1, 0x85EBCA77, 0xC2B2AE3D], dtype=np.uint32)


def hash_unit(cell: ArrayLike, seed: int = 0) -> Array:
    """Returns `lowbias32` hashes (...,) in [0, 1) of lattice cells (..., d), d = 1 to 3."""
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
    """Computes noise (...,) in [-1, 1] at (..., d), d = 1 to 3: random values on the integer
    lattice, blended by 6 t^5 - 15 t^4 + 10 t^3."""
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


GAMMA = 2.2
HAZE_RANGE = 16.0  # [m], distance through the surroundings over which colors fade by a factor e


@dataclass(frozen=True, eq=False)
class Daylight:
    """Irradiance of one hour of the day; a white surface under 1 has full brightness."""

    direction: NDArray[np.float64]  # (3,), unit vector from the ground to the sun, in W
    sun: NDArray[np.float64]  # (3,) linear RGB, like `sky` and `ground`
    sky: NDArray[np.float64]
    ground: NDArray[np.float64]
    haze: NDArray[np.float64]  # (3,) sRGB, see `Illumination`

    @classmethod
    def sample(cls, rng: np.random.Generator) -> "Daylight":
        """Draws the hour: the lower the sun, the warmer its light."""
        azimuth, elevation = rng.uniform(-np.pi, np.pi), np.deg2rad(rng.uniform(32, 58))
        warmth = 0.8 * float(smoothstep(58, 32, np.rad2deg(elevation)))
        x, y = np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth)
        return cls(
            direction=np.array([x, y, np.sin(elevation)]),
            sun=2.6 * np.array([1.0, 0.93 - 0.08 * warmth, 0.80 - 0.22 * warmth]),
            sky=0.74 * np.array([0.93, 1.0, 0.99]),
            ground=0.33 * np.array([1.05, 1.0, 0.72]),
            haze=np.array([0.80, 0.86, 0.86]) + warmth * np.array([0.05, 0.0, -0.06]),
        )

    def irradiance(
        self, normal: ArrayLike, sunlit: ArrayLike, leafy: bool = False
    ) -> NDArray[np.float64]:
        """Computes linear light (N, 3) on unit normals (N, 3) in the fraction `sunlit` (N,) of the
        sun; leaves (`leafy`) let it through."""
        normal = np.asarray(normal)
        facing = normal @ self.direction
        facing = 0.35 + 0.65 * np.abs(facing) if leafy else np.clip(facing, 0, None)
        up = 0.5 + 0.5 * normal[:, 2:]
        return (
            self.sun * (np.asarray(sunlit) * facing)[:, None]
            + self.sky * (0.35 + 0.65 * up)
            + self.ground * (1 - up)
        )

    def through_canopy(self, p: ArrayLike, height: float, seed: int) -> NDArray[np.float32]:
        """Computes the fraction of the sun (N,) through leaves at `height` [m] to p (N, 3) [m]."""
        p = np.asarray(p)
        climb = np.clip(height - p[:, 2:], 0, None) / self.direction[2]
        hit = p[:, :2] + climb * self.direction[:2]
        gaps = fbm(hit * 0.42, 2, seed) + 0.55 * fbm(hit * 1.7, 2, seed + 7)
        return smoothstep(0.0, 0.22, gaps)

    def past_trunks(
        self, p: ArrayLike, trunks: ArrayLike, radii: ArrayLike, height: float
    ) -> NDArray[np.float32]:
        """Computes the fraction of the sun (N,) at p (N, 3) [m] past upright trunks at (M, 2) [m]
        with `radii` (M,) [m] and a height [m]."""
        p = np.asarray(p, dtype=np.float32)
        flat = self.direction[:2] / np.linalg.norm(self.direction[:2])
        reach = (height - p[:, 2]) * np.float32(np.hypot(*self.direction[:2]) / self.direction[2])
        along_p = p[:, :2] @ flat.astype(np.float32)
        across_p = p[:, :2] @ np.array([-flat[1], flat[0]], dtype=np.float32)
        lit = np.ones(len(p), dtype=np.float32)
        for trunk, radius in zip(np.asarray(trunks), np.asarray(radii), strict=True):
            along = np.float32(trunk @ flat) - along_p
            across = np.abs(np.float32(trunk @ (-flat[1], flat[0])) - across_p)
            shaded = (along > 1.2 * radius) & (along < reach) & (across < radius + 0.3)
            near = np.flatnonzero(shaded)
            blur = 0.04 + 0.02 * along[near]  # the penumbra widens with the distance
            edge = np.clip((across[near] - radius) / blur, -1, 1)
            lit[near] = np.minimum(lit[near], 0.5 + 0.5 * edge)
        return lit


def shade(
    albedo: NDArray, irradiance: ArrayLike, haze: ArrayLike, distance: ArrayLike
) -> NDArray[np.float64]:
    """Computes sRGB (N, 3) of an sRGB albedo (N, 3) in linear light (N, 3), see `fade`."""
    return fade(develop(albedo**GAMMA * np.asarray(irradiance)), haze, distance)


def develop(linear: ArrayLike) -> NDArray[np.float32]:
    """Converts linear light to sRGB, exposed like film so that nothing clips."""
    return ((1 - np.exp(-1.25 * np.asarray(linear))) ** (1 / GAMMA)).astype(np.float32)


def fade(colors: ArrayLike, haze: ArrayLike, distance: ArrayLike) -> NDArray[np.float64]:
    """Mixes `colors` (N, 3) with `haze` (3,): exp(-distance / HAZE_RANGE) of them remains."""
    clear = np.exp(-np.asarray(distance, dtype=np.float64) / HAZE_RANGE)[:, None]
    return np.asarray(colors) * clear + np.asarray(haze) * (1 - clear)


class Illumination(Protocol):
    """Light baked into colors."""

    @property
    def haze(self) -> Array:
        """(3,) sRGB, the color to which all colors fade with distance."""
        ...

    def irradiance(self, p_W: Array, n_W: Array) -> Array:
        """Computes light, linear (N, 3), at p_W (N, 3) [m] with unit normals n_W (N, 3)."""
        ...


@dataclass(frozen=True, eq=False)
class Sunlight:
    """Daylight with the shadows of a distance field."""

    daylight: Daylight
    esdf: Esdf

    @property
    def haze(self) -> Array:
        return self.daylight.haze

    def irradiance(self, p_W: Array, n_W: Array) -> Array:
        sunlit = np.zeros(len(p_W))
        toward = np.flatnonzero(n_W @ self.daylight.direction > 0)
        sunlit[toward] = self._sunlit(p_W[toward] + 0.12 * n_W[toward])
        return self.daylight.irradiance(n_W, sunlit) * openness(self.esdf, p_W, n_W)[:, None]

    def _sunlit(self, p_W: Array) -> Array:
        """Computes the fraction of the sun (N,) at points p_W (N, 3) by sphere tracing. The
        narrowest passage, as an angle, determines it: distant obstacles have soft shadows."""
        lit = np.ones(len(p_W))
        active = np.arange(len(p_W))
        traveled = np.full(len(p_W), 0.05)  # [m]
        for _ in range(14):
            p_WQ = p_W[active] + traveled[active, None] * self.daylight.direction
            distance = self.esdf.distance(p_WQ)
            inside = ~np.isnan(distance)
            active, distance = active[inside], distance[inside]
            lit[active] = np.minimum(lit[active], 0.5 + 7.0 * distance / (traveled[active] + 0.5))
            traveled[active] += np.clip(distance, 0.12, 2.5)
            active = active[lit[active] > 0]
        return np.clip(lit, 0, 1)


@dataclass(frozen=True, eq=False)
class Lamplight:
    """Lamps under a roof: panels of one tint."""

    lamps: Array  # (M, 3) [m]
    tint: Array  # (3,) linear RGB
    esdf: Esdf

    @property
    def haze(self) -> Array:
        return develop(0.25 * self.tint)

    def irradiance(self, p_W: Array, n_W: Array) -> Array:
        total = np.full(len(p_W), 0.45)
        for lamp in self.lamps:
            to_lamp = lamp - p_W
            squared = np.einsum("nk,nk->n", to_lamp, to_lamp)
            facing = np.einsum("nk,nk->n", to_lamp, n_W) / np.sqrt(squared + 1e-9)
            total += 5.0 * (0.2 + 0.8 * np.clip(facing, 0, None)) / (2.0 + squared)
            total += 5.0 * (np.abs(to_lamp) < (0.6, 0.3, 0.12)).all(axis=1)  # the panel itself
        return total[:, None] * self.tint * openness(self.esdf, p_W, n_W)[:, None]


def openness(esdf: Esdf, p_W: Array, n_W: Array) -> Array:
    """Computes the fraction (N,) of the sky seen from p_W (N, 3) [m] with normals n_W (N, 3): less
    in corners, where the distance grows slowly."""
    visible = np.zeros(len(p_W))
    for step in (0.25, 0.7):
        distance = esdf.distance(p_W + step * n_W)
        visible += 0.5 * np.clip(np.nan_to_num(distance, nan=step) / step, 0, 1)
    return 0.42 + 0.58 * visible
