"""`splatpilot scene fetch`: makes the scenes of the photorealistic scenarios."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from splatpilot.analysis.reconstruction import run as reconstruction
from splatpilot.analysis.reconstruction.measure_scene import METRICS, measure_scene
from splatpilot.analysis.reconstruction.run import RenderedSceneConfig
from splatpilot.diagrams.worlds.scene_folder import read_scene_metadata
from splatpilot.systems.common.config import load_config
from splatpilot.systems.common.files import DATA, require_existing
from splatpilot.systems.common.validation import unknown
from splatpilot.training.captures import render as render_capture
from splatpilot.training.reconstruction.config import ReconstructConfig


class Recipe(NamedTuple):
    """The source of a scene, and the settings of its reconstruction."""

    source: str  # a capture or a mesh, below the folder of data, or a scenario
    settings: tuple[str, ...] = ()  # of `RenderedSceneConfig`, as --set takes them


RECIPES = {
    "hospital": Recipe("tartanair/hospital", ("voxel_size=0.05",)),
    "bookstore": Recipe("worlds/bookstore.gltf", ("render.up=z", "initial_gaussians=160000")),
    # Optimization moves Gaussians in steps that grow with the cameras' extent. In halls and
    # buildings, Gaussians that start from exact depth need smaller steps.
    "warehouse": Recipe(
        "worlds/warehouse.gltf", ("render.up=z", "initial_gaussians=430000", "means_rate=4e-5")
    ),
    "hospital_building": Recipe(
        "worlds/hospital_building.gltf",
        (
            "render.up=z",
            "render.highest=2.0",
            "render.apart=6",
            "render.spacing=1.4",
            "initial_gaussians=1000000",
            "iterations=10000",
            "means_rate=4e-5",
        ),
    ),
    "forest_splat": Recipe("P02"),
    "alley_splat": Recipe("P09"),
}
"""Recipes of the scenes that scenarios fly in, by the scene's name."""

BENCHMARK_SCENES = tuple(name for name in RECIPES if name != "alley_splat")


def default_config() -> RenderedSceneConfig:
    """Returns the configuration that recipes and overrides change."""
    config = RenderedSceneConfig(split="test")
    return replace(config, render=replace(config.render, split="test"))


def run(
    *, names: Sequence[str], data: Path | None, scenes: Path, overrides: Sequence[str] = ()
) -> None:
    """Makes the scene folders `scenes/NAME`, one after the other; the same call resumes.

    Rendered captures are kept in `scenes/captures/NAME`.

    Args:
        names: keys of `RECIPES`; the benchmark's if empty.
        data: folder of captures and meshes; generated worlds do not need it.
        scenes: folder in which scenarios look for scenes.
        overrides: FIELD=VALUE of `RenderedSceneConfig`, for all of them.
    """
    names = list(names) or list(BENCHMARK_SCENES)
    for name in names:
        if name not in RECIPES:
            raise ValueError(unknown("scene", name, RECIPES))
    sources = [_find_source(RECIPES[name].source, data) for name in names]
    configs = [
        load_config(default_config(), overrides=[*RECIPES[name].settings, *overrides])
        for name in names
    ]
    for name, source, config in zip(names, sources, configs, strict=True):
        print(f"== {name}, from {source}", flush=True)
        capture = scenes / "captures" / name
        if isinstance(source, Path) and source.is_dir():
            capture = source
        else:
            render_capture.run(world=source, out=capture, config=config.render)
        _make_scene(capture, scenes / name, config.reconstruct())


def _find_source(source: str, data: Path | None) -> str | Path:
    """Returns a scenario's name, or the path of an existing capture or mesh."""
    if "/" not in source:
        return source
    if data is None:
        raise ValueError(f"No folder with {source}; give --data or set {DATA}")
    require_existing(data / source, "a capture or a mesh")
    return data / source


def _make_scene(capture: Path, scene: Path, config: ReconstructConfig) -> None:
    """Reconstructs and measures a capture, unless its scene is finished already."""
    if not (scene / "scene.yaml").is_file():
        reconstruction.run(capture=capture, out=scene, config=config)
        return
    made_of = read_scene_metadata(scene).capture
    if Path(made_of) != capture.absolute():
        raise ValueError(
            f"the capture of {scene} must be {capture}, got {made_of or 'another one'}; choose "
            "another --out"
        )
    if (scene / METRICS).is_file():
        print(f"{scene}: is reconstructed already")
    else:
        print(measure_scene(scene))
