from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from splatpilot.training.captures.capture import Capture


@pytest.fixture
def write_nerfstudio() -> Callable[..., dict[str, Any]]:
    """Writes images of a capture, and returns its `transforms.json`, with lengths times `scale`."""

    def write(path: Path, capture: Capture, scale: float = 1.0, brightness: float = 1.0):
        path.mkdir()
        frames = []
        for i, X_WC in enumerate(capture.X_WCs):
            image = np.clip(brightness * capture.load_image(i).astype(float), 0, 255)
            cv2.imwrite(str(path / f"{i:02d}.png"), image[..., ::-1].astype(np.uint8))
            matrix = X_WC.GetAsMatrix4() @ np.diag([1.0, -1, -1, 1])
            matrix[:3, 3] *= scale
            frames.append({"file_path": f"{i:02d}.png", "transform_matrix": matrix.tolist()})
        camera = {"w": 64, "h": 48, "fl_x": 32.0, "cx": 32.0, "cy": 24.0}
        return camera | {"frames": frames}

    return write
