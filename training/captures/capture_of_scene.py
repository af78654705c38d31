"""The capture that a scene folder was made from."""

from pathlib import Path

from splatpilot.diagrams.worlds.scene_metadata import SceneMetadata
from splatpilot.systems.configuration import load_config
from splatpilot.training.captures.capture import Capture
from splatpilot.training.captures.capture_config import CaptureConfig
from splatpilot.training.captures.read_capture import read_capture


def read_capture_of(scene: Path, metadata: SceneMetadata) -> Capture:
    """Opens the capture that a scene folder was made from, with the settings it was made with.

    Raises:
        FileNotFoundError, ValueError, OSError: if `metadata` names none, or it cannot be opened.
    """
    file = scene / "scene.yaml"
    if not metadata.capture:
        raise ValueError(
            f"{file}: names no capture to compare the scene with: it came without one, or has "
            "another size than the depth that its capture measured; measure the scene that "
            "`splatpilot reconstruct` wrote"
        )
    try:
        config = load_config(CaptureConfig(), overrides=metadata.capture_settings)
    except ValueError as error:
        raise ValueError(f"{file}: capture_settings: {error}") from None
    config.origin = metadata.origin
    return read_capture(metadata.capture, config)
