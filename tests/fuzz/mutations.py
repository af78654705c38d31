"""Damage: what becomes of a file by accident or on purpose, drawn from a seed."""

import io
import pickle
import re
import struct
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path

from numpy.random import Generator

_INTEGERS = (0, 1, -1, 2, 9, 2**15, 2**16, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**62, -(2**63))
_REALS = (0.0, -0.0, -1.0, 1e-300, 1e300, -1e300, 1e38, 1e9, float("nan"), float("inf"))
_WORDS = [
    *"nan .nan .inf -.inf NaN Infinity 1e400 -1e308 0 -1 -0.0 1e-320 2147483648 1e9 0x10".split(),
    *"9223372036854775808 null ~ true '' [] {} [[[[]]]] - *a &x !Nobody /dev/zero ..".split(),
    *"\u00e9 \x00 \" ' : ../../../etc/passwd 2026-01-01 <<:".split(" "),
    *("9" * 400, "&a [*a, *a]", "!!python/object/apply:os.system [id]", "!!python/name:os.system"),
    *("!Nobody {}", "a: b: c", "<<: *a", "\n", "\t"),
]
_NUMBER = re.compile(rb"-?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")


class _Pickled:
    """What would make a file, if it were ever unpickled."""

    def __reduce__(self) -> tuple[Callable[..., object], tuple[object, ...]]:
        return Path.touch, (Path("/tmp/splatpilot-fuzz-ran-code"),)


PICKLE_LEFT = Path("/tmp/splatpilot-fuzz-ran-code")
"""Is there if a pickle was believed."""


def _flip(content: bytes, rng: Generator) -> bytes:
    changed = bytearray(content)
    for at in rng.integers(len(content), size=rng.integers(1, 9)):
        changed[at] ^= 1 << int(rng.integers(8))
    return bytes(changed)


def _cut(content: bytes, rng: Generator) -> bytes:
    return content[: rng.integers(len(content))]


