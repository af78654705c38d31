"""`splatpilot library`: the environments of a folder of data, as measured scenes with one index.

Captures and meshes become scene folders; OctoMaps are flown as they are. `library.json` has a
record of each.
"""

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import batched
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from pydrake.common.yaml import yaml_load_file
from pydrake.math import RigidTransform
from pydrake.systems.sensors import CameraInfo

from splatpilot.analysis.figures import Panel, colorize, depth_scale, write_grid
from splatpilot.analysis.reconstruction import fidelity
from splatpilot.analysis.reconstruction.fidelity import FidelityConfig
from splatpilot.analysis.reconstruction.measure_scene import (
    METRICS,
    RenderedSceneConfig,
    SceneViews,
    format_metric,
    make_scene,
    measure_scene,
    read_metrics,
)
from splatpilot.diagrams.flight.blocks import MakeCamera
from splatpilot.diagrams.flight.scenario import Scenario, sample_initial_state
from splatpilot.diagrams.scenarios import benchmark_scenarios
from splatpilot.diagrams.worlds.file_worlds import OCTOMAP, OctomapConfig
from splatpilot.diagrams.worlds.scene_folder import (
    SceneConfig,
    SceneSource,
    draw_ends,
    read_scene_folder,
    read_scene_metadata,
)
from splatpilot.diagrams.worlds.splits import SPLITS, part_digests, source_digest
from splatpilot.diagrams.worlds.world import World
from splatpilot.diagrams.worlds.world_registry import make_world, scene_config
from splatpilot.systems.collision.distance_field import FieldState
from splatpilot.systems.common.config import load_config
from splatpilot.systems.common.files import (
    DATA,
    locked_folder,
    require_existing,
    write_csv,
    write_text,
)
from splatpilot.systems.common.progress import Progress
from splatpilot.systems.common.provenance import InfeasibleFlightError
from splatpilot.systems.common.validation import Config, bounded, require, unknown
from splatpilot.systems.policies.time_of_arrival import time_of_arrival
from splatpilot.systems.splats.splat_camera import SplatCamera
from splatpilot.systems.vehicle.state import pose_from_state
from splatpilot.training.captures import render as render_capture
from splatpilot.training.reconstruction.metrics import has_true_depth

INDEX = "library.json"
_ENTRIES = "environments.yaml"
_MESHES = ".glb", ".gltf", ".obj"
_SEEDS = 20  # that are tried for start, goal and a path
_COLUMNS = 3  # environments in a row of the contact sheet


@dataclass(kw_only=True)
class Entry(Config):
    """An environment: its source, and how its scene is made."""

    source: str = ""  # a capture, mesh or OctoMap below the folder of data, or a scenario
    split: str = bounded("train", f"{{{', '.join(SPLITS)}}}")
    license: str = ""  # empty: that of the mesh's `asset.extras`
    outdoor: bool = False
    settings: tuple[str, ...] = ()  # of `RenderedSceneConfig`

    def config(self, overrides: Sequence[str] = ()) -> RenderedSceneConfig:
        """Returns the configuration of its capture and reconstruction."""
        config = RenderedSceneConfig(split=self.split)
        config = replace(config, render=replace(config.render, split=self.split))
        return load_config(config, overrides=[*self.settings, *overrides])


@dataclass(frozen=True)
class Record:
    """A measured environment. Metrics that it does not have are None."""

    name: str
    source: str
    split: str
    license: str
    path: str  # of an OctoMap; empty for the scene folder of that name
    digest: list[str]  # see `splits.source_digest`
    made_of: str  # source and settings
    size: list[float]  # [m], of the distance field
    free_volume: float  # [m^3]
    outdoor: bool
    gaussians: int
    frames: int | None = None
    psnr_db: float | None = None  # these three over all pixels, with nothing fitted
    ssim: float | None = None
    lpips: float | None = None
    flown_depth_mae_m: float | None = None  # of the onboard camera's images
    flown_depth_relative: float | None = None
    floaters: float | None = None  # fraction of pixels
    holes: float | None = None
    unseen: float | None = None  # fraction of pixels along the default flight
    fidelity_bound: float | None = None  # [m], see `splatpilot scene fidelity`
    feasible_seeds: int = 0  # of 20
    reason: str = ""  # of the first infeasible seed
    cpu_seconds: float = 0.0


