import json
from dataclasses import fields, replace
from pathlib import Path

import av
import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest

from splatpilot.training.corpus.corpus import Corpus, Samples, write_ledger, write_shard
from splatpilot.training.corpus.lerobot import COLOR, DEPTH, TASK, export


@pytest.fixture(scope="module")
def dataset(collected, tmp_path_factory) -> Path:
    """The export of two worlds with two flights each."""
    out = tmp_path_factory.mktemp("lerobot") / "dataset"
    export(collected, out)
    return out


def read_video(path: str, pixels: str) -> tuple[np.ndarray, np.ndarray]:
    with av.open(path) as container:
        frames = [(frame.time, frame.to_ndarray(format=pixels)) for frame in container.decode()]
    return np.array([time for time, _ in frames]), np.stack([image for _, image in frames])


def test_rows_and_videos_are_those_of_the_corpus(collected, dataset):
    info = json.loads((dataset / "meta/info.json").read_text())
    assert (info["codebase_version"], info["fps"], info["total_episodes"]) == ("v3.0", 2, 4)
    bounds = (info["features"][DEPTH]["info"][f"video.depth_{end}"] for end in ("min", "max"))
    low, high = (np.log(bound + 3.5) for bound in bounds)
    for k, shard in enumerate(collected.shards):
        place = {"chunk_index": 0, "file_index": k}
        rows = pq.read_table(dataset / info["data_path"].format(**place)).to_pydict()
        own = {name: array[::2] for name, array in shard.arrays.items()}  # one perturbed copy
        state = own["X_WB"][:, 4:], own["X_WB"][:, :4], own["v_B"], own["goal_B"]
        np.testing.assert_allclose(rows["observation.state"], np.hstack(state), rtol=1e-6)
        action = np.reshape(rows["action"], (-1, 10, 3))
        np.testing.assert_array_equal(action, own["trajectories_B"][:, 0])
        video = dataset / info["video_path"]
        color, depth = (str(video).format(video_key=key, **place) for key in (COLOR, DEPTH))
        times, colors = read_video(color, "rgb24")
        np.testing.assert_allclose(times, 0.5 * np.arange(len(times)))
        assert np.abs(colors.astype(float) - own["color"]).mean() < 8.0
        _, codes = read_video(depth, "gray12le")
        depth = np.exp(low + codes / 4095 * (high - low)) - 3.5
        np.testing.assert_allclose(depth, np.clip(own["depth"].astype(float), 0.1, 20.0), atol=0.01)


def test_episodes_locate_the_rows_and_images_of_flights(collected, dataset):
    episodes = pq.read_table(dataset / "meta/episodes/chunk-000/file-000.parquet").to_pandas()
    flights = [flight["states"] for shard in collected.shards for flight in shard.flights]
    ends = np.cumsum(flights)
    starts = [0.0, flights[0] / 2, 0.0, flights[2] / 2]
    for name, expected in {
        "length": flights,
        "dataset_to_index": [*ends],
        "dataset_from_index": [0, *ends[:-1]],
        f"videos/{COLOR}/from_timestamp": starts,
        f"videos/{DEPTH}/file_index": [0, 0, 1, 1],
    }.items():
        assert list(episodes[name]) == expected, name
    assert list(pd.read_parquet(dataset / "meta/tasks.parquet").index) == [TASK]
    first = pq.read_table(dataset / "data/chunk-000/file-000.parquet").to_pandas()[: flights[0]]
    actions = np.stack(list(first["action"]))
    pixels = np.concatenate([shard.arrays["color"][::2] for shard in collected.shards]) / 255
    stats = json.loads((dataset / "meta/stats.json").read_text())[COLOR]
    assert stats["count"] == [len(pixels)]
    for name in ("min", "max", "mean", "std"):
        expected = getattr(actions, name)(axis=0)
        found = episodes[f"stats/action/{name}"][0]
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6)
        expected = getattr(pixels, name)(axis=(0, 1, 2))
        np.testing.assert_allclose(np.ravel(stats[name]), expected, atol=1e-9)
    expected = np.quantile(pixels, 0.9, axis=(0, 1, 2), method="inverted_cdf")
    np.testing.assert_allclose(np.ravel(stats["q90"]), expected)


def test_a_flight_is_split_where_a_state_is_missing(collected, tmp_path):
    folder = tmp_path / "corpus"
    (folder / "shards").mkdir(parents=True)
    for name in ("corpus.yaml", "worlds"):
        (folder / name).symlink_to(collected.folder / name)
    shard = collected.shards[0]
    kept = np.delete(np.arange(len(shard)), [10, 11])  # state 5 of the first flight
    parts = {name: array[kept] for name, array in shard.arrays.items()}
    parts |= {f.name: np.zeros(len(kept)) for f in fields(Samples) if f.name not in parts}
    flights = [flight | {"states": flight["states"]} for flight in shard.flights]
    flights[0]["states"] -= 1
    about = {"world": shard.world, "source": shard.source, "flights": flights, "revision": ""}
    write_shard(folder / "shards/a", [Samples(**parts)], collected.config.size, about)
    write_ledger(Corpus(folder))
    assert "3 episodes" in export(Corpus(folder), tmp_path / "out")
    episodes = pq.read_table(tmp_path / "out/meta/episodes/chunk-000/file-000.parquet")
    first, second = (flight["states"] for flight in shard.flights)
    assert episodes["length"].to_pylist() == [5, first - 6, second]


@pytest.mark.parametrize(
    ("camera", "message"),
    [
        ({"width": 33}, "image size of .* must be even and at least 16 px, as video, got 33x24"),
        ({"height": 8}, "image size of .* must be even and at least 16 px, as video, got 32x8"),
        (None, "a corpus with flights of an expert, got none"),
    ],
)
def test_corpora_that_cannot_be_exported_are_refused(collected, tmp_path, camera, message):
    corpus = Corpus(collected.folder)
    if camera is None:
        corpus.shards = []
    else:
        corpus.config = replace(corpus.config, camera=replace(corpus.config.camera, **camera))
    with pytest.raises(ValueError, match=message):
        export(corpus, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_lerobot_opens_it(dataset):
    lerobot = pytest.importorskip("lerobot.datasets")
    found = lerobot.LeRobotDataset("local/flights", root=dataset, video_backend="pyav")
    assert found[0][DEPTH].shape == (1, 24, 32)
    assert found[len(found) - 1]["task"] == TASK
