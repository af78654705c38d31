"""`splatpilot scene fetch`: makes the scenes of the photorealistic scenarios."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from splatpilot.analysis.reconstruction import run as reconstruction
from splatpilot.analysis.reconstruction.measure_scene import METRICS, measure_scene
from splatpilot.analysis.reconstruction.run import RenderedSceneConfig
from splatpilot.diagrams.worlds.scene_folder import read_scene_metadata
from splatpilot.systems.common.config import load_config
from splatpilot.systems.common.files import DATA, require_existing
from splatpilot.systems.common.validation import unknown
from splatpilot.training.captures import render as render_capture

RECIPES: dict[str, tuple[str, ...]] = {
    "hospital": ("tartanair/hospital", "voxel_size=0.05"),
    "bookstore": ("worlds/bookstore.gltf", "render.up=z", "initial_gaussians=160000"),
    # Optimization moves Gaussians in steps that grow with the cameras' extent. In halls and
    # buildings, Gaussians that start from exact depth need smaller steps.
    "warehouse": (
        *("worlds/warehouse.gltf", "render.up=z", "initial_gaussians=430000", "means_rate=4e-5"),
    ),
    "hospital_building": (
        *("worlds/hospital_building.gltf", "render.up=z", "render.highest=2.0"),
        *("initial_gaussians=1000000", "iterations=10000", "means_rate=4e-5"),
    ),
    "forest_splat": ("P02",),
    "alley_splat": ("P09",),
}
"""By the name of a scene: a capture or a mesh below the folder of data, or a scenario, and settings
of `RenderedSceneConfig`."""

BENCHMARK_SCENES = tuple(name for name in RECIPES if name != "alley_splat")


def default_config() -> RenderedSceneConfig:
    """Returns the configuration that recipes and overrides change."""
    config = RenderedSceneConfig(split="test")
    return replace(config, render=replace(config.render, split="test"))


def run(
    *, names: Sequence[str], data: Path | None, scenes: Path, overrides: Sequence[str] = ()
) -> None:
    """Makes the scene folders `scenes/NAME` of `RECIPES`, or of the benchmark; the same call
    resumes. Rendered captures are kept in `scenes/captures/NAME`."""
    names = list(names) or list(BENCHMARK_SCENES)
    for name in names:
        if name not in RECIPES:
            raise ValueError(unknown("scene", name, RECIPES))
    sources: list[Path | str] = []
    for name in names:
        source = RECIPES[name][0]
        if "/" in source and data is None:
            raise ValueError(f"No folder with {source}; give --data or set {DATA}")
        if "/" in source and data is not None:
            require_existing(data / source, "a capture or a mesh")
            source = data / source
        sources.append(source)
    configs = [
        load_config(default_config(), overrides=[*RECIPES[name][1:], *overrides]) for name in names
    ]
    for name, source, config in zip(names, sources, configs, strict=True):
        print(f"== {name}, from {source}", flush=True)
        capture, scene = scenes / "captures" / name, scenes / name
        if isinstance(source, Path) and source.is_dir():
            capture = source
        else:
            render_capture.run(world=source, out=capture, config=config.render)
        if not (scene / "scene.yaml").is_file():
            reconstruction.run(capture=capture, out=scene, config=config.reconstruct())
            continue
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