_TABLE = {
    "split": ("split", "{}"),
    "size": ("size [m]", "{}"),
    "free_volume": ("free [m^3]", "{:.0f}"),
    "gaussians": ("Gaussians", "{}"),
    "frames": ("frames", "{}"),
    "psnr_db": ("PSNR", "{:.1f}"),
    "ssim": ("SSIM", "{:.3f}"),
    "lpips": ("LPIPS", "{:.3f}"),
    "flown_depth_mae_m": ("depth [m]", "{:.3f}"),
    "flown_depth_relative": ("depth", "{:.2%}"),
    "floaters": ("floaters", "{:.2%}"),
    "holes": ("holes", "{:.2%}"),
    "unseen": ("unseen", "{:.1%}"),
    "fidelity_bound": ("bound [m]", "{:.2f}"),
    "feasible_seeds": ("seeds", "{}"),
    "cpu_seconds": ("CPU s", "{:.0f}"),
}
"""Titles and formats of the columns of `show`."""


def known_entries(data: Path | None = None) -> dict[str, Entry]:
    """Returns the environments by name: those of `environments.yaml` here and in the folder of
    data, and what else the folders `worlds`, `maps` and `captures` of the latter hold."""
    entries = _read_entries(Path(__file__).parent / _ENTRIES)
    if data is None:
        return entries
    if (data / _ENTRIES).is_file():
        entries |= _read_entries(data / _ENTRIES)
    sources = {entry.source for entry in entries.values()}
    for folder, suffixes in (("worlds", _MESHES), ("maps", (OCTOMAP,)), ("captures", ())):
        for path in sorted((data / folder).glob("[!.]*")):
            source, is_capture = f"{folder}/{path.name}", not suffixes and path.is_dir()
            if (is_capture or path.suffix.lower() in suffixes) and source not in sources:
                entries.setdefault(path.name if is_capture else path.stem, Entry(source=source))
    return entries


def _read_entries(file: Path) -> dict[str, Entry]:
    entries = {}
    for name, content in (yaml_load_file(str(file)) or {}).items():
        try:
            entries[name] = Entry(**content | {"settings": tuple(content.get("settings", ()))})
            entries[name].validate()
        except (TypeError, ValueError, AttributeError) as error:
            raise ValueError(f"{file}: {name}: {error}") from None
    return entries


def make(
    *,
    names: Sequence[str],
    data: Path | None,
    scenes: Path,
    split: str = "",
    overrides: Sequence[str] = (),
) -> list[Record]:
    """Makes and measures environments as the scene folders `scenes/NAME`, and records them. The
    same call resumes. Rendered captures are kept in `scenes/captures/NAME`.

    Args:
        names: of environments; if empty, all of the split whose sources exist.
        data: folder of captures, meshes and OctoMaps.
        split: "train", "validation" or "test"; all of them if empty.
        overrides: settings of `RenderedSceneConfig`, after those of the entries.
    """
    entries = known_entries(data)
    for name in names:
        if name not in entries:
            raise ValueError(unknown("environment", name, entries))
        valid, remedy = split in ("", entries[name].split), "leave out the split, or the name"
        require(valid, f"the split of {name}", split, entries[name].split, remedy)
    chosen = {
        name: entry
        for name, entry in entries.items()
        if name in (names or entries) and split in ("", entry.split)
    }
    require(chosen, "the split", "that of an environment", split)
    for entry in chosen.values():
        entry.config(overrides).validate()
    sources = {name: _source(entry, data) for name, entry in chosen.items()}
    for name, source in sources.items():
        if isinstance(source, Path) and not source.exists():
            if names:
                require_existing(source, f"the capture, mesh or OctoMap of {name}")
            print(f"{name}: is left out, without {source}", flush=True)
            del chosen[name]
    remedy = f"give --data, or set {DATA}"
    require(chosen, f"environments whose sources are in {data}", "one or more", "none", remedy)
    failed = []
    for number, (name, entry) in enumerate(chosen.items(), 1):
        print(f"== {name} ({number} of {len(chosen)}), from {sources[name]}", flush=True)
        made_of = " ".join([entry.source, *entry.settings, *overrides])
        found = read_index(scenes).get(name)
        if found is not None:
            remedy = "choose another --out, or remove its record and folder"
            settings = f"settings of {name} in {scenes / INDEX}"
            require(found.made_of == made_of, settings, made_of, found.made_of, remedy)
            print(f"{name}: is recorded already", flush=True)
            continue
        started = time.process_time()
        try:
            record = _make(name, entry, sources[name], scenes, overrides)
        except (ValueError, OSError) as error:
            # The others of a library do not depend on it.
            if len(chosen) == 1:
                raise
            failed.append(f"{name}: {error}")
            print(f"warning: {failed[-1]}", flush=True)
            continue
        spent = time.process_time() - started
        _store(scenes, replace(record, made_of=made_of, cpu_seconds=spent))
    if failed:
        raise ValueError(f"{len(failed)} environments could not be made; " + "; ".join(failed))
    index = read_index(scenes)
    return [index[name] for name in chosen]


