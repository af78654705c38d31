"""Writes the digests of the sources that are only tested in, for which `splits.py` looks.

python benchmarks/test_sources.py DATA
"""

import argparse
from pathlib import Path

import yaml

from splatpilot.diagrams.worlds import splits
from splatpilot.diagrams.worlds.mesh import mesh_digests
from splatpilot.training.captures.capture_registry import read_capture

SOURCES = {
    "hospital": "tartanair/hospital",
    "redkitchen": "redkitchen",
    "bookstore": "worlds/bookstore.gltf",
    "warehouse": "worlds/warehouse.gltf",
    "hospital_building": "worlds/hospital_building.gltf",
    "cafe": "worlds/cafe.glb",
    "edgar_mine": "worlds/edgar_mine.glb",
    "spaceship": "worlds/spaceship.glb",
    "farm": "worlds/farm.glb",
    "mansion_garden": "worlds/mansion_garden.glb",
    "canyon": "worlds/canyon.glb",
    "beach": "worlds/beach.glb",
}
"""Captures and meshes below the folder of data."""


def table(data: Path, names: list[str]) -> dict[str, list[str]]:
    """Returns the digests of sources by name."""
    digests = {}
    for name in names:
        path = data / SOURCES[name]
        if path.is_dir():
            capture = read_capture(path)
            images = (capture.load_image(i) for i in range(len(capture)))
            parts = splits.part_digests(image.tobytes() for image in images)
        else:
            parts = mesh_digests(path)
        digests[name] = splits.source_digest(parts)
    return digests


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("data", type=Path, help="folder of captures and meshes")
    found = table(parser.parse_args().data, list(SOURCES))
    text = yaml.safe_dump(found, sort_keys=False, default_flow_style=None, width=200)
    splits.TABLE.write_text(text)
