"""Random changes of a world's colors: paint, light, exposure and sky; the geometry stays."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from splatpilot.diagrams.worlds.solids.textures import GAMMA
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.collision.esdf import interpolate_grid
from splatpilot.systems.splats.background import Background, EnvironmentMap
from splatpilot.systems.splats.scene import GaussianScene, color_to_sh

_PAINT = 0.35  # sRGB, largest change of a color
_PAINTS = 4  # along each axis of the color cube
_TINT = 0.25  # natural logarithm of the light's red, green and blue, over the mean
_EXPOSURE = -1.0, 0.5  # [EV], brighter images would saturate
_HUE = 1.0  # [rad]
_SATURATION = 0.6  # natural logarithm
_RELIEF = 0.6  # fraction of the light that comes from one direction
_MOTTLE = 0.15  # relative, of brightness over space
_WAVELENGTHS = 0.5, 5.0  # [m], of the mottling
_WAVES = 5
_SKY = 0.7  # fraction of another color in the background
_BATCH = 16384  # Gaussians, so that intermediate values stay in the cache
_STREAM = 7  # of a flight's seed

_GRAY = np.full((3, 3), 1 / 3)
_TURN = np.array([[0, -1, 1], [1, 0, -1], [-1, 1, 0]]) / np.sqrt(3)  # about the axis of grays

Array = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Appearance:
    """Parameters of one appearance."""

    paint: Array  # (4, 4, 4, 3) added to sRGB colors, a grid over their cube
    exposure: float  # factor of linear light
    mixing: Array  # (3, 3) of linear red, green, blue: tint, hue and saturation
    light_W: Array  # (3,) unit vector to the light
    relief: float  # in [0, 1], fraction of the light from there
    waves: Array  # (5, 4) wave vectors [rad/m] and phases [rad] of the mottling
    mottle: float
    sky: Array  # (3,) sRGB
    sky_part: float  # in [0, 1], fraction of the sky in the background


def draw_appearance(rng: np.random.Generator, strength: float) -> Appearance:
    """Draws an appearance; `strength` is 0 (no change) to 1 (full range)."""

    def uniform(limit: float, shape: tuple[int, ...] = ()) -> NDArray:
        return strength * rng.uniform(-limit, limit, shape)

    paint = uniform(_PAINT, (*[_PAINTS] * 3, 3))
    tint = np.exp(uniform(_TINT, (3,)))
    angle, saturation = uniform(_HUE), np.exp(uniform(_SATURATION))
    colorful = np.eye(3) - _GRAY
    hue = _GRAY + saturation * (np.cos(angle) * colorful + np.sin(angle) * _TURN)
    light = rng.normal(size=3)
    waves = rng.normal(size=(_WAVES, 4))
    waves[:, :3] /= np.linalg.norm(waves[:, :3], axis=1, keepdims=True)
    shortest, longest = np.log(_WAVELENGTHS)
    waves[:, :3] *= 2 * np.pi / np.exp(rng.uniform(shortest, longest, (_WAVES, 1)))
    return Appearance(
        paint=paint.astype(np.float32),
        exposure=float(2 ** (strength * rng.uniform(*_EXPOSURE))),
        mixing=(hue @ np.diag(tint)).astype(np.float32),
        light_W=(light / np.linalg.norm(light)).astype(np.float32),
        relief=float(strength * rng.uniform(0, _RELIEF)),
        waves=waves.astype(np.float32),
        mottle=float(strength * rng.uniform(0, _MOTTLE)),
        sky=rng.uniform(0, 1, 3).astype(np.float32),
        sky_part=float(strength * rng.uniform(0, _SKY)),
    )


def randomize_appearance(world: World, strength: float, seed: int) -> World:
    """Returns the world in an appearance drawn from the seed."""
    if strength == 0.0:
        return world
    rng = np.random.default_rng([seed, _STREAM])
    return with_appearance(world, draw_appearance(rng, strength))


def with_appearance(world: World, look: Appearance) -> World:
    """Returns the world in an appearance; moving obstacles keep their colors."""
    return world.recolored(
        recolored(world.gaussians, look), recolored_background(world.background, look)
    )


def recolored(scene: GaussianScene, look: Appearance) -> GaussianScene:
    """Returns the Gaussians, painted and lit again; their view dependence follows brightness."""
    before, normals = scene.base_colors, scene.normals  # (N, 3)
    after = np.empty_like(before)
    spacing = 1 / (_PAINTS - 1)
    grid = np.full(3, -0.5 * spacing), spacing
    paints = np.moveaxis(look.paint, -1, 0).copy()
    for first in range(0, len(before), _BATCH):
        some = slice(first, first + _BATCH)
        colors = before[some]
        added = [interpolate_grid(p, *grid, colors, with_gradient=False)[0] for p in paints]
        painted = np.clip(colors + np.stack(added, axis=1).astype(np.float32), 0, 1)
        # A Gaussian is lit alike from both sides. |cos| is 1/2 on average.
        facing = 2 * np.abs(normals[some] @ look.light_W)
        phases = look.waves[:, :3] @ scene.means[some].T + look.waves[:, 3:]  # (5, N)
        mottled = 1 + look.mottle * np.cos(phases).sum(axis=0) / np.sqrt(_WAVES)
        light = (1 - look.relief + look.relief * facing) * mottled
        linear = painted**GAMMA * (look.exposure * light)[:, None]
        after[some] = _to_srgb(linear @ look.mixing.T)
    sh = scene.sh.copy()
    sh[:, 0] = color_to_sh(after)
    if scene.sh_degree > 0:
        brighter = (after.sum(axis=1) + 0.01) / (before.sum(axis=1) + 0.01)
        sh[:, 1:] *= np.minimum(brighter, 2.0)[:, None, None]
    return replace(scene, sh=sh)


def recolored_background(background: Background, look: Appearance) -> Background:
    """Returns the background under the same light, mixed with another sky."""

    def recolor(color: NDArray) -> Array:
        mixed = (1 - look.sky_part) * color + look.sky_part * look.sky
        return _to_srgb(look.exposure * mixed**GAMMA @ look.mixing.T)

    if isinstance(background, EnvironmentMap):
        return EnvironmentMap(recolor(background.texels))
    return tuple(recolor(np.asarray(background, np.float32)).tolist())


def _to_srgb(linear: NDArray) -> Array:
    return (np.clip(linear, 0, 1) ** (1 / GAMMA)).astype(np.float32)