def show(*, scenes: Path) -> list[Record]:
    """Prints the index of a folder of scenes, and writes it as `library.csv` and the contact sheet
    `library.png`: a view of each onboard camera, color next to depth."""
    records = list(read_index(scenes).values())
    require(records, f"{scenes / INDEX}", "an index", "none", "`splatpilot library make` makes it")
    print(pd.DataFrame(map(_row, records)).to_string(index=False))
    for record in records:
        if record.feasible_seeds < _SEEDS:
            print(
                f"{record.name}: {_SEEDS - record.feasible_seeds} seeds cannot be flown: "
                f"{record.reason}"
            )
    write_csv(scenes / "library.csv", [asdict(record) for record in records])
    _write_sheet(scenes / "library.png", records, scenes)
    print(f"Wrote library.csv and library.png in {scenes}")
    return records


def _row(record: Record) -> dict[str, str]:
    values: dict[str, Any] = asdict(record)
    values["size"] = " x ".join(f"{length:.0f}" for length in record.size)
    cells = {title: format_metric(values[name], form) for name, (title, form) in _TABLE.items()}
    return {"environment": record.name} | cells


def read_index(scenes: Path) -> dict[str, Record]:
    """Reads the index of a folder of scenes; empty without the file."""
    file = scenes / INDEX
    if not file.is_file():
        return {}
    try:
        return {name: Record(**record) for name, record in json.loads(file.read_text()).items()}
    except (ValueError, TypeError, AttributeError) as error:
        raise ValueError(f"{file}: {error}; delete the file and make the library again") from None


def _store(scenes: Path, record: Record) -> None:
    with locked_folder(scenes):
        index = read_index(scenes) | {record.name: record}
        content = {name: asdict(each) for name, each in sorted(index.items())}
        write_text(scenes / INDEX, json.dumps(content, indent=1))


def _source(entry: Entry, data: Path | None) -> Path | str:
    if entry.source in benchmark_scenarios():
        return entry.source
    return (data or Path(f"${DATA}")) / entry.source  # without a folder, for messages


def _make(
    name: str, entry: Entry, source: Path | str, scenes: Path, overrides: Sequence[str]
) -> Record:
    if isinstance(source, Path) and source.suffix.lower() == OCTOMAP:
        path = str(source.absolute())
        digest = source_digest(part_digests([source.read_bytes()]))
        return replace(_record(name, entry, OctomapConfig(path=path), digest), path=path)
    capture, scene = scenes / "captures" / name, scenes / name
    config = entry.config(overrides)
    if isinstance(source, Path) and source.is_dir():
        capture = source
    else:
        render_capture.run(world=source, out=capture, config=config.render)
    if (scene / "scene.yaml").is_file():
        made_of = read_scene_metadata(scene).capture
        remedy = "choose another --out"
        same = Path(made_of) == capture.absolute()
        require(same, f"capture of {scene}", str(capture), made_of or "another one", remedy)
        print(f"{scene}: is reconstructed already", flush=True)
        metrics = read_metrics(scene) if (scene / METRICS).is_file() else measure_scene(scene)
    else:
        _, metrics = make_scene(capture=capture, out=scene, config=config.reconstruct())
    assert metrics is not None
    metadata = read_scene_metadata(scene)
    views = SceneViews(scene)
    if views.capture.has_depth and metadata.metric and metadata.perturbation_bound is None:
        folder = scenes / "fidelity" / name
        fidelity.run([scene], folder, FidelityConfig(reconstruct=config.reconstruct()))
        metadata = read_scene_metadata(scene)
    record = _record(name, entry, SceneConfig(path=str(scene.absolute())), metadata.source_digest)
    strict = metrics.as_json()["strict"]
    return replace(
        record,
        split=metadata.split,
        license=entry.license or _mesh_license(source),
        frames=len(views.capture),
        **{metric: strict[metric] for metric in ("psnr_db", "ssim", "lpips")},
        **flown_depth_errors(views, read_scene_folder(scene)),
        floaters=metrics.mean("floater_fraction"),
        holes=metrics.mean("hole_fraction"),
        unseen=metrics.flight_unseen_fraction,
        fidelity_bound=metadata.perturbation_bound,
    )


