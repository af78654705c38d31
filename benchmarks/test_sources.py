"""Writes the digests of the sources that are only tested in, for which `splits.py` looks.

python benchmarks/test_sources.py DATA
"""

import argparse
from pathlib import Path

import yaml

from splatpilot.analysis.environments import known_entries
from splatpilot.diagrams.worlds import splits
from splatpilot.diagrams.worlds.mesh import mesh_digests
from splatpilot.training.captures.capture_registry import read_capture


def table(data: Path) -> dict[str, list[str]]:
    """Returns the digests of the test sources in a folder of data, by name."""
    digests = {}
    for name, entry in known_entries().items():
        path = data / entry.source
        if entry.split != "test" or not path.exists():  # a scenario
            continue
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
    found = table(parser.parse_args().data)
    text = yaml.safe_dump(found, sort_keys=False, default_flow_style=None, width=200)
    splits.TABLE.write_text(text)
