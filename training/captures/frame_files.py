"""From lists of files and poses to a `Capture`; every format that keeps frames in files ends here.

What is wrong with single frames leaves those out, with a message each in `Capture.dropped`: files
that are missing, empty, unreadable or of another size, poses that are not finite, no rotation or
far from all others. It is an error if more than a fifth of the frames are left out, because then it
is the capture that is read wrongly.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from pydrake.math import RigidTransform

from splatpilot.training.captures.capture import (
    Capture,
    DepthCamera,
    FileAxes,
    all_valid,
    no_depth,
)
from splatpilot.training.captures.image_files import (
    depth_size,
    image_layout,
    image_size,
    read_alpha,
    read_image,
    read_mask,
)
from splatpilot.training.captures.lens import Lens, common_pinhole, pinhole, resampling_maps
from splatpilot.training.captures.poses import stray_frames

MAX_DROPPED = 0.2
"""The fraction of frames that may be left out."""
_MAPS = 8
"""Cameras whose resampling is kept at a time."""
_WHOLE = 0.999
"""Part of a resampled pixel that must come from valid ones."""
_SAME_SHAPE = 0.02
"""Relative difference of the ratios of width to height, below which depth shows the same view."""


@dataclass(frozen=True, eq=False)
class FrameFiles:
    """One frame of a capture, not yet looked at."""

    image: Path
    X_FB: Callable[[], RigidTransform]
    """Returns the pose as the file gives it, or raises ValueError that names the file: that of a
    body B, the camera with the file's axes, in the file's world F."""
    depth: Path | None = None
    lens: Lens | None = None
    """The camera of this frame; None takes that of the capture."""
    mask: Path | None = None
    """An image that is black where this one is not to be used."""
    name: str = ""
    """Path of the image as the files give it; empty for the name of the file."""
    held_out: bool = False
    """Whether the files hold this frame out from training."""


@dataclass(frozen=True, eq=False)
class _Frame:
    """A frame whose files look whole."""

    files: FrameFiles
    size: tuple[int, int]  # width and height [px]
    depth_size: tuple[int, int] | None
    has_alpha: bool
    X_FB: RigidTransform


def open_frames(
    path: Path,
    kind: str,
    frames: Sequence[FrameFiles],
    *,
    axes: FileAxes,
    lens: Callable[[int, int], Lens] = lambda width, height: _no_lens(),
    intrinsics: Sequence[float] = (),
    read_depth: Callable[[Path], NDArray[np.float32]] | None = None,
    depth_camera: Callable[[int, int], DepthCamera] | None = None,
    stretch_depth: bool = False,
    dropped: Sequence[str] = (),
    notes: Sequence[str] = (),
) -> Capture:
    """Opens the frames; images and depths are read when asked for.

    Args:
        path: the capture's folder or file.
        kind: what it is called in `Capture.source`.
        axes: the axes of the files' poses.
        lens: gives the camera of images of a width and height [px], for frames that bring none.
        intrinsics: fx, fy, cx, cy [px] that replace those of `lens`; or empty.
        read_depth: reads the depth [m] in a file; None if there is none.
        depth_camera: gives the camera of depth images of a width and height [px]; None if depth has
            the pixels of the images before they are undistorted.
        stretch_depth: whether depth, without a camera of its own, may show in fewer pixels or more
            what the image shows.
        dropped: messages about frames that were left out already, which do not count further.
        notes: the first of `Capture.notes`.

    Raises:
        ValueError: if fewer than two frames, or less than four fifths of them, can be used.
    """
    messages = list(dropped)
    sound: list[_Frame] = []
    for frame in frames:
        try:
            sound.append(_inspect(frame))
        except (ValueError, OSError) as error:
            messages.append(str(error))
    sound = _keep_usual_size(sound, messages, registered=not (depth_camera or stretch_depth))
    if stretch_depth:
        sound = _keep_same_view(sound, messages)
    if sound:
        stray = set(stray_frames(np.array([frame.X_FB.translation() for frame in sound])).tolist())
        for i in sorted(stray):
            p = sound[i].X_FB.translation().round(1)
            messages.append(f"{sound[i].files.image}: its position {p} is far from all others")
        sound = [frame for i, frame in enumerate(sound) if i not in stray]
    if len(sound) < max(2, (1 - MAX_DROPPED) * len(frames)):
        first = f"; the first that cannot: {messages[0]}" if messages else ""
        raise ValueError(
            f"{path}: {len(sound)} of {len(frames)} frames can be used, at least 2 and "
            f"{1 - MAX_DROPPED:.0%} are needed{first}"
        )

    def shared_lens() -> Lens:
        width, height = next(frame.size for frame in sound if frame.files.lens is None)
        if intrinsics:
            return Lens(pinhole(*intrinsics), width, height, source="capture.intrinsics")
        return lens(width, height)

    try:
        shared = shared_lens() if any(frame.files.lens is None for frame in sound) else None
        lenses = [frame.files.lens or shared for frame in sound]
        distinct = [each for each in dict.fromkeys(lenses) if each is not None]
        camera = common_pinhole(distinct)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None
    # Some cameras focus anew with each frame: their maps would fill the memory.
    map_of = lru_cache(_MAPS)(lambda lens: resampling_maps(lens, camera))
    has_depth = read_depth is not None and any(frame.files.depth for frame in sound)

    def load_image(i: int) -> NDArray[np.uint8]:
        file = sound[i].files.image
        return _resample(_require_size(read_image(file), file, sound[i].size), i, cv2.INTER_LINEAR)

    def load_valid(i: int) -> NDArray[np.bool_]:
        files, size = sound[i].files, sound[i].size
        valid = np.ones(size[::-1], dtype=bool)
        if files.mask is not None:
            valid &= _require_size(read_mask(files.mask), files.mask, size)
        if sound[i].has_alpha:
            valid &= _require_size(read_alpha(files.image), files.image, size)
        # No pixel is valid whose color is interpolated from one that is not.
        return _resample(valid.astype(np.float32), i, cv2.INTER_LINEAR) > _WHOLE

    def load_depth(i: int) -> NDArray[np.float32] | None:
        file, size = sound[i].files.depth, sound[i].depth_size
        if file is None or size is None or read_depth is None:
            return None
        depth = _require_size(read_depth(file), file, size)
        if depth_camera:
            return depth
        # Between surfaces an average would be a place where nothing is.
        if size != sound[i].size:
            depth = cv2.resize(depth, sound[i].size, interpolation=cv2.INTER_NEAREST_EXACT)
        return _resample(depth, i, cv2.INTER_NEAREST)

    def _resample(image: NDArray, i: int, interpolation: int) -> NDArray:
        lens = lenses[i]
        if lens is None or (found := map_of(lens)) is None:
            return image
        # The pinhole sees up to half a pixel more than the lens, which is not black.
        return cv2.remap(image, *found, interpolation, borderMode=cv2.BORDER_REPLICATE)

    R_WF, R_BC = RigidTransform(axes.R_WF), RigidTransform(axes.R_BC)
    depth_sizes = [frame.depth_size for frame in sound if frame.depth_size]
    held_out = [i for i, frame in enumerate(sound) if frame.files.held_out]
    masked = sum(frame.files.mask is not None for frame in sound)
    transparent = sum(frame.has_alpha for frame in sound)
    return Capture(
        name=path.resolve().name,
        source=f"{kind} {path.resolve()}",
        K=camera.K,
        width=camera.width,
        height=camera.height,
        X_WCs=[R_WF @ frame.X_FB @ R_BC for frame in sound],
        load_image=load_image,
        load_depth=load_depth if has_depth else no_depth,
        load_valid=load_valid if masked or transparent else all_valid,
        depth_camera=depth_camera(*depth_sizes[0]) if depth_camera and has_depth else None,
        frame_names=[frame.files.name or frame.files.image.name for frame in sound],
        dropped=messages,
        held_out=held_out if any(frame.held_out for frame in frames) else None,
        notes=[*notes, *_notes(distinct, masked, transparent, len(sound))],
        axes=axes,
    )


def _notes(lenses: Sequence[Lens], masked: int, transparent: int, total: int) -> list[str]:
    """Returns what is noted of every capture: its intrinsics, and which pixels are not used."""
    notes = [f"intrinsics: {lenses[0]}"]
    if len(lenses) > 1:
        notes[0] += f", and {len(lenses) - 1} more cameras"
    if eccentric := [lens for lens in lenses if lens.is_eccentric]:
        cx, cy = eccentric[0].K[:2, 2].round(1).tolist()
        notes.append(
            f"the principal point ({cx}, {cy}) px is far from the center of the images; are "
            "intrinsics those of images of this size?"
        )
    if masked:
        notes.append(f"{masked} of {total} images have a mask, and are not used where it is black")
    if transparent:
        notes.append(
            f"{transparent} of {total} images have an alpha channel, and are not used where it is "
            "less than a half"
        )
    return notes


def _no_lens() -> Lens:
    raise ValueError("the intrinsics are unknown; set capture.intrinsics to [fx, fy, cx, cy]")


def _inspect(frame: FrameFiles) -> _Frame:
    size, has_alpha = image_layout(frame.image)
    if frame.lens is not None and size != (frame.lens.width, frame.lens.height):
        raise ValueError(_size_message(frame.image, size, (frame.lens.width, frame.lens.height)))
    if frame.mask is not None and (found := image_size(frame.mask)) != size:
        raise ValueError(_size_message(frame.mask, found, size))
    found = depth_size(frame.depth) if frame.depth is not None else None
    return _Frame(frame, size, found, has_alpha, frame.X_FB())


def _keep_usual_size(
    frames: Sequence[_Frame], messages: list[str], registered: bool
) -> list[_Frame]:
    """Leaves out frames of another size than most, or whose depth is."""
    sizes = [frame.size for frame in frames if frame.files.lens is None]
    usual = max(sizes, key=sizes.count, default=None)
    depth_sizes = [frame.depth_size for frame in frames if frame.depth_size]
    usual_depth = max(depth_sizes, key=depth_sizes.count, default=None)
    kept = []
    for frame in frames:
        files, wanted = frame.files, frame.size if registered else usual_depth
        if files.lens is None and usual is not None and frame.size != usual:
            messages.append(_size_message(files.image, frame.size, usual))
        elif files.depth and frame.depth_size and wanted and frame.depth_size != wanted:
            messages.append(_size_message(files.depth, frame.depth_size, wanted))
        else:
            kept.append(frame)
    return kept


def _keep_same_view(frames: Sequence[_Frame], messages: list[str]) -> list[_Frame]:
    """Leaves out frames whose depth has another shape than their image."""
    kept = []
    for frame in frames:
        (width, height), (w, h) = frame.size, frame.depth_size or frame.size
        if abs(w * height - h * width) > _SAME_SHAPE * w * height:
            messages.append(
                f"{frame.files.depth}: {w}x{h} pixels of depth do not show what {width}x{height} "
                "pixels of an image do; width and height must have one ratio"
            )
        else:
            kept.append(frame)
    return kept


def _size_message(file: Path, size: tuple[int, int], wanted: tuple[int, int]) -> str:
    return (
        f"{file}: {size[0]}x{size[1]} pixels where {wanted[0]}x{wanted[1]} are expected; all "
        "images of a camera, and all depths, must have one size"
    )


def _require_size(array: NDArray, file: Path, size: tuple[int, int]) -> NDArray:
    if array.shape[1::-1] != size:
        raise ValueError(_size_message(file, array.shape[1::-1], size))
    return array