def _record(name: str, entry: Entry, config: SceneSource, digest: list[str]) -> Record:
    """Returns the part of a record that does not depend on a capture."""
    world = make_world(config, 0)
    feasible, reason = feasible_seeds(config, world)
    return Record(
        name=name,
        source=entry.source,
        split=entry.split,
        license=entry.license,
        path="",
        digest=digest,
        made_of="",
        size=np.round(world.esdf.upper_W - world.esdf.lower_W, 2).tolist(),
        free_volume=float(world.esdf.volume(FieldState.FREE)),
        outdoor=entry.outdoor,
        gaussians=len(world.gaussians),
        feasible_seeds=feasible,
        reason=reason,
    )


def feasible_seeds(config: SceneSource, scene: World) -> tuple[int, str]:
    """Counts the seeds from 0 whose start and goal a search on the distance field connects, and
    returns the reason of the first that is not one of them."""
    count, reason = 0, ""
    for seed in Progress(range(_SEEDS), "starts and goals", unit="seed", leave=False):
        try:
            world = draw_ends(config, scene, seed)
            state = sample_initial_state(Scenario(seed=seed), world)
            toa = time_of_arrival(world.esdf.conservative(), world.p_WG)
            if not toa.is_reachable(state[:3]):
                raise InfeasibleFlightError("no path from start to goal")
            count += 1
        except InfeasibleFlightError as error:
            reason = reason or str(error)
    return count, reason


def flown_depth_errors(views: SceneViews, world: World) -> dict[str, float]:
    """Computes the mean error [m] of the onboard camera's depth, and that relative to the true
    depth, on the frames that measure a scene; empty without true depth."""
    errors, relative = [], []
    for i in Progress(views.measured, "depth as flown", unit="frame", leave=False):
        frame = views.frame(i)
        known = has_true_depth(frame.depth) & frame.valid
        if not known.any():
            continue
        height, width = frame.depth.shape
        (fx, _, cx), (_, fy, cy) = frame.K[:2]
        info = CameraInfo(width, height, fx, fy, cx, cy)
        camera = SplatCamera(world.baked, info, RigidTransform(), background=world.background)
        depth = camera.render(frame.X_WC).depth
        shown = known & (depth > 0) & np.isfinite(depth)
        error = np.abs(depth[shown] - frame.depth[shown])
        errors.append(error.mean())
        relative.append((error / frame.depth[shown]).mean())
    found = {"flown_depth_mae_m": errors, "flown_depth_relative": relative}
    return {name: float(np.mean(values)) for name, values in found.items() if values}


def _mesh_license(source: Path | str) -> str:
    """Returns the license in `asset.extras` of a glTF file."""
    if not isinstance(source, Path) or source.suffix.lower() not in (".glb", ".gltf"):
        return ""
    content = source.read_bytes()
    if content[:4] == b"glTF":
        content = content[20 : 20 + int.from_bytes(content[12:16], "little")]
    extras = json.loads(content).get("asset", {}).get("extras", {})
    return str(extras.get("license", "")) if isinstance(extras, Mapping) else ""


def _write_sheet(path: Path, records: Sequence[Record], scenes: Path) -> None:
    panels: list[Panel | None] = []
    for record in Progress(records, "contact sheet", unit="view", leave=False):
        panels += _panels(record, scenes)
    titles = ["color", "depth"] * min(_COLUMNS, len(records))
    panels += [None] * (-len(panels) % len(titles))
    rows = list(batched(panels, len(titles)))
    write_grid(path, rows, titles, [""] * len(rows))


def _panels(record: Record, scenes: Path) -> list[Panel]:
    """Returns color and depth of the onboard camera at the start, looking to the goal."""
    path = Path(record.path) if record.path else scenes / record.name
    world = make_world(scene_config(path), 0)
    try:
        X_WB = pose_from_state(sample_initial_state(Scenario(), world))
    except InfeasibleFlightError:
        X_WB = RigidTransform(world.p_WS)
    view = MakeCamera(Scenario(), world).render(X_WB)
    depth = colorize(view.depth, depth_scale([view.depth]), view.depth > 0)
    return [Panel(view.color, record.name), Panel(depth, record.split)]
