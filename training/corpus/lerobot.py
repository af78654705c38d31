"""Exports the expert's flights of a corpus as a LeRobotDataset of version 3.0.

An episode is a run of samples of one flight at constant spacing. Each shard of the corpus becomes
one file of rows, with a row group for each episode, and one video of each camera.
"""

import json
from collections.abc import Iterator
from fractions import Fraction
from math import ceil
from pathlib import Path
from typing import Any, cast

import av
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
from av.video.stream import VideoStream
from scipy.spatial.transform import Rotation

from splatpilot.systems.common.files import folder_written_atomically
from splatpilot.systems.common.progress import Progress
from splatpilot.systems.common.validation import require
from splatpilot.systems.policies.hypotheses import NUM_WAYPOINTS, WAYPOINT_PERIOD
from splatpilot.training.corpus.corpus import EXPERT, Corpus, Shard

COLOR, DEPTH = "observation.images.color", "observation.images.depth"
TASK = "fly to the goal"

_STATE = [f"p_WB_{axis}" for axis in "xyz"] + [f"q_WB_{axis}" for axis in "wxyz"]
_STATE += [f"{vector}_{axis}" for vector in ("v_B", "goal_B") for axis in "xyz"]
_TIMES = [WAYPOINT_PERIOD * (n + 1) for n in range(NUM_WAYPOINTS)]
_ACTION = [f"{axis}_{time:.1f}s" for time in _TIMES for axis in "xyz"]
_NAMES = {"observation.state": _STATE, "action": _ACTION}
_INDICES = "frame_index", "episode_index", "index", "task_index"
_SCHEMA = pa.schema(
    {name: pa.list_(pa.float32(), len(names)) for name, names in _NAMES.items()}
    | {"timestamp": pa.float32()}
    | dict.fromkeys(_INDICES, pa.int64())
)
_LOSSLESS = {"preset": "ultrafast", "x265-params": "lossless=1:keyint=2:log-level=none"}
# Encoder, its format, the format of images and options, by channels; depth maps are lossless.
_CODECS = {
    3: ("libx264", "yuv420p", "rgb24", {"crf": "18", "g": "2", "bf": "0"}),
    1: ("libx265", "gray12le", "gray12le", _LOSSLESS),
}
_FILES_PER_CHUNK = 1000  # LeRobot's default, as are the paths
_FILE = "chunk-{chunk_index:03d}/file-{file_index:03d}"
_DATA, _VIDEO = f"data/{_FILE}.parquet", f"videos/{{video_key}}/{_FILE}.mp4"
_MAX_CODE, _SHIFT = 4095, 3.5  # of LeRobot's logarithmic depth; the shift in [m]
_QUANTILES = (0.01, 0.1, 0.5, 0.9, 0.99)
_TOLERANCE = 0.25  # [m/s], of the mean velocity between samples; without gaps it is 0.11 m/s off


def export(corpus: Corpus, out: Path, *, replace: bool = False) -> str:
    """Writes the dataset to the folder `out` atomically; returns a summary line."""
    expert = [shard for shard in corpus.shards if shard.source == EXPERT and len(shard)]
    states = alone = 0
    with folder_written_atomically(out, replace=replace) as folder:
        writer = _Writer(folder, corpus)
        for shard in Progress(expert, "exporting", unit="world", delay=1.0):
            runs = list(_runs(shard, corpus))
            states += sum(map(len, runs))
            alone += sum(len(run) == 1 for run in runs)
            writer.add(shard, [run for run in runs if len(run) > 1])
        require(writer.episodes, f"{corpus.folder}", "a corpus with flights of an expert", "none")
        writer.finish()
    flown = sum(map(len, expert))
    return (
        f"{len(writer.episodes)} episodes of {writer.frames} samples at {float(writer.rate):g} Hz "
        f"in {out}; left out: {flown - states} samples of perturbed poses, {len(corpus) - flown} "
        f"off the paths or of recovery, {alone} without a neighbor in time"
    )


def _runs(shard: Shard, corpus: Corpus) -> Iterator[np.ndarray]:
    """Yields the rows of consecutive states in each flight. A flight is complete if it has as many
    states as periods; in others, mean velocities between states tell where some are missing."""
    period, copies = corpus.config.expert.period, 1 + corpus.config.perturbation.copies
    states = sum(flight["states"] for flight in shard.flights)
    what = f"the states of all flights in {shard.path}"
    require(states * copies == len(shard), what, f"{len(shard) / copies:g}", states)
    X_WB = shard.arrays["X_WB"]
    v_WB = Rotation.from_quat(X_WB[:, :4], scalar_first=True).apply(shard.arrays["v_B"])
    first = 0
    for flight in shard.flights:
        rows = first + copies * np.arange(flight["states"])
        first += copies * len(rows)
        if len(rows) == ceil(flight["time_s"] / period - 1e-6):
            gaps = []
        else:
            velocity = np.diff(X_WB[rows, 4:], axis=0) / period
            error = velocity - (v_WB[rows[1:]] + v_WB[rows[:-1]]) / 2
            gaps = 1 + np.flatnonzero(np.linalg.norm(error, axis=1) > _TOLERANCE)
        yield from (run for run in np.split(rows, gaps) if len(run))


