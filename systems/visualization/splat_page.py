"""Pages that hold what Meshcat has drawn and Gaussians in one scene, and need nothing else."""

import base64
import gzip
import json
from collections.abc import Sequence
from importlib import resources
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from splatpilot.systems.splats.background import Background, EnvironmentMap
from splatpilot.systems.splats.gaussian_scene import GaussianScene
from splatpilot.systems.visualization.packed_gaussians import pack_gaussians

_JPEG = [cv2.IMWRITE_JPEG_QUALITY, 80]


def splat_page(
    meshcat_page: str,
    gaussians: GaussianScene,
    background: Background,
    data: dict[str, Any],
    scripts: Sequence[str],
    start: str,
) -> str:
    """
    The HTML of a page that needs nothing else, not even a network.

    Args:
        meshcat_page: `Meshcat.StaticHtml()`.
        gaussians, background: what cameras see.
        data: what else the page shows, of numbers, text, lists and dictionaries.
        scripts: names of the files in `page` that show it, each after those that it needs.
        start: what they run in the end: JavaScript in which `splats` and `data` are known.
    """
    sky = ""
    if isinstance(background, EnvironmentMap):
        # The page's columns run against the azimuth.
        mirrored = EnvironmentMap(background.texels[:, ::-1])
        sky = base64.b64encode(mirrored.png()).decode()
    sources = [_source(name) for name in ("splats.js", *scripts, "page.js")]
    sources.append(f"openPage().then(({{splats, data}}) => {{ {start} }});")
    added = (
        f"<style>{_source('page.css')}</style>"
        f'<script type="text/plain" id="gaussians">'
        f"{compressed(pack_gaussians(gaussians).tobytes())}</script>"
        f'<script type="text/plain" id="sky">{sky}</script>'
        f'<script type="text/plain" id="data">{compressed(json.dumps(data).encode())}</script>'
    ) + "".join(f"<script>{source}</script>" for source in sources)
    head, body, tail = meshcat_page.rpartition("</body>")
    return head + added + body + tail


def compressed(data: bytes) -> str:
    """Bytes as text, which `unpack` of `page/page.js` reads; the same every time."""
    return base64.b64encode(gzip.compress(data, 6, mtime=0)).decode()


def rounded(values: NDArray[np.floating]) -> list:
    """Numbers for a page: as nested lists, to a tenth of a millimetre."""
    return np.round(values, 4).tolist()


def jpeg(image: NDArray[np.uint8]) -> str:
    """An image (H, W, 3), blue first, for a page."""
    return base64.b64encode(cv2.imencode(".jpg", image, _JPEG)[1].tobytes()).decode()


def _source(name: str) -> str:
    return (resources.files(__package__) / "page" / name).read_text()
