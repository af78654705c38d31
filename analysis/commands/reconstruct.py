"""`splatpilot reconstruct`."""

import argparse
from pathlib import Path
from typing import Any

from splatpilot.analysis.commands.options import (
    SCENARIOS,
    add_overrides,
    add_overwrite,
    add_verb,
    find_place,
)

RENDERED = {".gltf", ".glb", ".obj", ".yaml", ".yml"}


def add_to(verbs: argparse._SubParsersAction) -> None:
    reconstruct = add_verb(
        verbs,
        "reconstruct",
        _reconstruct,
        help="make a scene to fly in from a capture, a mesh or a generated world",
        description="Renders a mesh or a generated world to OUT/capture first. Then fits "
        "Gaussians to the images and depth of a capture, measures them on frames "
        "that were held out, and leaves a scene folder with its distance field. Interrupted, the "
        "same command goes on.",
        examples=(
            "reconstruct data/hospital --out scenes/hospital",
            "reconstruct photos --out scenes/room --set capture.scale.camera_height=1.5",
            "reconstruct warehouse.gltf --up z --out scenes/warehouse",
        ),
    )
    reconstruct.add_argument(
        "source",
        type=Path,
        help="folder of a capture, a mesh (.glb, .gltf, .obj), or a scenario: P01 or a file",
    )
    reconstruct.add_argument("--out", type=Path, required=True, help="scene folder to write")
    reconstruct.add_argument("--iterations", type=int, help="optimization steps")
    reconstruct.add_argument(
        "--up", choices=("y", "z"), help="axis of the mesh file that points up"
    )
    reconstruct.add_argument("--seed", type=int, help="seed of a generated world")
    reconstruct.add_argument(
        "--restart", action="store_true", help="discard what an interrupted run has left"
    )
    add_overwrite(reconstruct)
    add_overrides(
        reconstruct,
        ("voxel_size=0.1", "image_width=640", "max_gaussians=200000", "device=cuda"),
        _defaults,
    )


def _reconstruct(options: argparse.Namespace) -> None:
    source = find_place(options.source, "capture", "mesh", "scenario")
    rendered = _is_rendered(source)
    for option in ("up", "seed"):
        if getattr(options, option) is not None and not rendered:
            raise ValueError(f"--{option} must be of a mesh or a scenario, got a capture, {source}")
    from splatpilot.systems.common.progress import say

    say(f"reconstructing {source} as {options.out}")
    from splatpilot.analysis.reconstruction import run as reconstruction
    from splatpilot.systems.common.config import load_config

    overrides = list(options.overrides)
    if options.iterations is not None:
        if any(override.startswith("iterations=") for override in overrides):
            raise ValueError("iterations are given by --iterations and by --set; keep one of them")
        overrides.append(f"iterations={options.iterations}")
    keywords: dict[str, Any] = {
        "out": options.out,
        "config": load_config(_defaults(options), overrides=overrides),
        "restart": options.restart,
        "overwrite": options.overwrite,
    }
    if not rendered:
        reconstruction.run(capture=source, **keywords)
        return
    if options.up is not None:
        keywords["config"].render.up = options.up
    reconstruction.run_rendered(world=source, seed=options.seed or 0, **keywords)


def _is_rendered(source: Path) -> bool:
    """Returns True for meshes and scenarios, which are rendered before they are reconstructed."""
    return source.suffix.lower() in RENDERED or str(source) in SCENARIOS


def _defaults(options: argparse.Namespace) -> Any:
    from splatpilot.analysis.reconstruction.run import RenderedSceneConfig
    from splatpilot.training.reconstruction.config import ReconstructConfig

    source = getattr(options, "source", None)
    return RenderedSceneConfig() if source and _is_rendered(source) else ReconstructConfig()