class _Writer:
    def __init__(self, folder: Path, corpus: Corpus) -> None:
        camera = self.camera = corpus.config.camera
        sides = camera.width, camera.height
        valid = min(sides) >= 16 and not any(side % 2 for side in sides)
        size = f"{camera.width}x{camera.height}"
        require(valid, f"image size of {corpus.folder}", "even and at least 16 px, as video", size)
        self.folder = folder
        self.rate = 1 / Fraction(corpus.config.expert.period).limit_denominator(1000)
        self.frames = self.files = 0
        self.episodes: list[dict[str, Any]] = []
        self._columns: list[dict[str, np.ndarray]] = []
        bounds = np.array([camera.min_depth, camera.max_depth])
        near, far = self._log_bounds = np.log(bounds + _SHIFT)
        depths = np.exp(np.linspace(near, far, _MAX_CODE + 1)) - _SHIFT
        self._values = {COLOR: np.arange(256) / 255, DEPTH: depths}  # of all codes
        self._totals = {COLOR: np.zeros((3, 256), int), DEPTH: np.zeros((1, _MAX_CODE + 1), int)}

    def add(self, shard: Shard, runs: list[np.ndarray]) -> None:
        """Writes runs (n,) of rows of a shard, an episode each."""
        if not runs:
            return
        chunk, file = divmod(self.files, _FILES_PER_CHUNK)
        numbers = {"chunk_index": chunk, "file_index": file}
        rows = np.concatenate(runs)
        near, far = self._log_bounds
        depth = shard.arrays["depth"][rows].astype(float)
        depth = np.clip(depth, self.camera.min_depth, self.camera.max_depth)
        codes = np.rint(_MAX_CODE * (np.log(depth + _SHIFT) - near) / (far - near))
        images = {COLOR: shard.arrays["color"][rows], DEPTH: codes.astype(np.uint16)[..., None]}
        for key in images:
            self._encode(self._path(_VIDEO, video_key=key, **numbers), images[key])
        with pq.ParquetWriter(self._path(_DATA, **numbers), _SCHEMA) as parquet:
            first = 0
            for run in runs:
                end = first + len(run)
                self._add_episode(shard, run, {key: images[key][first:end] for key in images})
                columns = self._columns[-1].items()
                table = {k: (c[:, 0] if c.shape[1] == 1 else c).tolist() for k, c in columns}
                parquet.write_table(pa.table(table, _SCHEMA))
                times = {"from_timestamp": first / self.rate, "to_timestamp": end / self.rate}
                video = numbers | {name: float(time) for name, time in times.items()}
                self.episodes[-1] |= {f"data/{name}": k for name, k in numbers.items()}
                for key in images:
                    self.episodes[-1] |= {f"videos/{key}/{name}": video[name] for name in video}
                first = end
        self.files += 1

    def _path(self, pattern: str, **numbers: Any) -> Path:
        path = self.folder / pattern.format(**numbers)
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def _encode(self, path: Path, images: np.ndarray) -> None:
        """Encodes images (N, H, W, 3) uint8 of color, or (N, H, W, 1) uint16 of depth codes."""
        codec, pixels, given, options = _CODECS[images.shape[-1]]
        with av.open(str(path), "w") as container:
            stream = cast(VideoStream, container.add_stream(codec, self.rate, options))
            stream.width, stream.height, stream.pix_fmt = *images.shape[2:0:-1], pixels
            for image in images:
                image = image if image.shape[-1] == 3 else image[..., 0]
                container.mux(stream.encode(av.VideoFrame.from_ndarray(image, given)))
            container.mux(stream.encode())

    def _add_episode(self, shard: Shard, run: np.ndarray, images: dict[str, np.ndarray]) -> None:
        count, number, frame = len(run), len(self.episodes), np.arange(len(run))[:, None]
        X_WB, v_B, goal_B, trajectories_B = (
            shard.arrays[name][run] for name in ("X_WB", "v_B", "goal_B", "trajectories_B")
        )
        indices = frame, np.full_like(frame, number), self.frames + frame, np.zeros_like(frame)
        columns = {
            "observation.state": np.concatenate([X_WB[:, 4:], X_WB[:, :4], v_B, goal_B], axis=1),
            "action": trajectories_B[:, 0].reshape(count, -1),
            "timestamp": frame / float(self.rate),
            **dict(zip(_INDICES, indices, strict=True)),
        }
        self._columns.append(columns)
        stats = {name: _stats(column) for name, column in columns.items()}
        for key, each in images.items():
            histogram = _histogram(each, len(self._values[key]))
            self._totals[key] += histogram
            stats[key] = _image_stats(histogram, self._values[key], count)
        self.episodes.append(
            {"episode_index": number, "tasks": [TASK], "length": count}
            | {"dataset_from_index": self.frames, "dataset_to_index": self.frames + count}
            | {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}
            | {f"stats/{key}/{name}": v for key, each in stats.items() for name, v in each.items()}
        )
        self.frames += count

    def finish(self) -> None:
        """Writes `meta`."""
        episodes = self._path(f"meta/episodes/{_FILE}.parquet", chunk_index=0, file_index=0)
        pq.write_table(pa.Table.from_pylist(self.episodes), episodes)
        tasks = pd.DataFrame({"task_index": [0]}, pd.Index([TASK], name="task"))
        tasks.to_parquet(self.folder / "meta/tasks.parquet")
        columns = {name: [each[name] for each in self._columns] for name in self._columns[0]}
        stats = {name: _stats(np.concatenate(parts)) for name, parts in columns.items()}
        for key, total in self._totals.items():
            stats[key] = _image_stats(total, self._values[key], self.frames)
        fps = float(self.rate)
        fps = int(fps) if fps.is_integer() else fps
        info = {
            "codebase_version": "v3.0",
            "fps": fps,
            "features": self._features(fps),
            "total_episodes": len(self.episodes),
            "total_frames": self.frames,
            "total_tasks": 1,
            "chunks_size": _FILES_PER_CHUNK,
            "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200,
            "data_path": _DATA,
            "video_path": _VIDEO,
            "robot_type": "quadrotor",
            "splits": {"train": f"0:{len(self.episodes)}"},
        }
        for name, content in (("info", info), ("stats", stats)):
            (self.folder / f"meta/{name}.json").write_text(json.dumps(content, indent=4) + "\n")

    def _features(self, fps: float) -> dict[str, Any]:
        camera = self.camera
        bounds = {"depth_min": camera.min_depth, "depth_max": camera.max_depth}
        coding = bounds | {"shift": _SHIFT, "use_log": True}
        features: dict[str, Any] = {}
        for name in _SCHEMA.names:
            dtype, names = "int64" if name in _INDICES else "float32", _NAMES.get(name)
            features[name] = {"dtype": dtype, "shape": [len(names or "1")], "names": names}
        for key, channels, codec, about in ((COLOR, 3, "h264", {}), (DEPTH, 1, "hevc", coding)):
            about = {"codec": codec, "pix_fmt": _CODECS[channels][1], "fps": fps} | about
            info = {f"video.{name}": value for name, value in about.items()}
            info |= {"is_depth_map": key == DEPTH} | ({"depth_unit": "m"} if key == DEPTH else {})
            size, names = [camera.height, camera.width, channels], ["height", "width", "channels"]
            features[key] = {"dtype": "video", "shape": size, "names": names, "info": info}
        return features


