import os
import signal
import struct
import subprocess
import sys

import pycolmap
import pytest

from splatpilot.training.captures.colmap import check_records, read_model

KINDS = sorted(set(pycolmap.CameraModelId.__members__) - {"INVALID"})


@pytest.fixture
def model(tmp_path):
    """A model of two cameras on a rig that see one point."""
    written = pycolmap.Reconstruction()
    for number in (1, 2):
        camera = pycolmap.Camera.create_from_model_name(number, "OPENCV", 100.0, 64, 48)
        written.add_camera_with_trivial_rig(camera)
        points = [pycolmap.Point2D([1.0, 2.0]), pycolmap.Point2D([3.0, 4.0])]
        image = pycolmap.Image(name="a.png", points2D=points, camera_id=number, image_id=number)
        written.add_image_with_trivial_frame(image, pycolmap.Rigid3d())
    track = pycolmap.Track([pycolmap.TrackElement(1, 0), pycolmap.TrackElement(2, 1)])
    written.add_point3D([1.0, 2.0, 3.0], track, [1, 2, 3])
    written.write(tmp_path)
    return tmp_path


def num_params(number: int) -> int:
    kind = pycolmap.CameraModelId(number)
    return len(pycolmap.Camera.create_from_model_id(1, kind, 1.0, 1, 1).params)


@pytest.mark.parametrize("kind", KINDS)
def test_what_pycolmap_writes_passes(model, kind):
    written = pycolmap.Reconstruction()
    written.add_camera_with_trivial_rig(pycolmap.Camera.create_from_model_name(1, kind, 9.0, 8, 8))
    written.write(model / "..")
    check_records(model / "..", num_params)
    assert len(read_model(model).images) == 2


@pytest.mark.parametrize("name", ["cameras", "images", "points3D", "rigs", "frames"])
def test_files_cut_short_anywhere_are_refused(model, name):
    file = model / f"{name}.bin"
    whole = file.read_bytes()
    for end in range(len(whole)):
        file.write_bytes(whole[:end])
        with pytest.raises(ValueError, match=rf"{name}\.bin is damaged: .*; copy it again"):
            read_model(model)
    for damaged in (
        whole + b"\0",
        struct.pack("<Q", 2**63) + whole[8:],
        struct.pack("<q", -1) + whole[8:],
        struct.pack("<Q", 10**6) + whole[8:],
    ):
        file.write_bytes(damaged)
        with pytest.raises(ValueError, match=rf"{name}\.bin is damaged"):
            read_model(model)


def test_lengths_of_lists_are_compared_with_the_file(model):
    file = model / "points3D.bin"
    whole = file.read_bytes()
    file.write_bytes(whole[:51] + struct.pack("<Q", 2**40) + whole[59:])
    with pytest.raises(ValueError, match=r"points3D\.bin is damaged: byte 59 claims \d+ more"):
        read_model(model)


def test_unknown_cameras_are_refused(model):
    file = model / "cameras.bin"
    whole = file.read_bytes()
    file.write_bytes(whole[:12] + struct.pack("<i", 99) + whole[16:])
    with pytest.raises(ValueError, match=r"cameras\.bin is damaged: "):
        read_model(model)


def test_sigterm_stays_the_programs(tmp_path):
    script = (
        "import os, signal, sys\n"
        "signal.signal(signal.SIGTERM, lambda *_: sys.exit(7))\n"
        "from splatpilot.training.captures.colmap import import_pycolmap\n"
        "import_pycolmap()\n"
        "print('ready', flush=True)\n"
        "signal.pause()\n"
    )
    words = [sys.executable, "-c", script]
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdout is not None and process.stderr is not None
        assert process.stdout.readline() == b"ready\n"
        os.kill(process.pid, signal.SIGTERM)
        assert process.wait(30) == 7
        assert process.stderr.read() == b""
