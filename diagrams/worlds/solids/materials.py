"""What solids are made of: their patterns, and how finely Gaussians must follow these."""

from dataclasses import dataclass
from functools import partial

from splatpilot.diagrams.worlds.solids import patterns
from splatpilot.diagrams.worlds.solids.textures import BIRCH, OAK, PINE


@dataclass(frozen=True)
class Marks:
    """Thin patches in front of a closed layer: joints, plates of bark, leaves."""

    cell: tuple[float, float]  # [m], spacing along u and v
    fill: tuple[float, float]  # standard deviation along u and v, over the spacing
    first: tuple[float, float] = (0.5, 0.5)  # place of the first, over the spacing
    jitter: float = 0.0  # largest displacement, over the spacing


@dataclass(frozen=True)
class Material:
    """A surface's colours and the spacing of the Gaussians that show them."""

    albedo: patterns.Pattern
    spacing: float  # [m], of the closed layer, which has the mean colours of the pattern
    marks: tuple[Marks, ...] = ()  # in front of it, in the pattern's own colours


def _joints(width: float, height: float, line: float, bond: bool = False) -> tuple[Marks, ...]:
    """The lines, of standard deviation `line` [m], between cells of a pattern; `bond` shifts every
    other course by half a cell."""
    n = max(1, round(width / 0.25)), max(1, round(height / 0.25))
    beds = Marks((width / n[0], height), (0.55, line / height), (0.5, 1.0))
    if not bond:
        return beds, Marks((width, height / n[1]), (line / width, 0.55), (1.0, 0.5))
    size = line / width, 0.25
    two = width, 2 * height
    return beds, Marks(two, size, (1.0, 0.25)), Marks(two, size, (0.5, 0.75))


_PLATES = (Marks((0.07, 0.18), (0.42, 0.42), jitter=0.35),)
_LEAVES = (Marks((0.12, 0.12), (0.36, 0.20), jitter=0.45),)

MATERIALS: dict[str, Material] = {
    "brick": Material(patterns.brick, 0.15, _joints(*patterns.BRICK, 0.007, bond=True)),
    "concrete": Material(patterns.concrete, 0.16, _joints(2.4, 1.2, 0.012)),
    "wood": Material(patterns.wood, 0.12, _joints(0.18, 1.6, 0.006)),
    "metal": Material(patterns.metal, 0.10),
    "hazard": Material(patterns.hazard, 0.10),
    "signage": Material(patterns.signage, 0.024),
    "plaster": Material(patterns.plaster, 0.14),
    "tiles": Material(patterns.tiles, 0.14, _joints(0.5, 0.5, 0.007)),
    "ceiling": Material(patterns.ceiling, 0.17, _joints(1.2, 0.6, 0.010)),
    "foliage": Material(patterns.foliage, 0.13, _LEAVES),
    "grass": Material(patterns.grass, 0.16, (Marks((0.17, 0.17), (0.30, 0.13), jitter=0.45),)),
    "paving": Material(patterns.paving, 0.18, _joints(0.8, 0.8, 0.012, bond=True)),
    "forest_floor": Material(patterns.forest_floor, 0.15),
    "stone": Material(patterns.stone, 0.08),
    "cable": Material(patterns.cable, 0.06),
    "fabric": Material(patterns.fabric, 0.07),
    "crate": Material(patterns.crate, 0.085),
    "oak": Material(partial(patterns.bark, OAK), 0.12, _PLATES),
    "pine": Material(partial(patterns.bark, PINE), 0.12, _PLATES),
    "birch": Material(partial(patterns.bark, BIRCH), 0.10),
}
