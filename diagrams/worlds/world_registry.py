"""All worlds: their configurations and generators."""

import copy
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Protocol

from splatpilot.diagrams.worlds import indoor, outdoor
from splatpilot.diagrams.worlds.file_worlds import (
    OCTOMAP,
    MeshWorld,
    OctomapConfig,
    mesh_world,
    octomap_world,
)
from splatpilot.diagrams.worlds.forest.forest import forest_spec
from splatpilot.diagrams.worlds.forest.layout import ForestConfig
from splatpilot.diagrams.worlds.inserted import InsertedConfig, inserted_world
from splatpilot.diagrams.worlds.moving_spheres import DodgeDroneConfig, dodgedrone_world
from splatpilot.diagrams.worlds.scene_folder import SceneConfig, read_scene_world
from splatpilot.diagrams.worlds.solids.solid import WorldSpec, build
from splatpilot.diagrams.worlds.world import World
from splatpilot.systems.common.config import require_configuration
from splatpilot.systems.common.distributions import sample_distributions
from splatpilot.systems.common.registry import Registry
from splatpilot.systems.common.validation import check_seed


class WorldConfig(Protocol):
    """The configuration of a world: a dataclass."""

    __dataclass_fields__: ClassVar[dict[str, Any]]

    def validate(self) -> None: ...


@dataclass(frozen=True)
class WorldEntry:
    """A registered type of world."""

    config: type  # the type of its configurations
    make: Callable[[Any, int], World]  # from a configuration and a seed, deterministic
    make_spec: Callable[[Any, int], WorldSpec] | None = None  # the same as solids, if generated


# All worlds, by the names of their configurations' types
WORLDS = Registry("world", "splatpilot.worlds", WorldEntry)


def register_world(
    config: type,
    make: Callable[[Any, int], World] | None = None,
    make_spec: Callable[[Any, int], WorldSpec] | None = None,
) -> None:
    """Registers a world by its configuration's type. `make` and `make_spec` map a configuration
    and a seed to a world and to a spec, to train and render in; by default `make` draws it."""
    if make is None and make_spec is None:
        raise ValueError(f"{config.__name__}: give make or make_spec")
    require_configuration(config)
    draw = make or (lambda config, seed: build(make_spec(config, seed)))  # pyright: ignore
    WORLDS.add(config.__name__, WorldEntry(config, draw, make_spec))


def make_world(config: WorldConfig, seed: int) -> World:
    """Generates or reads the world of a registered configuration. The seed is of all that is
    generated or drawn, also from the configuration's distributions, see `sample_scenario`."""
    config = _draw(config, seed)
    world = WORLDS.entry_for(config).make(config, seed)
    if not isinstance(world, World):
        name, made = type(config).__name__, type(world).__name__
        raise ValueError(f"result of make for {name} must be a World, got {made}")
    made = replace(world)
    vars(made)["source"] = copy.deepcopy(config), seed
    if "baked" in vars(world):
        vars(made)["baked"] = world.baked
    return made


def _draw(config: WorldConfig, seed: int) -> WorldConfig:
    """Draws the distributions of a configuration, and validates it."""
    check_seed(seed)
    drawn = sample_distributions(config, seed, ("world",))
    drawn.validate()
    return drawn


def scene_config(path: Path) -> SceneConfig | OctomapConfig:
    """Returns the configuration of a scene or, by its suffix, of an OctoMap on disk."""
    kind = OctomapConfig if path.suffix.lower() == OCTOMAP else SceneConfig
    return kind(path=str(path))


def is_procedural(config: WorldConfig) -> bool:
    """Checks that the world is generated, so that `make_spec` makes it too."""
    return WORLDS.entry_for(config).make_spec is not None


def make_spec(config: WorldConfig, seed: int) -> WorldSpec:
    """Generates the solids, start and goal of a procedural world, without Gaussians and grids."""
    plan = WORLDS.entry_for(config).make_spec
    if plan is None:
        raise ValueError(f"{type(config).__name__} is not a generated world: it has no spec")
    return plan(_draw(config, seed), seed)


register_world(ForestConfig, make_spec=forest_spec)
register_world(outdoor.BranchesConfig, make_spec=outdoor.branches_spec)
register_world(outdoor.ClutterConfig, make_spec=outdoor.clutter_spec)
register_world(outdoor.WallsConfig, make_spec=outdoor.walls_spec)
register_world(indoor.RoomConfig, make_spec=indoor.room_spec)
register_world(indoor.OfficeConfig, make_spec=indoor.office_spec)
register_world(outdoor.OverUnderConfig, make_spec=outdoor.over_under_spec)
register_world(SceneConfig, read_scene_world)
register_world(InsertedConfig, inserted_world)
register_world(OctomapConfig, octomap_world)
register_world(MeshWorld, mesh_world)
register_world(DodgeDroneConfig, dodgedrone_world)
