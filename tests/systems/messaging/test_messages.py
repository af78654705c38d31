import importlib
import subprocess
import sys
from pathlib import Path

import pytest

from splatpilot.systems.messaging import messages

TYPES = sorted((Path(messages.__file__).parent / "lcmtypes").glob("*.lcm"))


@pytest.fixture(scope="module")
def generated(tmp_path_factory):
    """The package that lcm-gen writes."""
    folder = tmp_path_factory.mktemp("generated")
    generator = Path(sys.executable).with_name("lcm-gen")
    subprocess.run([generator, "--python", "--ppath", folder, *TYPES], check=True)
    (folder / "splatpilot").rename(folder / "lcm_gen_messages")
    sys.path.insert(0, str(folder))
    yield importlib.import_module("lcm_gen_messages")
    sys.path.remove(str(folder))


def filled(message, number):
    """Sets all fields; arrays of variable size have `number` entries."""
    message.header.seq, message.header.frame_name = 7, "world"
    for kind, name, sizes in type(message)._fields if hasattr(message, "_fields") else ():
        if sizes:
            shape = [int(n) if n.isdigit() else number for n in sizes]
            array = [0.5 + k for k in range(shape[0])]
            for size in reversed(shape[1:]):
                array = [[each] * size for each in array]
            setattr(message, name, array)
        elif kind in ("float", "double"):
            setattr(message, name, 1.25)
        elif kind == "string":
            setattr(message, name, "body")
        elif kind != "drake.lcmt_header":
            is_count = any(name in each.sizes for each in message._fields)
            setattr(message, name, number if is_count else kind == "boolean" or -3)
    return message


@pytest.mark.parametrize("name", [path.stem for path in TYPES])
def test_messages_have_the_bytes_of_lcm_gen(name, generated):
    ours, theirs = getattr(messages, name), getattr(generated, name)
    assert ours().encode() == theirs().encode()
    packet = filled(ours(), 2).encode()
    assert theirs.decode(packet).encode() == packet
    assert ours.decode(packet).encode() == packet
    for constant in (each for each in vars(theirs) if each.isupper()):
        assert getattr(ours, constant) == getattr(theirs, constant)
    for damaged in (b"", packet[:7], packet[:-1], bytes(8) + packet[8:]):
        with pytest.raises((ValueError, messages.struct.error)):
            ours.decode(damaged)


def test_a_negative_count_is_refused():
    message = messages.lcmt_depth_grid()
    message.num_values = 0
    packet = bytearray(message.encode())
    packet[-4:] = b"\xff" * 4
    with pytest.raises(ValueError, match="at least 0"):
        messages.lcmt_depth_grid.decode(bytes(packet))