def _stats(column: np.ndarray) -> dict[str, list]:
    """Computes LeRobot's statistics of a column (N, n)."""
    stats = {name: getattr(np, name)(column, axis=0) for name in ("min", "max", "mean", "std")}
    stats |= {f"q{100 * q:02.0f}": np.quantile(column, q, axis=0) for q in _QUANTILES}
    return {name: value.tolist() for name, value in stats.items()} | {"count": [len(column)]}


def _histogram(images: np.ndarray, codes: int) -> np.ndarray:
    """Counts the codes of images (N, H, W, C) by channel: (C, codes)."""
    channels = images.reshape(-1, images.shape[-1]).T
    return np.stack([np.bincount(channel, minlength=codes) for channel in channels])


def _image_stats(histogram: np.ndarray, values: np.ndarray, count: int) -> dict[str, list]:
    """Computes statistics of `count` images by the histograms (C, n) of their values (n,)."""
    below = np.cumsum(histogram, axis=1) / histogram.sum(axis=1, keepdims=True)
    mean = histogram @ values / histogram.sum(axis=1)
    square = histogram @ values**2 / histogram.sum(axis=1)
    quantiles = {f"q{100 * q:02.0f}": q for q in _QUANTILES} | {"min": 1e-12, "max": 1 - 1e-12}
    stats = {name: values[(below < q).sum(axis=1)] for name, q in quantiles.items()}
    stats |= {"mean": mean, "std": np.sqrt(np.maximum(square - mean**2, 0.0))}
    return {name: v.reshape(-1, 1, 1).tolist() for name, v in stats.items()} | {"count": [count]}