def _lose(content: bytes, rng: Generator) -> bytes:
    start, length = rng.integers(len(content)), rng.integers(1, 1 + len(content) // 4 + 1)
    return content[:start] + content[start + length :]


def _repeat(content: bytes, rng: Generator) -> bytes:
    start, length = rng.integers(len(content)), rng.integers(1, 1 + len(content) // 4 + 1)
    return content[: start + length] + content[start:]


def _zero(content: bytes, rng: Generator) -> bytes:
    start, length = int(rng.integers(len(content))), int(rng.integers(1, 65))
    return content[:start] + bytes(len(content[start : start + length])) + content[start + length :]


def _integer(content: bytes, rng: Generator) -> bytes:
    """An integer where one may stand."""
    size = int(rng.choice([1, 2, 4, 8]))
    value = int(_INTEGERS[rng.integers(len(_INTEGERS))]) % 2 ** (8 * size)
    return _put(content, value.to_bytes(size, "little"), rng)


def _real(content: bytes, rng: Generator) -> bytes:
    value = _REALS[rng.integers(len(_REALS))]
    try:
        return _put(content, struct.pack("<f" if rng.random() < 0.5 else "<d", value), rng)
    except OverflowError:
        return _put(content, struct.pack("<d", value), rng)


def _put(content: bytes, value: bytes, rng: Generator) -> bytes:
    at = int(rng.integers(max(1, len(content) - len(value))))
    if rng.random() < 0.5:
        at -= at % len(value)
    return content[:at] + value + content[at + len(value) :]


def _number(content: bytes, rng: Generator) -> bytes:
    """A word or another number in the place of a number of a text."""
    found = list(_NUMBER.finditer(content[: 1 << 16]))
    if not found:
        return _flip(content, rng)
    at = found[rng.integers(len(found))]
    return content[: at.start()] + _word(rng) + content[at.end() :]


def _token(content: bytes, rng: Generator) -> bytes:
    """A word in the place of another."""
    tokens = re.split(rb"(\s+)", content)
    tokens[rng.integers(len(tokens))] = _word(rng)
    return b"".join(tokens)


def _word(rng: Generator) -> bytes:
    return _WORDS[rng.integers(len(_WORDS))].encode("utf-8", "replace")


def _swap_lines(content: bytes, rng: Generator) -> bytes:
    lines = content.split(b"\n")
    i, j = rng.integers(len(lines), size=2)
    lines[i], lines[j] = lines[j], lines[i]
    return b"\n".join(lines)


def _swap_fields(content: bytes, rng: Generator) -> bytes:
    tokens = re.split(rb"([\s:,{}\[\]]+)", content)
    i, j = 2 * rng.integers((len(tokens) + 1) // 2, size=2)
    tokens[i], tokens[j] = tokens[j], tokens[i]
    return b"".join(tokens)


def _nest(content: bytes, rng: Generator) -> bytes:
    depth = int(rng.integers(10, 20000))
    at = int(rng.integers(len(content)))
    return content[:at] + b"[" * depth + b"]" * depth + content[at:]


def _other(content: bytes, rng: Generator) -> bytes:
    """Something else altogether."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("row.npy", bytes(1 << 20))
    others = [
        *(b"", b"\0", bytes(4096), rng.bytes(300), b"<html></html>", b"\x89PNG\r\n\x1a\n"),
        *(pickle.dumps(_Pickled()), buffer.getvalue(), zlib.compress(bytes(1 << 20))),
        b"version https://git-lfs.github.com/spec/v1\noid sha256:00\nsize 1\n",
        b"a: &a [x, x]\nb: &b [*a, *a]\nc: [*b, *b]\n",
    ]
    return others[rng.integers(len(others))]


_EITHER = [_flip, _cut, _lose, _repeat, _other]
_BINARY = [*_EITHER, _zero, _integer, _integer, _real, _real]
_TEXT = [*_EITHER, _number, _number, _number, _token, _token, _swap_lines, _swap_fields, _nest]


def damage(content: bytes, rng: Generator) -> bytes:
    """Content with one to three things wrong with it."""
    if content[:2] == b"PK" and rng.random() < 0.75:
        return _damage_entry(content, rng)
    text = b"\0" not in content[:4096]
    ways = _TEXT if text else _BINARY
    if not text and content.startswith((b"ply", b"# Octomap")) and rng.random() < 0.4:
        ways = _TEXT  # of the header
        start = content[:2000]
        return ways[rng.integers(len(ways))](start, rng) + content[2000:]
    for _ in range(int(rng.integers(1, 4))):
        if not content:
            break
        content = ways[rng.integers(len(ways))](content, rng)
    return content


def _damage_entry(content: bytes, rng: Generator) -> bytes:
    """An archive with one entry damaged, missing, renamed or twice there, and right checksums."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        entries = [(name, archive.read(name)) for name in archive.namelist()]
    at = int(rng.integers(len(entries)))
    name, data = entries[at]
    match rng.integers(8):
        case 0:
            del entries[at]
        case 1:
            entries[at] = entries[at - 1][0], data
        case 2:
            entries.append((name, data))
        case 3 | 4:
            head = _TEXT[rng.integers(len(_TEXT))](data[:128], rng)
            entries[at] = name, head + data[128:]
        case _:
            entries[at] = name, _BINARY[rng.integers(len(_BINARY))](data, rng) if data else data
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, data in entries:
            archive.writestr(zipfile.ZipInfo(name), data)
    return buffer.getvalue()


def replace_file(file: Path, rng: Generator) -> None:
    """Puts something that is no file of its own in the place of a file."""
    content = file.read_bytes()
    file.unlink()
    match rng.integers(6):
        case 0:
            file.symlink_to(file)
        case 1:
            file.symlink_to("/dev/zero")
        case 2:
            file.symlink_to("/etc/passwd")
        case 3:
            file.mkdir()
        case 4:
            file.symlink_to(file.parent)
        case 5:
            elsewhere = file.with_name(f"elsewhere{file.suffix}")
            elsewhere.write_bytes(content)
            file.symlink_to(elsewhere)
